"""A halt: all actuators of a fleet are stopped, also those of agents that come later, until a person ends it."""

from __future__ import annotations

import pytest

from pancakes.control import Describe, EndHalt, Halt
from pancakes.devices import Twist
from pancakes.devices.driver import Actuator
from pancakes.journal import JournalEntry
from pancakes.mesh.memory_network import Quality
from pancakes.packet import NETWORK
from pancakes.services.halt import HaltTold
from pancakes.task import Task, every
from pancakes.testing import Fleet


class Wheels(Actuator):
    """Writes down what it is told, for all agents."""

    type = "motors"
    told: dict[str, list] = {}

    def open(self):
        self.mine = self.told.setdefault(self.context.agent, [])

    def write(self, command, ttl_s, source):
        self.mine.append((self.context.now(), command.v_mps))

    def safe_stop(self):
        self.mine.append((self.context.now(), 0.0))


class Driving(Task):
    requires = ("motors",)

    @every(hz=20)
    def drive(self, tick):
        self.publish("ctrl", Twist(0.1, 0.0))


@pytest.fixture
def fleet():
    Wheels.told = {}
    with Fleet(seed=4) as made:
        yield made


def robots(fleet, *names, **agent):
    made = [fleet.start(name, devices={"motors": Wheels}, tasks={"Driving": Driving}, **agent) for name in names]
    fleet.run_for(1.0)
    return made


def moving(name):
    return bool(Wheels.told.get(name)) and Wheels.told[name][-1][1] > 0.0


def person(fleet, name="alice"):
    made = fleet.start(name, role="client")
    fleet.run_for(1.0)
    return made


def test_halt_of_one_agent_spreads_to_all(fleet):
    a, b, c = robots(fleet, "a", "b", "c")
    assert all(map(moving, "abc"))
    began_s = fleet.now()
    reply = a.ask(Halt("a child on the field"))
    assert reply.ok
    assert (reply.result["actuators"], reply.result["late"], reply.result["not_on_disk"]) == (["motors"], [], "")
    assert reply.result["halt"]["reason"] == "a child on the field"
    fleet.run_for(2.0)
    for name, agent in zip("abc", (a, b, c), strict=True):
        assert not moving(name)
        assert Wheels.told[name][-1][0] - began_s < 0.5, "it stands within half a second"
        (event,) = agent.events("halted")
        assert event["reason"] == "a child on the field" and event["by"].startswith("a/")
        described = agent.ask(Describe()).result
        assert described["halt"]["id"] == reply.result["halt"]["id"]
        assert [it["rest"] for it in described["tasks"] if it["task"] == "motors"] == ["halted"]
        (refused,) = agent.events("command_refused")
        assert refused["reason"] == "halted by a: a child on the field"
        assert agent.running() == ["Driving"], "tasks keep running"


def test_only_a_person_ends_a_halt(fleet):
    a, b = robots(fleet, "a", "b")
    alice = person(fleet)
    assert alice.ask(Halt(), to="a").ok
    fleet.run_for(1.0)
    for asker, to in ((a, ""), (b, "a")):
        reply = asker.ask(EndHalt(), to=to)
        assert reply.refusal.code == "forbidden" and "only a person ends a halt" in reply.reason
    assert not moving("a")
    assert alice.ask(EndHalt(dry_run=True), to="a").ok and not moving("a")
    assert alice.ask(EndHalt(), to="a").ok
    fleet.run_for(3.0)
    assert moving("a") and not moving("b"), "it ends where a person ends it, although b is still halted"
    assert alice.ask(EndHalt(), to="a").reason == "a is not halted"
    assert alice.ask(EndHalt(), to="b").ok
    fleet.run_for(1.0)
    assert moving("b")
    assert alice.ask(Halt(), to="b").ok, "a later halt counts again"
    fleet.run_for(1.0)
    assert not moving("a") and not moving("b")


