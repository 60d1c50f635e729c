"""Ranges of seeds, as a person writes them: `1-200`, `3,17,20-29`. Pure."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

MOST: Final = 100_000
"""The most seeds of one run; more are a slip of the keyboard."""
_HOW: Final = "write seeds as 1-200, or as 3,17,20-29"


def seeds_of(text: str) -> tuple[int, ...]:
    """Returns the seeds that a text names, in ascending order and each once.

    Raises:
        ValueError: it names none; the message is a sentence without its beginning, which is the text.
    """
    found: set[int] = set()
    for part in text.replace(" ", "").split(","):
        match = re.fullmatch(r"(\d+)(?:-(\d+))?", part, re.ASCII)
        if match is None:
            raise ValueError(f"{part or text!r} is no range of seeds: {_HOW}")
        if len(part) > 2 * 19 + 1:
            raise ValueError(f"{part!r} has a seed of more than 18 digits: {_HOW}")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise ValueError(f"{part!r} ends before it begins: write {last}-{first}")
        if last - first >= MOST or len(found) + last - first >= MOST:
            raise ValueError(f"{text!r} names more than {MOST:,} seeds: run them in parts")
        found.update(range(first, last + 1))
    return tuple(sorted(found))


def text_of_seeds(seeds: Iterable[int]) -> str:
    """Returns seeds as `seeds_of` takes them, neighbours as ranges."""
    parts: list[list[int]] = []
    for seed in sorted(set(seeds)):
        if parts and parts[-1][1] == seed - 1:
            parts[-1][1] = seed
        else:
            parts.append([seed, seed])
    return ",".join(str(first) if first == last else f"{first}-{last}" for first, last in parts)
