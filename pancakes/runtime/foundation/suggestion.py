"""Finds the known word that a user probably meant by an unknown one."""

from __future__ import annotations

from collections.abc import Collection, Iterable


def suggestion(word: str, known: Iterable[str]) -> str:
    """Returns the known word that is nearest to `word`, or an empty string where none is near.

    Upper and lower case are one. `ScanTarget` also finds `encirclement.ScanTarget`: leaving out what stands before the
    last dot is the commonest mistake with the names of plug-ins. A word with a dot is near where it is on both sides of
    it, or the very same after it: `encirclement.Foo` means no other of its family.
    """
    from difflib import get_close_matches  # only where something went wrong

    folded = {name.lower(): name for name in sorted(known, reverse=True)}
    family, dot, tail = word.lower().rpartition(".")
    if not dot:
        near = get_close_matches(tail, sorted(folded), n=1, cutoff=0.6)
        if near:
            return folded[near[0]]
        tails = {name.rpartition(".")[2]: name for name in folded}
        near = get_close_matches(tail, sorted(tails), n=1, cutoff=0.75)
        return folded[tails[near[0]]] if near else ""
    families: dict[str, dict[str, str]] = {}
    for name in sorted(folded, reverse=True):
        before, _, after = name.rpartition(".")
        families.setdefault(before, {})[after] = folded[name]
    for near_family in get_close_matches(family, sorted(families), n=3, cutoff=0.75):
        near = get_close_matches(tail, sorted(families[near_family]), n=1, cutoff=0.6)
        if near:
            return families[near_family][near[0]]
    same = sorted(name for name in folded.values() if name.rpartition(".")[2] == word.rpartition(".")[2])
    return same[0] if same else ""


def did_you_mean(word: str, known: Iterable[str], otherwise: str = "") -> str:
    """Returns the end of a sentence that refuses a word: `, did you mean 'x'?`; `otherwise` where no word is near."""
    near = suggestion(word, known)
    return f", did you mean {near!r}?" if near else otherwise


def hint_of(word: str, known: Collection[str]) -> str:
    """As `did_you_mean`; where no word is near, it lists all: `, only a, b`."""
    return did_you_mean(word, known, f", only {', '.join(known)}" if known else "")
