"""What others may know of tasks and timers, from any thread."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from pancakes.control import Configure, Describe
from pancakes.kernel.registry import SettingsNote
from pancakes.task import Task, every
from pancakes.testing import Fleet


class Blink(Task):
    requires = ()

    @dataclass
    class Settings:
        colour: str = "red"

    @every(hz=2)
    def blink(self, tick):
        pass

    @every(hz=1)
    def rest(self, tick):
        pass


@pytest.fixture
def fleet():
    with Fleet(1) as made:
        yield made


def test_the_timers_of_an_actor_are_there_as_long_as_it_runs(fleet):
    agent = fleet.start("a", tasks={"Blink": Blink, "Other": Blink})
    timers = agent.kernel.task_timers
    fleet.run_for(1.0)
    assert [(timer.method, timer.ticks) for timer in timers.of("a/client/Blink")] == [("blink", 2), ("rest", 1)]
    assert {timer.component.address for timer in timers.all()} >= {"a/client/Blink", "a/client/Other"}
    agent.task("Blink").stop()
    fleet.run_for(0.0)
    assert timers.of("a/client/Blink") == ()
    assert [timer.method for timer in timers.of("a/client/Other")] == ["blink", "rest"]


def test_an_actor_that_ends_after_its_successor_has_begun_leaves_its_successors_timers_alone(fleet):
    agent = fleet.start("a", tasks={"Blink": Blink})
    timers, former = agent.kernel.task_timers, agent.task("Blink")
    former.stop()
    fleet.run_for(3.0)
    assert agent.task("Blink") is not former
    timers.remove(former)
    assert len(timers.of("a/client/Blink")) == 2


def test_a_service_enters_its_tasks_and_strikes_them_out_when_it_ends(fleet):
    agent = fleet.start("a", tasks={"Blink": {"type": Blink, "start": False}})
    tasks = agent.kernel.tasks
    entry = tasks.get("client", "Blink")
    assert entry is not None
    assert (entry.address, entry.life.word, entry.requires) == ("a/client/Blink", "stopped", ())
    assert [task.name for task in tasks.of("client")] == ["Blink"]
    assert entry in tasks.all() and tasks.get("client", "Blank") is None and tasks.of("cellar") == []
    agent.component("client").stop()
    fleet.run_for(0.0)
    assert tasks.get("client", "Blink") is not entry
    tasks.strike_out("log")
    assert tasks.of("log") == [] and tasks.of("network") != []
    tasks.strike_out("network", "Discovery")
    assert "Discovery" not in [task.name for task in tasks.of("network")] != []
    tasks.strike_out("cellar", "Wine")


def test_a_task_is_of_the_type_that_its_configuration_names_or_else_of_its_class(fleet):
    agent = fleet.start("a", tasks={"Blink": {"type": Blink}})
    assert agent.kernel.tasks.get("client", "Blink").type == agent.slot("Blink").spec.type != ""
    assert agent.kernel.tasks.get("network", "Discovery").type == "Discovery"


def test_the_settings_of_a_task_are_known_while_it_runs(fleet):
    agent = fleet.start("a", tasks={"Blink": Blink})
    tasks = agent.kernel.tasks
    assert tasks.settings_of("a/client/Blink").settings.colour == "red"
    assert agent.ask(Configure("Blink", {"colour": "blue"})).ok
    assert tasks.settings_of("a/client/Blink").plain == {"colour": "blue"}
    agent.task("Blink").settings = Blink.Settings("green")
    assert tasks.settings_of("a/client/Blink") == SettingsNote(Blink.Settings("green"))
    assert agent.ask(Describe("Blink")).result["settings"] == {"colour": "green"}
    agent.task("Blink").stop()
    fleet.run_for(0.0)
    assert tasks.settings_of("a/client/Blink") is None
