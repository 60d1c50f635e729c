"""A task keeps the settings that were set; what was not goes by the class as it is now."""

from dataclasses import dataclass, field

import pytest

from pancakes.control import Configure, Migrate
from pancakes.task import Task, every
from pancakes.testing import Fleet


class Circle(Task):
    @dataclass
    class Settings:
        radius_m: float = 0.5
        speed_mps: float = 0.1
        gains: list[float] = field(default_factory=lambda: [1.0, 2.0])

    @dataclass
    class State:
        n: int = 0

    @every(hz=10)
    def tick(self, tick):
        self.state.n += 1


class Later(Circle):
    @dataclass
    class Settings:
        radius_m: float = 0.8
        speed_mps: float = 0.2
        gains: list[float] = field(default_factory=lambda: [3.0])


TASKS = {"Circle": {"type": "test.Circle", "settings": {"speed_mps": 0.1}}}


@pytest.mark.parametrize("goes_elsewhere", [False, True])
def test_new_version_brings_its_defaults_to_a_task_that_goes_on(goes_elsewhere):
    with Fleet(classes={"test.Circle": Circle}) as fleet:
        a = fleet.start("a", tasks=TASKS)
        fleet.start("b")
        fleet.connect()
        fleet.run_for(2.0)
        where = "b" if goes_elsewhere else "a"
        if goes_elsewhere:
            assert a.ask(Migrate("Circle")).ok
        assert fleet.agents[where].ask(Configure("Circle", {"gains": [5.0]})).ok
        fleet.run_for(2.0)
        before = fleet.agents[where].task("Circle").state.n
        fleet.crash(where)
        later = fleet.start(where, tasks=TASKS if where == "a" else {}, classes={"test.Circle": Later})
        fleet.run_for(1.0)
        task = later.task("Circle")
        assert type(task) is Later and task.state.n > before - 15
        settings = task.settings
        assert (settings.radius_m, settings.speed_mps, settings.gains) == (0.8, 0.1, [5.0])
