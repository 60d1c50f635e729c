"""Where the keys of a configuration stand: on a line of its file, or in a `--set`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

from pancakes.errors import Fault
from pancakes.runtime.config.scanner import KeyPath
from pancakes.settings import dotted

NAMED_TABLES: Final = ("channel", "device", "service", "task")
"""The tables whose keys are names: `[task.ScanTarget]`."""


class KeyPlaces:
    """Says where a key stands, as `agent1.toml:12` or `--set agent.name=x`.

    Args:
        path: the file, as messages name it.
        lines: the line of each key.
        named: the tables whose keys are names.
    """

    def __init__(self, path: str, lines: dict[KeyPath, int], named: Sequence[str] = NAMED_TABLES) -> None:
        self._path = path
        self._lines = lines
        self._named = named
        self._sets: dict[KeyPath, str] = {}

    def override(self, key: KeyPath, text: str, value: Any) -> None:
        """Notes that `--set text` gave this key its value; what the file says below the key is gone."""
        for known in [path for path in self._lines if path[: len(key)] == key]:
            del self._lines[known]
        for known in [path for path in self._sets if path[: len(key)] == key]:
            del self._sets[known]
        for length in range(1, len(key) + 1):
            if length == len(key) or (key[:length] not in self._lines and key[:length] not in self._sets):
                self._sets[key[:length]] = text
        self._sets.update((inside, text) for inside in _paths(value, key))

    def where(self, *key: str | int) -> str:
        """Returns the place of a key; of the innermost table around it where the key itself is not there."""
        outermost = 2 if len(key) > 1 and key[0] in self._named else 1  # another's [task.NAME] is no place for this
        for length in range(len(key), outermost - 1, -1):
            if key[:length] in self._sets:
                return set_text(self._sets[key[:length]])
            if key[:length] in self._lines:
                return f"{self._path}:{self._lines[key[:length]]}"
        return self._path

    def has(self, *key: str | int) -> bool:
        """Returns whether the file or a `--set` itself has this key."""
        return key in self._lines or key in self._sets

    def is_set(self, *key: str | int) -> bool:
        """Returns whether a key is there only because of a `--set`."""
        return key in self._sets

    def fault(self, key: KeyPath, problem: str, suggestion: str = "") -> Fault:
        """Returns a fault at a key."""
        return Fault(self.where(*key), key_text(key, self._named), problem, suggestion)

    def in_order(self, faults: list[Fault]) -> list[Fault]:
        """Returns faults in the order of the file, those of `--set` last; where a place has several, as they are."""

        def line(fault: Fault) -> float:
            number = fault.where.removeprefix(f"{self._path}:")
            if fault.where == self._path:
                return 0
            return int(number) if number.isdecimal() else float("inf")

        return sorted(faults, key=line)


def set_text(text: str) -> str:
    """Returns an override as messages name it."""
    return f"--set {text if len(text) <= 60 else text[:57] + '...'}"


def _paths(value: Any, key: KeyPath) -> Iterator[KeyPath]:
    """Yields the paths of all that is inside a plain value."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for part, inner in items:
        yield (*key, part)
        yield from _paths(inner, (*key, part))


def key_text(key: KeyPath, named: Sequence[str] = NAMED_TABLES) -> str:
    """Returns a key as messages name it: `[task.ScanTarget] restart.policy`, `[agent] name`, `schema`."""
    if key == ("schema",) or not key:
        return dotted(key)
    depth = 2 if key[0] in named and len(key) > 1 else 1
    table, rest = f"[{dotted(key[:depth])}]", dotted(key[depth:])
    return f"{table} {rest}" if rest else table
