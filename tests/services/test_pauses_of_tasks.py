"""A task pauses itself: that and the freeze of a move do not end each other, and a frozen task runs nothing."""

from dataclasses import dataclass

import pytest

from pancakes.control import Migrate
from pancakes.devices import Load
from pancakes.kernel.actor import core_of
from pancakes.mesh.memory_network import Quality
from pancakes.task import Task, every
from pancakes.testing import Fleet


class Naps(Task):
    """Naps after each fifth tick, and counts in calls that it has left behind as well."""

    @dataclass
    class State:
        ticks: int = 0
        calls: int = 0

    def on_start(self):
        self.after(0.05, self.count)

    @every(hz=10)
    def tick(self, tick):
        self.state.ticks += 1
        if self.state.ticks % 5 == 0:
            self.pause()
            self.after(0.3, self.resume)

    def count(self):
        self.state.calls += 1
        self.publish("system", Load(float(self.state.calls)))
        self.after(0.05, self.count)


@pytest.fixture
def fleet():
    with Fleet(1, classes={"test.Naps": Naps}) as made:
        made.start("a", tasks={"Naps": Naps})
        made.start("b")
        made.connect()
        yield made


def test_task_that_paused_itself_goes_on_with_what_waits(fleet):
    a = fleet.agents["a"]
    fleet.run_for(0.65)
    asleep = a.task("Naps").state.ticks
    fleet.run_for(0.1)
    assert a.task("Naps").state.ticks == asleep == 5
    fleet.run_for(0.5)
    assert asleep < a.task("Naps").state.ticks <= 10


@pytest.mark.parametrize("begun_s", [0.2, 0.55, 0.65], ids=["awake", "before its nap", "napping"])
def test_freeze_outlives_the_end_of_a_pause(fleet, begun_s):
    """The migration takes longer than a nap: a resume in it, or another call, would act beside the copy."""
    a, b = fleet.agents["a"], fleet.agents["b"]
    fleet.network.set_quality("a", "b", Quality(latency_s=0.4))
    fleet.run_for(begun_s)
    assert a.ask(Migrate("Naps")).ok
    fleet.run_for(1.0)
    assert a.running() == []
    before, after = a.probe.packets(Load), b.probe.packets(Load)
    assert after[0].body.cpu == before[-1].body.cpu + 1


@pytest.mark.parametrize(("frozen_s", "rests"), [(0.1, True), (0.4, False)], ids=["in its nap", "beyond its nap"])
def test_pause_outlives_a_freeze_that_came_to_nothing(fleet, frozen_s, rests):
    fleet.run_for(0.55)
    core, task = core_of(fleet.agents["a"].task("Naps")), fleet.agents["a"].task("Naps")
    core.freeze()
    ticks, calls = task.state.ticks, task.state.calls
    fleet.run_for(frozen_s)
    assert (task.state.ticks, task.state.calls) == (ticks, calls)
    core.thaw()
    fleet.run_for(0.1)
    assert task.state.calls > calls, "what it had left behind was kept for it"
    assert (task.state.ticks == ticks) is rests
    fleet.run_for(0.5)
    assert task.state.ticks > ticks
