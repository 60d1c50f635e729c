"""The bounds of the searches: those of every run, and the larger ones."""

from __future__ import annotations

from typing import Final

from model.parts import Bounds

SUITE: Final = (
    Bounds(offers=1, packets=2),
    Bounds(),
    Bounds(offers=3, reserve=False, refusals=False),
    Bounds(offers=1, packets=2, durability="lazy"),
    Bounds(durability="lazy"),
    Bounds(agents=3, offers=1, packets=2),
    Bounds(agents=3, reserve=False),
    Bounds(offers=1, packets=2, faults=2),
    Bounds(faults=1),
    Bounds(offers=1, packets=2, faults=2, durability="lazy"),
    Bounds(offers=1, packets=2, restarts=1, stops=True),
    Bounds(offers=1, packets=2, restarts=1, stops=True, durability="lazy"),
    Bounds(offers=1, restarts=1, stops=True, faults=1),
    Bounds(offers=1, restarts=2, stops=True, faults=1, durability="lazy"),
    Bounds(offers=1, restarts=1, stops=True, late=True),
    Bounds(offers=1, restarts=1, stops=True, late=True, durability="lazy"),
    Bounds(wipes=1),
    Bounds(wipes=1, adopt=True),
    Bounds(agents=3, offers=1, wipes=1, adopt=True),
)
"""Seconds in all: searched by the tests too."""

DEEP: Final = (
    Bounds(offers=3),
    Bounds(offers=3, durability="lazy"),
    Bounds(offers=4, reserve=False, refusals=False),
    Bounds(agents=3),
    Bounds(agents=3, offers=3, reserve=False, refusals=False),
    Bounds(agents=4, reserve=False, refusals=False),
    Bounds(packets=2, faults=2),
    Bounds(restarts=1, stops=True, late=True, durability="lazy"),
    Bounds(packets=2, reserve=False, restarts=1, stops=True, late=True),
    Bounds(reserve=False, restarts=1, stops=True, late=True, faults=1),
    Bounds(offers=3, wipes=1, reserve=False, adopt=True),
    Bounds(wipes=2, adopt=True),
    Bounds(agents=3, reserve=False, wipes=1, adopt=True),
)
"""Minutes, and some gigabytes of memory."""
