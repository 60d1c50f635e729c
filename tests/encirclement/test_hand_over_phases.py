"""A hand-over on the circle in a few phases; `test_hand_over_phases_full` has hundreds."""

from __future__ import annotations

from itertools import islice

from encirclement.hand_over import KHEPERA, PIONEER, HandOver, trouble_of


def test_hand_over_of_kheperas_touches_nothing() -> None:
    assert trouble_of(KHEPERA, range(25)) == {}


def test_hand_over_of_pioneers_touches_nothing() -> None:
    """They are larger and faster, and have sonars only."""
    assert trouble_of(PIONEER, range(25)) == {}


def test_hand_over_by_the_laws_only_runs_into_things() -> None:
    crashed = (seed for seed in range(40) if HandOver(KHEPERA, seed, looks=False).run())
    assert len(list(islice(crashed, 3))) == 3
