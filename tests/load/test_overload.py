"""A publisher ten times too fast, between real agents: boring.

Short; `scripts/torture load` measures the same for longer, with the times that are wanted. Here times are no more than
what tells a bounded queue from an unbounded one, on any machine.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from torture.overload import MEMORY_BYTES, Case, Seen, overload

SECONDS = 1.0
CALM = 0.1
"""A reader with a small share of the host still catches up at this share of the rate that it can bear otherwise."""


@pytest.mark.parametrize(
    "case",
    [
        Case("inside", 64, 2000),
        Case("inside", 1024 * 1024, 100),
        Case("over TCP", 64 * 1024, 200),
        Case("over TCP, on system", 64 * 1024, 200),
        Case("over TCP", 64, 2000, "reliable"),
    ],
    ids=lambda case: case.name,
)
def test_overload_costs_packets_and_nothing_else(tmp_path: Path, case: Case):
    """`overload` itself waits until the reader has caught up, and fails if it never does."""
    seen = overload(tmp_path, case, SECONDS, CALM)
    assert seen.memory_bytes <= MEMORY_BYTES
    assert seen.handled > 0
    # On a slow machine the publisher may be refused early enough that nothing falls out behind it.
    assert seen.published > seen.handled or seen.refused > 0
    assert_every_loss_is_told(seen)
    assert (seen.disordered, seen.doubled) == (0, 0)
    assert max(seen.control_s) < 2.0
    assert max(seen.late_s) < 1.0


def assert_every_loss_is_told(seen: Seen) -> None:
    """`pancakes task info` and `pancakes agent info` account for all that is missing."""
    assert seen.published - seen.handled <= sum(seen.dropped.values())


def test_overload_of_reliable_reader_loses_nothing(tmp_path: Path):
    seen = overload(tmp_path, Case("inside", 64, 2000, "reliable"), SECONDS, CALM)
    assert seen.refused > 0
    assert (seen.published, seen.dropped) == (seen.handled, {})
    assert (seen.disordered, seen.doubled) == (0, 0)
