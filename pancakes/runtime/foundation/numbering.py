"""How the packets of an agent are numbered: from another place in each of its lives, so that no number comes twice.

Whoever joins packets, such as an effect and its cause, knows them by their source and number. If numbers began at 1
again whenever an agent does, a packet would be taken for one of an earlier life.
"""

from __future__ import annotations

from typing import Final
from zlib import crc32

_NUMBER_BITS: Final = 32
_LIFE_BITS: Final = 21
"""Together 53: more is not exact in JavaScript, nor in the JSON of many programs."""


def first_number(life: str) -> int:
    """Returns the number of the first packet of each source in a life of an agent.

    Not of the boots that its journal has counted: these begin again after the disk was lost, and a disk that was
    restored counts some of them twice. That two of the lives of one agent begin alike has a chance of 1 in 2 million.

    Args:
        life: what was drawn for this life, see `Journal.life`.
    """
    return ((crc32(life.encode()) % (1 << _LIFE_BITS)) << _NUMBER_BITS) + 1


def number_in_life(seq: int) -> int:
    """Returns the number of a packet among those of its source in one life of its agent, from 1: for people."""
    return seq & ((1 << _NUMBER_BITS) - 1)
