"""The scenarios in which the machine of a hosted task is searched: those of every run, and the larger ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from model.hosting_world import Bounds

from pancakes.supervision.restart import RestartSpec

TRIED_AGAIN: Final = RestartSpec("always", at_most=1, again_s=60.0)
TRANSIENT: Final = RestartSpec("on-failure", at_most=1)
TEMPORARY: Final = RestartSpec("no", at_most=1)

SUITE: Final[Mapping[str, Bounds]] = {
    "it comes where another has its name": Bounds(visitor=True, theirs=1, blocked=True, refusals=1),
    "it comes, and there is no place": Bounds(visitor=True, theirs=1, decisions=1, refusals=1, ends=0),
    "its disk was wiped, and it comes": Bounds(wiped=True, theirs=1, refusals=1, ends=0),
    "its record was lost, it comes, and writes fail": Bounds(lost=True, decisions=1, theirs=1, faults=1, ends=0),
    "it comes, and writes fail": Bounds(visitor=True, theirs=1, faults=1),
    "no": Bounds(TEMPORARY, requests=2),
    "it comes, and the agent crashes": Bounds(visitor=True, theirs=1, crashes=2),
    "it comes": Bounds(visitor=True, theirs=2, refusals=1),
    "on-failure": Bounds(TRANSIENT, requests=2),
    "always, tried again": Bounds(TRIED_AGAIN, requests=1, ends=2, spawns=3),
    "it comes, and is adopted": Bounds(visitor=True, theirs=1, decisions=1, faults=1),
    "its record was lost": Bounds(lost=True, decisions=2, requests=1, faults=1),
    "it comes, and is asked for": Bounds(visitor=True, theirs=1, requests=2),
    "its record was lost, and it comes": Bounds(lost=True, decisions=2, theirs=1, requests=1, ends=0),
    "given away at the third attempt": Bounds(offers=1, awards=3, ends=0, errors=False),
    "it is removed, and writes fail": Bounds(removals=True, decisions=1, requests=2, spawns=3, faults=1, ends=0),
    "it is removed, and the agent crashes": Bounds(removals=True, decisions=1, requests=2, crashes=1, ends=0),
    "it comes, and is removed": Bounds(visitor=True, theirs=2, removals=True, decisions=1, requests=1, ends=0),
    "it sticks": Bounds(requests=2, sticks=True),
    "it comes and goes, and the agent crashes": Bounds(visitor=True, theirs=1, offers=2, crashes=1, ends=0),
    "given away twice": Bounds(offers=2, awards=2, ends=0, errors=False),
    "it comes, and the service ends": Bounds(visitor=True, theirs=1, closes=True, crashes=1),
    "given away, and writes fail": Bounds(offers=1, faults=1, ends=0),
    "writes fail": Bounds(requests=2, faults=1),
    "it crashes": Bounds(requests=1, crashes=1, refusals=1),
    "it comes and goes": Bounds(visitor=True, theirs=1, offers=2),
    "given away, and it sticks": Bounds(offers=1, sticks=True),
    "given away, and adopted": Bounds(offers=1, decisions=1, faults=1, ends=0),
    "its service ends, and writes fail": Bounds(requests=1, closes=True, faults=1),
    "always": Bounds(requests=2, ends=2, refusals=1),
    "given away, and asked for": Bounds(offers=1, requests=1, errors=False),
    "it comes back": Bounds(offers=1, theirs=1, refusals=1, ends=0),
    "it comes back, and the agent crashes": Bounds(offers=1, theirs=1, crashes=1, ends=0),
    "given away, and its service ends": Bounds(offers=1, closes=True, crashes=1, ends=0),
    "given away, and writes fail after a crash": Bounds(offers=1, faults=1, crashes=1, ends=0),
    "given away, and crashes": Bounds(offers=1, crashes=1),
    "it comes back, and is asked for": Bounds(offers=1, theirs=1, requests=1, ends=0),
    "given away": Bounds(offers=1, refusals=1, ends=1),
    "given away at the second attempt, and fails": Bounds(offers=1, awards=2, requests=0, ends=1),
    "given away, written down, and writes fail": Bounds(
        offers=1, awards=2, faults=1, checkpoints=True, ends=0, errors=False
    ),
    "its service ends": Bounds(requests=1, closes=True, crashes=1, checkpoints=True),
    "it follows another": Bounds(requests=1, follows=True, refusals=1, faults=1),
    "given away, and fails while its service ends": Bounds(offers=1, closes=True, spawns=1),
    "given away, it sticks, and its service ends": Bounds(offers=1, sticks=True, closes=True, ends=0),
    "it comes back, and it sticks": Bounds(offers=1, theirs=1, sticks=True, ends=0),
    "another owns it, and writes fail": Bounds(claims=1, decisions=1, requests=1, faults=1),
    "another owns it, and the agent crashes": Bounds(claims=1, decisions=1, requests=1, crashes=1),
    "another owns it while it is given away": Bounds(offers=1, claims=1, decisions=1, ends=0, refusals=1),
    "another owns it, and its service ends": Bounds(claims=1, closes=True, crashes=1, decisions=1),
    "another owns it, and it sticks": Bounds(claims=2, sticks=True, requests=1, decisions=2),
    "its birth waits, and writes fail": Bounds(births=True, requests=2, faults=1, ends=0),
    "its birth waits, and a person decides": Bounds(births=True, decisions=2, requests=1, crashes=1, ends=0),
    "its birth waits, and it follows another": Bounds(births=True, follows=True, requests=1, refusals=1, ends=0),
    "its birth waits, and its service ends": Bounds(births=True, closes=True, crashes=1, requests=1, ends=0),
    "its disk was wiped, its birth waits, and it comes": Bounds(births=True, wiped=True, theirs=1, refusals=1, ends=0),
    "its disk is an old copy, and writes fail": Bounds(copies=1, requests=1, faults=1, ends=0),
    "its disk is an old copy, and it went on elsewhere": Bounds(copies=1, claims=1, decisions=1, ends=0),
    "its disk is an old copy, and it sticks": Bounds(copies=1, requests=1, sticks=True, ends=0),
    "its disk is an old copy, and its service ends": Bounds(copies=1, closes=True, crashes=1, ends=0),
    "its disk is an old copy while it is given away": Bounds(copies=1, offers=1, ends=0),
    "it comes, and its disk is an old copy": Bounds(visitor=True, theirs=1, copies=1, refusals=1),
    "it comes back, and had failed": Bounds(TEMPORARY, offers=1, theirs=1, spawns=1),
}
"""Seconds in all: searched by the tests too."""

DEEP: Final[Mapping[str, Bounds]] = {
    "given away twice, and fails": Bounds(offers=2, awards=2, refusals=1),
    "given away, written down, asked for, and writes fail": Bounds(
        offers=1, awards=2, requests=1, faults=1, checkpoints=True, errors=False
    ),
    "it comes back, is asked for, and writes fail": Bounds(offers=1, theirs=1, requests=1, faults=1, ends=0),
    "it comes back, its service ends, and writes fail": Bounds(
        offers=1, theirs=1, closes=True, faults=1, crashes=1, ends=0
    ),
    "it comes and goes, is asked for, and the agent crashes": Bounds(
        visitor=True, theirs=1, offers=2, requests=1, crashes=1, ends=0
    ),
    "asked for three times, and writes fail": Bounds(requests=3, ends=2, refusals=1, faults=1),
    "its record was lost, it comes twice, and writes fail": Bounds(
        lost=True, decisions=2, theirs=2, requests=1, faults=1
    ),
    "it follows another, and the agent crashes": Bounds(requests=1, follows=True, refusals=1, faults=1, crashes=1),
}
"""Minutes."""
