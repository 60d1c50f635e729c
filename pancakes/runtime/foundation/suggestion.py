"""Finds the known word that a user probably meant by an unknown one."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Final

SAME_AS: Final = {
    "always": "each",
    "async": "lazy",
    "automatic": "auto",
    "critical": "error",
    "err": "error",
    "every": "each",
    "exception": "error",
    "fatal": "error",
    "immediate": "each",
    "manual": "ask",
    "never": "no",
    "none": "no",
    "notice": "info",
    "onfailure": "on-failure",
    "permanent": "always",
    "sync": "each",
    "temporary": "no",
    "trace": "debug",
    "transient": "on-failure",
    "unless-stopped": "always",
    "warn": "warning",
}
"""Words that others use, and what that is called here: common letters would lead to another, even to the opposite."""


def suggestion(word: str, known: Iterable[str]) -> str:
    """Returns the known word that is nearest to `word`, or an empty string if none is near.

    Upper and lower case are one. `ScanTarget` also finds `encirclement.ScanTarget`: leaving out what stands before the
    last dot is the commonest mistake with the names of plug-ins. A word with a dot is near another if both of its parts
    are: what is called alike in another family is something else, such as the temperature of another thing. An address
    is such a word as well, with a slash; one that leaves out the service finds its task.
    """
    folded = {name.lower(): name for name in sorted(known, reverse=True)}
    meant = SAME_AS.get(word.lower(), "")
    if meant in folded:
        return folded[meant]
    family, tail = _parted(word.lower())
    if not family:
        near = _near(tail, folded)
        if near:
            return folded[near]
        tails = {_parted(name)[1]: name for name in folded}
        near = _near(tail, tails, 0.75)
        return folded[tails[near]] if near else ""
    families: dict[str, dict[str, str]] = {}
    for name in sorted(folded, reverse=True):
        before, after = _parted(name)
        families.setdefault(before, {})[after] = folded[name]
    for near_family in _all_near(family, families, 0.75):
        near = _near(tail, families[near_family])
        if near:
            return families[near_family][near]
    within = (name for name in sorted(folded) if name.startswith(f"{family}/") and name.endswith(f"/{tail}"))
    return families.get("", {}).get(tail, "") or folded.get(next(within, ""), "")


def _parted(word: str) -> tuple[str, str]:
    """Returns what stands before the last dot or slash of a word, and what stands behind it."""
    at = max(word.rfind("."), word.rfind("/"))
    return word[: max(at, 0)], word[at + 1 :]


def _near(word: str, known: Iterable[str], alike: float = 0.6) -> str:
    return next(iter(_all_near(word, known, alike)), "")


def _all_near(word: str, known: Iterable[str], alike: float) -> list[str]:
    """Returns the words that are near, the nearest first.

    Args:
        word: the word.
        known: the words that there are.
        alike: which share of the letters must be the same.
    """
    from difflib import get_close_matches  # only if something went wrong

    found = get_close_matches(word, sorted(known), n=3, cutoff=alike)
    return [it for it in found if _is_mistyped(word, it)]


def _is_mistyped(word: str, other: str) -> bool:
    """Returns whether a few slips of the fingers lead from one word to the other, or one of them was cut short.

    Common letters are not enough: `always` has four of its six in `lazy`, and means the opposite.
    """
    short, long = sorted((word, other), key=len)
    if len(short) >= 3 and (long.startswith(short) or long.endswith(short)):
        return True
    return _slips(word, other) <= len(long) // 2


def _slips(word: str, other: str) -> int:
    """Returns how many letters are to be put in, left out, changed or swapped with the next one."""
    before: list[int] = []
    row = list(range(len(other) + 1))
    for i, letter in enumerate(word):
        above, before, row = before, row, [i + 1]
        for j, wanted in enumerate(other):
            slips = min(before[j + 1] + 1, row[j] + 1, before[j] + (letter != wanted))
            if i and j and letter == other[j - 1] and word[i - 1] == wanted:
                slips = min(slips, above[j - 1] + 1)
            row.append(slips)
    return row[-1]


def did_you_mean(word: str, known: Iterable[str], otherwise: str = "") -> str:
    """Returns the end of a sentence that refuses a word: `, did you mean 'x'?`; `otherwise` if no word is near."""
    near = suggestion(word, known)
    return f", did you mean {near!r}?" if near else otherwise


def hint_of(word: str, known: Collection[str]) -> str:
    """As `did_you_mean`; if no word is near, it lists all: `, only a, b`."""
    return did_you_mean(word, known, f", only {', '.join(known)}" if known else "")
