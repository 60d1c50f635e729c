"""Which neighbour gets the task, by what its cost is made of."""

import math

import pytest

from pancakes.control import Migrate
from pancakes.devices import Battery
from pancakes.migration import Cost
from pancakes.packet import NEIGHBOURS, Packet
from pancakes.task import Task
from pancakes.testing import Fleet


class Rover(Task):
    pass


BATTERY = {"battery": "null.battery"}


@pytest.fixture
def fleet():
    """`a` has the task; `b` has nothing else to do but half a battery; `c` has a task, and a full one."""
    with Fleet(4, classes={"test.Rover": Rover}) as made:
        made.start("a", tasks={"Rover": Rover})
        made.start("b", devices=BATTERY)
        made.start("c", devices=BATTERY, tasks={"Other": Task})
        made.connect()
        for name, level in (("b", 0.5), ("c", 1.0)):
            made.agents[name].publish("system", Battery(12.0, level))
        made.run_for(1.5)
        yield made


def lines(reply):
    return {line["peer"]: line for line in reply.result["lines"]}


@pytest.mark.parametrize(
    ("cost", "winner", "text"),
    [
        ("tasks", "b", "tasks"),
        ("battery", "c", "battery"),
        ({"tasks": 1.0, "battery": 1.0}, "b", "1 tasks + 1 battery"),
        ({"tasks": 1.0, "battery": 3.0}, "c", "1 tasks + 3 battery"),
    ],
)
def test_the_weights_decide(fleet, cost, winner, text):
    reply = fleet.agents["a"].ask(Migrate("Rover", cost=cost, dry_run=True))
    assert (reply.result["winner"], reply.result["cost"]) == (winner, text)


def test_a_peer_that_tells_of_its_battery_changes_no_bid_of_another(fleet):
    heard: list[Packet] = []
    fleet.agents["b"].kernel.stream.tap("system", heard.append, ("battery",))
    fleet.agents["c"].publish("system", Battery(12.0, 1.0), to=NEIGHBOURS)
    fleet.run_for(1.5)
    assert [packet.source.split("/")[0] for packet in heard] == ["c"]
    reply = fleet.agents["a"].ask(Migrate("Rover", cost="battery", dry_run=True))
    assert lines(reply)["b"]["terms"] == {"battery used": 0.5}


def test_a_task_that_asks_for_its_own_move_says_what_counts(fleet):
    a = fleet.agents["a"]
    rover = a.task("Rover")
    rover.call(lambda: rover.migrate(cost={"tasks": 1.0, "battery": 3.0}))
    account = a.wait_for_event("migration", winner="c")
    assert account["cost"] == "1 tasks + 3 battery"
    assert fleet.agents["c"].running() == ["Other", "Rover"]


def test_the_ledger_has_every_term_weighted(fleet):
    reply = fleet.agents["a"].ask(Migrate("Rover", cost={"tasks": 1.0, "battery": 3.0}, dry_run=True))
    assert lines(reply)["b"]["terms"] == {"tasks: active tasks": 0.0, "battery: battery used": 1.5}
    assert lines(reply)["b"]["cost"] == 1.5


def test_in_virtual_time_there_is_no_load_and_the_link_is_the_networks(fleet):
    reply = fleet.agents["a"].ask(Migrate("Rover", cost={"load": 1.0, "link": 1.0}, dry_run=True))
    for line in lines(reply).values():
        assert [line["terms"][f"load: {term}"] for term in ("agent", "host", "lateness")] == [0.0, 0.0, 0.0]
        assert 0.0 < line["terms"]["link: round trip"] < 0.1


def test_an_unknown_round_trip_is_a_refusal(fleet):
    fleet.agents["b"].agent.mesh.rtt_s = lambda peer: None
    reply = fleet.agents["a"].ask(Migrate("Rover", cost="link"))
    assert reply.result["winner"] == "c"
    assert lines(reply)["b"]["reason"] == (
        "cannot tell its cost: its round trip to the source has not been measured yet"
    )


def test_a_battery_that_was_never_read_is_a_refusal_and_no_battery_is_free(fleet):
    fleet.start("d", devices=BATTERY)
    fleet.start("e")
    fleet.connect()
    reply = fleet.agents["a"].ask(Migrate("Rover", cost="battery", dry_run=True))
    assert lines(reply)["d"]["reason"] == "cannot tell its cost: its battery has not been read yet"
    assert lines(reply)["e"]["terms"] == {"battery used": 0.0}


def test_weights_that_are_none_are_refused_to_whoever_asks(fleet):
    a = fleet.agents["a"]
    assert a.ask(Migrate("Rover", cost={"tasks": math.inf})).reason == (
        "a/client/Rover cannot move: cost.tasks: a weight is a finite number of at least 0, not inf"
    )
    assert "names no cost function" in a.ask(Migrate("Rover", cost={})).reason
    assert "b: knows no cost function 'charm'" in a.ask(Migrate("Rover", cost={"charm": 1.0})).reason
    assert a.running() == ["Rover"]


def test_a_rule_weighs_too():
    rule = {"when": "battery", "below": 0.65, "cost": {"tasks": 1.0, "battery": 3.0}}
    with Fleet(4, classes={"test.Rover": Rover}) as fleet:
        a = fleet.start("a", tasks={"Rover": {"type": Rover, "migrate": rule}})
        fleet.start("b", devices=BATTERY)
        c = fleet.start("c", devices=BATTERY, tasks={"Other": Task})
        fleet.connect()
        fleet.agents["b"].publish("system", Battery(12.0, 0.76))
        c.publish("system", Battery(12.0, 1.0))
        fleet.run_for(0.1)
        a.publish("system", Battery(12.0, 0.6))
        fleet.run_for(1.0)
        # 0.72 for b, 1 for c: with the weight 5 it would be c.
        assert fleet.agents["b"].running() == ["Rover"]
        assert a.events("migration_asked")[0]["cost"] == "1 tasks + 3 battery"
        # The rule has moved on with its task, weights included.
        moved = fleet.agents["b"].slot("Rover").spec.rule
        assert moved is not None and moved.cost == {"tasks": 1.0, "battery": 3.0}


@pytest.mark.parametrize("error", [ZeroDivisionError("by nought"), SystemExit(3)])
def test_a_function_that_fails_refuses_and_harms_nobody(error: BaseException):
    class Broken(Cost):
        name = "broken"

        def terms(self, asked):
            raise error

    with Fleet(4, classes={"test.Rover": Rover, "broken": Broken}) as fleet:
        a = fleet.start("a", tasks={"Rover": Rover})
        fleet.start("b")
        fleet.connect()
        reason = a.ask(Migrate("Rover", cost={"broken": 2.0})).reason
        assert f"its cost function '2 broken' failed: {type(error).__name__}: {error}" in reason


@pytest.mark.parametrize("error", [ZeroDivisionError("by nought"), SystemExit(3)])
def test_a_function_that_cannot_be_made_is_not_known(error: BaseException):
    class Unmade(Cost):
        name = "unmade"

        def __init__(self):
            raise error

        def terms(self, asked):
            return {}

    with Fleet(4, classes={"test.Rover": Rover, "unmade": Unmade}) as fleet:
        a = fleet.start("a", tasks={"Rover": Rover})
        fleet.start("b")
        fleet.connect()
        assert "b: knows no cost function 'unmade'" in a.ask(Migrate("Rover", cost="unmade")).reason