def test_halt_survives_restarts_and_reaches_newcomers(fleet):
    a, _ = robots(fleet, "a", "b")
    assert a.ask(Halt()).ok
    fleet.run_for(1.0)
    fleet.crash("a")
    fleet.stop("b")
    Wheels.told.clear()
    a = fleet.restart("a")
    fleet.run_for(1.0)
    assert not moving("a")
    assert a.ask(Describe()).result["halt"]["by"].startswith("a/")
    assert "all actuators of a are stopped, halted by a" in a.lines("warning")
    robots(fleet, "c")
    fleet.run_for(1.0)
    assert not moving("c")
    alice = person(fleet)
    assert alice.ask(EndHalt(), to="a").ok and alice.ask(EndHalt(), to="c").ok
    fleet.crash("a")
    fleet.restart("a")
    fleet.run_for(2.0)
    assert moving("a"), "its end survives as well"
    fleet.restart("b")
    fleet.run_for(2.0)
    assert moving("a") and not moving("b"), "b slept over the end, and cannot halt the others again"


def test_halt_reaches_an_agent_behind_a_cut_once_it_heals(fleet):
    a, _, _ = robots(fleet, "a", "b", "c")
    fleet.faults.cut("c")
    assert a.ask(Halt()).ok
    fleet.run_for(1.0)
    assert not moving("b") and moving("c")
    fleet.faults.calm()
    fleet.run_for(15.0)
    assert not moving("c")


def test_halt_of_a_named_agent_stays_there(fleet):
    a, _ = robots(fleet, "a", "b")
    assert a.ask(Halt("try it", spread=False)).ok
    fleet.run_for(2.0)
    assert not moving("a") and moving("b")


def test_second_halt_leaves_the_first(fleet):
    """Unless that was for one agent, and this is for all."""
    a, b = robots(fleet, "a", "b")
    assert a.ask(Halt("first", spread=False)).ok
    assert a.ask(Halt("second", spread=False)).result["halt"]["reason"] == "first"
    fleet.run_for(1.0)
    assert moving("b")
    told = a.ask(Halt("for all")).result["halt"]
    assert told["reason"] == "for all"
    fleet.run_for(1.0)
    assert not moving("b")
    reply = b.ask(Halt("again"))
    assert reply.ok and (reply.result["halt"]["id"], reply.result["halt"]["reason"]) == (told["id"], "for all")


def test_halt_over_slow_links_is_in_time():
    """Each packet is late by up to what TCP needs to send a lost one again."""
    Wheels.told = {}
    with Fleet(seed=5, quality=Quality(latency_s=0.005, jitter_s=0.2)) as fleet:
        a, *_ = robots(fleet, "a", "b", "c", "d")
        fleet.run_for(5.0)
        began_s = fleet.now()
        assert a.ask(Halt()).ok
        fleet.run_for(3.0)
        for name in "abcd":
            assert not moving(name) and Wheels.told[name][-1][0] - began_s < 0.5


def test_halt_is_told_again_by_an_agent_that_died_before_it_reached_the_others():
    """Also over slow links: it is on disk before it is answered."""
    Wheels.told = {}
    with Fleet(seed=5, quality=Quality(latency_s=0.05, jitter_s=0.2)) as fleet:
        a, *_ = robots(fleet, "a", "b", "c")
        fleet.run_for(5.0)
        fleet.faults.cut("a")
        assert a.ask(Halt()).ok
        fleet.crash("a")
        fleet.run_for(2.0)
        assert moving("b") and moving("c"), "they have not heard of it"
        fleet.faults.calm()
        fleet.restart("a")
        assert fleet.run_until(lambda: not any(map(moving, "abc")), 20.0)
        fleet.run_for(2.0)
        assert not any(map(moving, "abc"))


def test_dry_run_of_a_halt_moves_on(fleet):
    (a,) = robots(fleet, "a")
    reply = a.ask(Halt(dry_run=True))
    assert reply.ok and reply.result["halt"] is None
    fleet.run_for(0.5)
    assert moving("a") and a.ask(Describe()).result["halt"] is None


ACCESS = """
[[access.allow]]
who = ["role:agent"]
may = ["look", "publish"]
[[access.allow]]
who = ["role:operator"]
may = ["halt"]
"""


def test_halt_needs_its_right(fleet):
    a = fleet.start("a", ACCESS, devices={"motors": Wheels}, tasks={"Driving": Driving})
    (b,) = robots(fleet, "b")
    alice = person(fleet)
    assert b.ask(Halt()).ok
    fleet.run_for(1.0)
    assert moving("a") and not moving("b")
    (line,) = [it for it in a.lines("warning") if "asks for a halt" in it]
    assert "b asks for a halt, which is refused" in line and "lacks the right 'halt'" in line
    assert b.ask(Halt(), to="a").refusal.code == "forbidden"
    assert alice.ask(Halt(), to="a").ok
    assert alice.ask(EndHalt(), to="a").refusal.code == "forbidden", "its end needs the right to change"


