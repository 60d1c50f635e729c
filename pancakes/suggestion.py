"""What a person probably meant who wrote a word that nobody knows."""

from __future__ import annotations

from collections.abc import Iterable


def suggestion(word: str, known: Iterable[str]) -> str:
    """Returns the known word that is nearest to `word`, or an empty string where none is near.

    Upper and lower case are one. `ScanTarget` also finds `encirclement.ScanTarget`: leaving out what stands
    before the last dot is the commonest mistake with the names of plug-ins.
    """
    from difflib import get_close_matches  # only where something went wrong

    folded = {name.lower(): name for name in sorted(known, reverse=True)}
    cutoff = 0.7 if "." in word else 0.6  # dots and families of names are alike without meaning the same
    near = get_close_matches(word.lower(), sorted(folded), n=1, cutoff=cutoff)
    if near:
        return folded[near[0]]
    tails = {name.rpartition(".")[2]: name for name in folded}
    near = get_close_matches(word.lower().rpartition(".")[2], sorted(tails), n=1, cutoff=0.75)
    return folded[tails[near[0]]] if near else ""
