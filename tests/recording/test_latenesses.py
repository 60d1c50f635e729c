"""How late ticks were is counted while an agent is recorded, and percentiles are found in what was counted."""

import math
import random

import pytest

from pancakes.control import Start, Stop
from pancakes.recording.reader import RecordingReader
from pancakes.recording.task_statistics import (
    LEAST_S,
    MOST,
    STEP,
    Latenesses,
    TaskTicks,
    TickRun,
    TimerTicks,
    bucket_of,
    quantile_s,
    ticks_of,
)
from pancakes.task import Task, Tick, every
from pancakes.testing import Fleet
from pancakes.tools.report.performance import Rates


class Tick100(Task):
    @every(hz=100)
    def tick(self, tick):
        pass


def counted(values):
    counts: dict[int, int] = {}
    for value in values:
        counts[bucket_of(value)] = counts.get(bucket_of(value), 0) + 1
    return counts


def test_percentiles_are_found_to_within_ten_per_cent():
    draw = random.Random(1)
    values = sorted(draw.lognormvariate(-8.0, 1.5) for _ in range(10_000))
    counts = counted(values)
    for share in (0.5, 0.9, 0.99):
        assert quantile_s(counts, share) == pytest.approx(values[int(share * len(values))], rel=0.1)


def test_a_bucket_reaches_up_to_its_edge():
    for step in range(120):
        edge_s = LEAST_S * STEP**step
        assert bucket_of(edge_s * 0.999) == step
        assert bucket_of(edge_s * 1.001) == step + 1
    assert bucket_of(2e-6) == 4  # round numbers, such as there are in virtual time


def test_what_is_not_late_is_not_and_nothing_has_no_percentiles():
    assert quantile_s(counted([0.0, 0.0, 5e-7]), 0.99) == 0.0
    assert quantile_s({}, 0.5) is None


@pytest.fixture(scope="module")
def timer():
    with Fleet() as fleet:
        return fleet.start("a", tasks={"Tick100": Tick100}).component("client/Tick100").timers["tick"]


def test_lateness_of_each_tick_is_counted_once(timer):
    heard = Latenesses()
    for lateness_s in (0.0, 0.001, 0.001):
        heard.heard((timer, Tick(1.0, 0, lateness_s), 0.01))
    assert heard.take() == {timer: {0: 1, bucket_of(0.001): 2}}
    assert heard.take() == {}


def test_ticks_are_noted_as_runs(timer):
    """A late tick, a missed one and another period each begin a new run; a rounded deadline does not."""
    heard = Latenesses()
    for deadline_s in (0.1, 0.2, 0.30000000000000004):
        heard.heard((timer, Tick(deadline_s), 0.1))
    heard.heard((timer, Tick(0.6, 2), 0.1))
    heard.heard((timer, Tick(0.7, 0, 0.04), 0.1))
    heard.heard((timer, Tick(0.8, 0, 0.06), 0.1))
    heard.heard((timer, Tick(0.85), 0.05))
    heard.heard((timer, Tick(0.9, 0, 0.02), math.inf))
    heard.take()
    assert heard.runs == {
        timer: [
            TickRun(0.1, 0.1, 3, 0),
            TickRun(0.6, 0.1, 2, 2),
            TickRun(0.8, 0.1, 1, 0, 0.06),
            TickRun(0.85, 0.05, 1, 0),
            TickRun(0.9, 0.0, 1, 0, 0.02),
        ]
    }
    assert not heard.overflowed
    heard.take()
    assert heard.runs == {}


def test_ticks_are_told_of_described_tasks(timer):
    """In a recording of one task only of that one."""
    runs = {timer: [TickRun(0.1, 0.1, 3, 1, 0.06)]}
    told = TimerTicks("a/client/Tick100", "tick", ((0.1, 0.1, 3, 1, 0.06),))
    assert ticks_of(5, runs) == ticks_of(5, runs, "a/Tick100") == TaskTicks(5, (told,))
    assert ticks_of(6, runs, "a/Other") == TaskTicks(6, ())


def test_lost_ticks_are_told(timer):
    heard = Latenesses()
    for _ in range(MOST):
        heard.heard((timer, Tick(1.0), 0.01))
    heard.take()
    assert heard.overflowed
    heard.take()
    assert not heard.overflowed


def test_a_recording_holds_all_ticks_and_nobody_counts_once_it_has_ended(tmp_path):
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Tick100": Tick100})
        assert agent.ask(Start("log/Recorder", {"path": str(tmp_path / "r.mcap")})).ok
        fleet.run_for(5.0)
        assert agent.ask(Stop("log/Recorder")).ok
        assert agent.kernel.ticks_heard == ()
    rates = Rates()
    for entry in RecordingReader(tmp_path / "r.mcap").entries():
        if entry.packet.type == "task_figures":
            rates.add("a", entry.packet.body, entry.time_ns / 1e9)
    timer = rates.timers["a", "client/Tick100", "tick"]
    assert sum(timer.lateness_counts.values()) == pytest.approx(500, abs=105)  # up to the last sample, once a second
    assert (timer.lateness_quantile_s(0.5), timer.lateness_quantile_s(0.99)) == (0.0, 0.0)
