"""The measurements inside one agent: that they measure what they say, and count what is missing."""

from __future__ import annotations

import math

from benchmarks import fan_out, lateness, many_tasks
from benchmarks.figure import Figure, Plan, alone


def test_a_figure_without_a_baseline_is_judged_by_itself():
    (figure,) = alone(
        Plan(rounds=3), [Figure("x", "ms", wanted=3.0, absolute=True)], iter([[2.0], [5.0], [4.0]]).__next__
    )
    assert (figure.value, figure.baseline, figure.ratio, figure.spread) == (4.0, None, None, (2.0, 5.0))
    assert figure.is_missed


def test_what_a_driver_delivers_from_its_own_thread_all_arrives():
    (delivery_ns,) = fan_out.from_a_driver(packets=200)
    assert delivery_ns > 0


def test_both_kinds_of_many_tasks_come_to_run():
    for way in (many_tasks.of_a_service, many_tasks.bare_actors):
        start_ms, memory_mib = way(20)
        assert start_ms > 0 and memory_mib >= 0
    # What two agents take differs by less for so few tasks than it does by chance.
    assert all(map(math.isfinite, many_tasks.configured(20)))


def test_ticks_that_never_came_count_as_late():
    assert sorted(lateness.all_there([0.1, 0.2], tasks=2, rate_hz=1.0, duration_s=3.0)) == [0.1, 0.2, 3.0, 3.0]