def test_halt_that_is_not_on_disk_is_told(fleet):
    (a,) = robots(fleet, "a")
    fleet.faults.fill_disk("a")
    reply = a.ask(Halt())
    assert reply.ok and reply.result["not_on_disk"] and reply.result["actuators"] == ["motors"]
    assert a.ask(Halt()).result["not_on_disk"] == reply.result["not_on_disk"]
    fleet.run_for(0.5)
    assert not moving("a")


def test_second_halt_is_answered_when_the_first_is_on_disk(fleet):
    a, b = robots(fleet, "a", "b")
    fleet.faults.slow_disk("b", 0.6)
    assert a.ask(Halt()).ok
    fleet.run_for(0.1)
    reply = b.ask(Halt("again"))
    assert reply.ok and (reply.result["halt"]["origin"], reply.result["not_on_disk"]) == ("a", "")


def test_damaged_record_of_a_halt_halts(fleet):
    robots(fleet, "a")
    fleet.journals["a"].write([JournalEntry("halt", "newest", b"nonsense")])
    fleet.crash("a")
    a = fleet.restart("a")
    fleet.run_for(1.0)
    assert "its record of halts cannot be read" in a.ask(Describe()).result["halt"]["reason"]
    assert a.ask(Describe()).result["halt"]["spread"] is False


@pytest.mark.parametrize("halt", [("", "b"), ("x" * 201, "b"), ("x", "b" * 201)])
def test_odd_name_of_a_halt_is_not_taken(fleet, halt):
    a, b = robots(fleet, "a", "b")
    b.publish(NETWORK, HaltTold(halt[0], halt[1], "b", ""), to="a/kernel")
    fleet.run_for(1.0)
    assert moving("a") and a.ask(Describe()).result["halt"] is None


def test_halt_reaches_an_agent_that_was_halted_more_often(fleet):
    """Also an agent behind it, and those of a fleet that a new agent halts."""
    a, _ = robots(fleet, "a", "b")
    alice = person(fleet)
    for _ in range(3):
        assert alice.ask(Halt(spread=False), to="b").ok and alice.ask(EndHalt(), to="b").ok
    assert a.ask(Halt()).ok
    fleet.run_for(1.0)
    assert not moving("b")
    assert alice.ask(EndHalt(), to="a").ok and alice.ask(EndHalt(), to="b").ok
    (c,) = robots(fleet, "c")
    assert moving("a") and moving("b") and moving("c")
    assert c.ask(Halt()).ok
    fleet.run_for(1.0)
    assert not (moving("a") or moving("b"))


def test_halt_that_began_meanwhile_is_not_ended(fleet):
    a, _ = robots(fleet, "a", "b")
    alice = person(fleet)
    first = a.ask(Halt()).result["halt"]["id"]
    assert alice.ask(EndHalt(), to="a").ok and a.ask(Halt("a child")).ok
    reply = alice.ask(EndHalt(id=first), to="a")
    assert reply.refusal.code == "conflict" and "a child" in reply.reason
    fleet.run_for(1.0)
    assert not moving("a")


def test_halt_is_on_disk_once_there_is_room(fleet):
    (a,) = robots(fleet, "a")
    free = fleet.faults.fill_disk("a")
    assert a.ask(Halt()).result["not_on_disk"]
    free()
    assert a.ask(Halt()).result["not_on_disk"] == "", "it is written again when somebody asks"
    fleet.crash("a")
    fleet.restart("a")
    Wheels.told.clear()
    fleet.run_for(2.0)
    assert not moving("a")


def test_virtual_actuator_stands_if_its_target_is_halted(fleet):
    fleet.start("a", devices={"motors": Wheels})
    far = {"far": {"type": "network.motors", "settings": {"target": "a/device/motors"}}}
    fleet.start("b", devices=far, tasks={"Driving": Driving})
    fleet.run_for(1.0)
    assert moving("a")
    assert fleet.agents["a"].ask(Halt(spread=False)).ok
    fleet.run_for(1.0)
    assert not moving("a")
