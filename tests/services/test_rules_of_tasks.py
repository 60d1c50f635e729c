"""Rules by which tasks move by themselves, where an agent has several."""

import pytest

from pancakes.control import Start, Stop
from pancakes.devices import Battery
from pancakes.packet import NEIGHBOURS, Packet
from pancakes.task import Task
from pancakes.testing import Fleet


class Plain(Task):
    """Does nothing."""


class Other(Plain):
    """Likewise."""


def test_a_reading_is_compared_with_the_rules_about_its_type_alone():
    """Both rules look at a field of the same name."""
    about_load = {"type": Plain, "migrate": {"when": "load", "field": "level", "below": 0.65}}
    about_battery = {"type": Other, "migrate": {"when": "battery", "below": 0.3}}
    with Fleet(3) as fleet:
        a = fleet.start("a", tasks={"Plain": about_load, "Other": about_battery})
        fleet.start("b")
        fleet.connect()
        a.publish("system", Battery(11.0, 0.5))
        fleet.run_for(2.0)
        assert a.events("migration_asked") == []
        a.publish("system", Battery(11.0, 0.2))
        fleet.run_for(2.0)
        assert [event["task"] for event in a.events("migration_asked")] == ["Other"]


def test_the_reading_of_another_agent_moves_no_task():
    with Fleet(3) as fleet:
        a = fleet.start("a", tasks={"Other": {"type": Other, "migrate": {"when": "battery", "below": 0.3}}})
        b = fleet.start("b")
        fleet.connect()
        heard: list[Packet] = []
        a.kernel.stream.tap("system", heard.append, ("battery",))
        b.publish("system", Battery(11.0, 0.2), to=NEIGHBOURS)
        fleet.run_for(2.0)
        assert [packet.source.split("/")[0] for packet in heard] == ["b"]
        assert a.events("migration_asked") == []


def test_a_rule_that_was_refused_says_so_once_and_asks_again_after_a_minute():
    with Fleet(3) as fleet:
        rule = {"when": "battery", "below": 0.3}
        a = fleet.start("a", tasks={"Other": {"type": Other, "migrate": rule}})
        fleet.start("b")
        fleet.connect()
        assert a.ask(Stop("network")).ok
        for _ in range(5):
            a.publish("system", Battery(11.0, 0.2))
            fleet.run_for(1.0)
        refused = "a/client/Other cannot move: the Network Service of a is stopped"
        assert [line for line in a.lines("warning") if "the rule of" in line] == [
            f"the rule of a/client/Other could not move it: {refused}"
        ]
        assert a.ask(Start("network")).ok
        fleet.connect()
        a.publish("system", Battery(11.0, 0.2))
        fleet.run_for(2.0)
        assert a.running() == ["Other"], "a minute has not passed"
        fleet.run_for(60.0)
        a.publish("system", Battery(11.0, 0.2))
        fleet.run_for(2.0)
        assert a.running() == [] and fleet.agents["b"].running() == ["Other"]


class Circle(Plain):
    """Drives, as long as there is power."""

    requires = ("motors",)


class GoCharge(Circle):
    """Drives home."""


MOTORS = {"Motors": {"driver": "null.motors"}}


def test_where_no_agent_can_take_a_task_another_starts_in_its_place():
    with Fleet(3) as fleet:
        rule = {"when": "battery", "below": 0.3, "otherwise": "GoCharge"}
        tasks = {"Circle": {"type": Circle, "migrate": rule}, "GoCharge": {"type": GoCharge, "start": False}}
        a = fleet.start("a", tasks=tasks, devices=MOTORS)
        assert a.running() == ["Circle"]
        a.publish("system", Battery(11.0, 0.2))
        fleet.run_for(10.0)
        assert a.running() == ["GoCharge"]
        assert "a/client/Circle is stopped, and a/client/GoCharge starts in its place" in a.lines("warning")
        # It is wanted so: also after a reboot it is not the low robot that drives on.
        fleet.stop("a")
        assert fleet.restart("a").running() == ["GoCharge"]


