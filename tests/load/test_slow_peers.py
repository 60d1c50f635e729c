"""One peer that stops, or hardly reads, in a fleet under load. `scripts/torture load` measures the others' p99."""

from __future__ import annotations

from pathlib import Path

import pytest
from torture.slow_peers import slow_peer


@pytest.mark.parametrize(("how", "closed_s"), [("stopped", 2.0), ("1 byte/s", 5.0), ("nothing", 5.0)])
def test_a_slow_peer_is_closed_and_comes_back_and_the_others_go_on(tmp_path: Path, how: str, closed_s: float):
    seen = slow_peer(tmp_path, how, rounds=1, span_s=1.0)
    # A process that is stopped sends no heartbeats; one that reads nothing may send them for ever.
    # Its last heartbeat may have come half a second before, and late where the machine is busy.
    assert closed_s - 1.0 <= seen.closed_s[0] <= closed_s + 5.0
    assert seen.joined_s[0] < 10.0
    assert seen.p99_s[0] < closed_s  # the others do not wait for that