def test_another_task_starts_only_where_no_agent_takes_the_first():
    with Fleet(3) as fleet:
        rule = {"when": "battery", "below": 0.3, "otherwise": "GoCharge"}
        tasks = {"Circle": {"type": Circle, "migrate": rule}, "GoCharge": {"type": GoCharge, "start": False}}
        a = fleet.start("a", tasks=tasks, devices=MOTORS)
        b = fleet.start("b", devices=MOTORS)
        fleet.connect()
        b.publish("system", Battery(12.0, 0.9))
        a.publish("system", Battery(11.0, 0.2))
        fleet.run_for(10.0)
        assert (a.running(), b.running()) == ([], ["Circle"])


def test_a_rule_asks_again_when_it_says():
    with Fleet(3) as fleet:
        rule = {"when": "battery", "below": 0.3, "again_s": 5.0}
        a = fleet.start("a", tasks={"Other": {"type": Other, "migrate": rule}})
        for _ in range(24):
            a.publish("system", Battery(11.0, 0.2))
            fleet.run_for(0.5)
        assert 2 <= len([line for line in a.lines("warning") if "stays on a" in line]) <= 3


def test_a_task_that_ends_itself_has_another_start_once_its_actuators_are_free():
    with Fleet(3) as fleet:
        tasks = {"Circle": {"type": Circle, "start": False}, "GoCharge": GoCharge}
        a = fleet.start("a", tasks=tasks, devices=MOTORS)
        a.task("GoCharge").publish("sysctrl", Stop("GoCharge", then="Circle"))
        fleet.run_for(10.0)
        assert a.running() == ["Circle"]
        fleet.stop("a")
        assert fleet.restart("a").running() == ["Circle"]


def is_followed_after_a_death(how, steps):
    """Check that one of the two runs, and what was stopped stays stopped, if the agent dies so many steps later."""
    with Fleet(3) as fleet:
        rule = {"migrate": {"when": "battery", "below": 0.3, "otherwise": "Circle"}} if how == "rule" else {}
        tasks = {"Circle": {"type": Circle, "start": False}, "GoCharge": {"type": GoCharge, **rule}}
        a = fleet.start("a", tasks=tasks, devices=MOTORS)
        fleet.run_for(1.0)
        if how == "rule":
            a.publish("system", Battery(11.0, 0.2))
            while not a.lines("warning"):
                assert fleet.dispatcher.step()
        else:
            a.publish("sysctrl", Stop("GoCharge", then="Circle"))
        for _ in range(steps):
            fleet.dispatcher.step()
        fleet.crash("a")
        a = fleet.restart("a")
        fleet.run_for(10.0)
        (runs,) = a.running()
        assert a.ask(Stop(runs)).ok
        fleet.run_for(10.0)
        assert a.running() == [], f"{runs} ran, and the other one was still wanted"
        return runs


@pytest.mark.parametrize("how", ["command", "rule"])
def test_a_stop_and_what_follows_it_are_one_wherever_the_agent_dies(how):
    assert {is_followed_after_a_death(how, steps) for steps in (*range(12), 20, 40)} == {"GoCharge", "Circle"}


def test_a_stop_is_refused_if_what_should_follow_cannot():
    with Fleet(3) as fleet:
        tasks = {"Circle": {"type": Circle, "start": False}, "Plain": Plain, "Other": Other}
        a = fleet.start("a", tasks=tasks)
        refusals = {it: a.ask(Stop("Plain", then=it)) for it in ("Circle", "Other", "Plain", "Nothing")}
        codes = {it: reply.refusal.code for it, reply in refusals.items() if reply.refusal is not None}
        assert codes == {"Circle": "unable", "Other": "conflict", "Plain": "invalid", "Nothing": "not_found"}
        assert "only a task can be followed by one" in a.ask(Stop("client", then="Circle")).reason
        assert a.running() == ["Plain", "Other"]


def test_a_stop_that_is_only_tried_starts_nothing():
    with Fleet(3) as fleet:
        a = fleet.start("a", tasks={"Circle": {"type": Circle, "start": False}, "GoCharge": GoCharge}, devices=MOTORS)
        assert a.ask(Stop("GoCharge", dry_run=True, then="Circle")).ok
        fleet.run_for(10.0)
        assert a.running() == ["GoCharge"]
        assert a.ask(Stop("GoCharge")).ok
        fleet.run_for(10.0)
        assert a.running() == []
