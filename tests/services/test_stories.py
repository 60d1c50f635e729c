"""Stories of tasks, message by message: where a rule changes, what changes between agents can be read here.

Each is in a file beside this one, `story_of_a_guarded_task.txt`, say.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from pprint import pformat
from typing import Any

import pytest
from services.numbered import SINK, Numbered, Sink

from pancakes.control import (
    Adopt,
    Begin,
    Checkpoints,
    Configure,
    Describe,
    Follow,
    Forget,
    Guarding,
    Migrate,
    Migrations,
    ReloadKeys,
    Reschedule,
    Restart,
    Revive,
    Shutdown,
    Start,
    Stop,
    Unfollow,
)
from pancakes.creation import Create, Remove
from pancakes.events import Event, LogLine
from pancakes.mesh.guarding.guard_messages import CheckpointId
from pancakes.mesh.migration.record import Phase, TaskId
from pancakes.packet import LOG, NETWORK, Packet
from pancakes.task import Task, Tick, every
from pancakes.testing import FleetInTest

SHOWN = ("offer", "epoch", "promised", "beat", "checkpoint", "no", "runs", "refusal", "reason", "by", "to", "told")
LEFT_OUT = ("traceback", "bytes_in", "bytes_out", "life")
GUARDED = {"guard": 3, "lease_s": 4.0, "checkpoint_s": 2.0}


class Slow(Task):
    """Changes its state as often as it is written down."""

    @dataclass
    class Settings:
        step: int = 1

    @dataclass
    class State:
        n: int = 0

    state: State

    @every(hz=0.5)
    def tick(self, tick: Tick) -> None:
        self.state.n += self.settings.step


class Frail(Slow):
    """Fails as soon as it has something to do."""

    @every(hz=2.0)
    def tick(self, tick: Tick) -> None:
        raise ValueError("too much")


def told_in(body: Any) -> str:
    """Returns what counts in a message: neither the names of others nor what is encoded."""
    if isinstance(body, Event):
        fields = [f"{name}={body.fields[name]}" for name in sorted(body.fields) if name in SHOWN]
        return " ".join([body.kind, *fields])
    if isinstance(body, LogLine):
        return body.text if body.level in ("warning", "error") else ""
    fields = [
        f"{name}={value(getattr(body, name))}" for name in SHOWN if getattr(body, name, None) not in (None, "", b"")
    ]
    return " ".join([*fields, "with its state"] if getattr(body, "body", None) is not None else fields)


def value(it: Any) -> str:
    return f"{it.epoch}/{it.no}" if isinstance(it, CheckpointId) else str(it)


def shown(it: Any) -> Any:
    """Returns plain values as a story tells them: rounded, and without the lines of files."""
    if isinstance(it, Mapping):
        return {key: shown(one) for key, one in it.items() if key not in LEFT_OUT}
    if isinstance(it, (list, tuple)):
        return [shown(one) for one in it]
    if isinstance(it, str):
        return re.sub(r" at test_stories.py:\d+", "", it)
    return round(it, 3) if isinstance(it, float) else it


class Story:
    """Writes down what agents say to each other, and what they tell people.

    Args:
        fleet: the agents.
    """

    def __init__(self, fleet: FleetInTest) -> None:
        self.lines: list[str] = []
        self._fleet = fleet

    def hear(self, name: str) -> None:
        """Hears an agent from now on."""
        stream = self._fleet.agents[name].kernel.stream
        stream.tap(NETWORK, lambda packet: self._heard(name, packet))
        stream.tap(LOG, lambda packet: self._said(name, packet))

    def tell(self, what: str) -> None:
        """Writes down what a person does."""
        self.lines.append(f"-- {what}")

    def ask(self, name: str, body: Any, **others: Any) -> None:
        """Writes down what a person asks of an agent, and what that answers."""
        reply = self._fleet.agents[name].ask(body, **others)
        self.lines.append(f"-- {name} is asked for {body}")
        self.lines.append(f"   {reply.reason or 'done'}")
        if reply.result is not None:
            self.lines += [f"   {line}" for line in pformat(shown(reply.result), width=110).splitlines()]

    def _heard(self, name: str, packet: Packet) -> None:
        here = f"{name}/"
        if (packet.destination or "").startswith(here) and not packet.source.startswith(here):
            self._note(f"{packet.source} > {packet.destination}: {packet.type}", packet.body)

    def _said(self, name: str, packet: Packet) -> None:
        if packet.source.startswith(f"{name}/") and told_in(packet.body):
            self._note(f"{packet.source}:", packet.body)

    def _note(self, what: str, body: Any) -> None:
        self.lines.append(f"{self._fleet.now():6.2f} {what} {shown(told_in(body))}".rstrip())


def fleet_of(names: str, story: Callable[[FleetInTest, Story], None]) -> list[str]:
    """Has a story happen among some agents; returns what they said."""
    with FleetInTest(seed=5, classes={"test.Slow": Slow, "test.Sink": Sink, "test.Frail": Frail}) as fleet:
        told = Story(fleet)
        for name in names:
            fleet.start(name)
            told.hear(name)
        fleet.connect()
        story(fleet, told)
        return list(told.lines)


def owners(fleet: FleetInTest) -> list[str]:
    return [name for name, agent in fleet.agents.items() if agent.running()]


def a_guarded_task(fleet: FleetInTest, told: Story) -> None:
    """It is created, moves, is taken over, stopped, started, handed on and removed."""
    agents = fleet.agents
    told.tell("a creates Slow, which three agents guard")
    assert agents["a"].ask(Create("Slow", "test.Slow", keys=GUARDED)).ok
    fleet.run_for(6.0)
    told.tell("it moves to b")
    assert agents["a"].ask(Migrate("Slow", to="b")).ok
    fleet.run_for(3.0)
    told.tell("b is cut off")
    fleet.faults.cut("b", off=tuple("acd"), for_s=8.0)
    fleet.run_for(8.0)
    fleet.connect()
    assert fleet.run_until(lambda: len(owners(fleet)) == 1, 10.0)
    (owner,) = owners(fleet)
    told.tell(f"{owner} is asked to stop it, and to start it")
    assert agents[owner].ask(Stop("Slow")).ok
    fleet.run_for(1.0)
    assert agents[owner].ask(Start("Slow")).ok
    fleet.run_for(1.0)
    told.tell(f"{owner} ends in good order")
    fleet.stop(owner)
    fleet.run_for(6.0)
    (owner,) = owners(fleet)
    told.tell(f"{owner} removes it")
    assert agents[owner].ask(Remove("Slow")).ok
    fleet.run_for(3.0)


def two_guarded_tasks(fleet: FleetInTest, told: Story) -> None:
    """They lack guardians, get them, and get others for one that is silent, or that cannot."""
    agents, rule = fleet.agents, {"guard": 3, "lease_s": 60.0, "checkpoint_s": 30.0}
    told.tell("a creates Plain, which is not guarded, and One and Two, for which there are too few agents")
    for name, keys in (("Plain", {}), ("One", rule), ("Two", {**rule, "guardians": ["b", "d"]})):
        assert agents["a"].ask(Create(name, "test.Slow", keys=keys)).ok
    fleet.run_for(5.0)
    told.tell("c and d come")
    for name in "cd":
        fleet.start(name)
        told.hear(name)
    fleet.connect()
    fleet.run_for(20.0)
    told.tell("b dies")
    fleet.crash("b")
    fleet.run_for(80.0)
    told.tell("a dies too")
    fleet.crash("a")
    fleet.run_for(80.0)
    told.tell("a is back, with an empty disk")
    fleet.fleet.disk("a").clear()
    fleet.restart("a")
    told.hear("a")
    fleet.connect()
    fleet.run_for(5.0)
    told.tell("One is stopped on c")
    assert agents["c"].ask(Stop("One")).ok
    fleet.run_for(70.0)


def tasks_of_one_agent(fleet: FleetInTest, told: Story) -> None:
    """They are asked for all that tasks can be asked for, and fail."""
    told.ask("a", Create("Slow", "test.Slow", keys={"restart": {"policy": "transient", "pause_s": 0.5}}, dry_run=True))
    told.ask("a", Create("Slow", "test.Slow", keys={"restart": {"policy": "transient", "pause_s": 0.5}}))
    told.ask("a", Create("Frail", "test.Frail"))
    fleet.run_for(5.0)
    for body in (
        Describe("Slow", state=True, began=True),
        Reschedule("Slow", 2.0),
        Reschedule("Slow", 2.0, "nothing"),
        Reschedule("Slow", -1.0),
        Configure("Slow", {"step": 3}),
        Configure("Slow", {"stepp": 3}),
        Start("Slow"),
        Stop("Slow", dry_run=True),
        Stop("Slow"),
        Stop("Slow"),
        Reschedule("Slow", 1.0),
        Configure("Slow", {"step": 4}),
        Migrate("Slow"),
        Restart("Slow", keep_state=False),
        Migrate("Slow"),
        Migrate("Slow", cost="nothing"),
        Start("Nothing"),
        Describe("Nothing"),
        Describe("client"),
        Migrations(),
        Adopt("Slow"),
        Forget("Slow"),
        Revive("a/Slow", "test.Slow", force=True),
        Stop("client", for_s=1.0),
    ):
        told.ask("a", body)
    fleet.run_for(3.0)
    told.tell("a crashes, and is back")
    fleet.crash("a")
    fleet.restart("a")
    told.hear("a")
    fleet.run_for(3.0)
    told.ask("a", Describe("Slow", state=True))
    told.ask("a", Describe("Frail"))


def services_of_one_agent(fleet: FleetInTest, told: Story) -> None:
    """They are asked for all that services and devices can be asked for."""
    devices = {"pose": {"driver": "null.pose", "rate_hz": 1.0}, "wheels": "null.motors"}
    fleet.start("a", devices=devices, tasks={"Slow": "test.Slow"})
    told.hear("a")
    fleet.connect()
    fleet.run_for(3.0)
    for body in (
        Describe(),
        Describe("wheels"),
        Describe("network"),
        Describe("log"),
        Guarding(),
        Checkpoints("Slow"),
        Follow("nothing"),
        Follow("system"),
        Unfollow("system"),
        Reschedule("pose", 2.0),
        Reschedule("wheels", 2.0),
        Configure("pose", {"x_m": 1.0}),
        Stop("wheels"),
        Start("wheels"),
        Restart("wheels"),
        Stop("device", for_s=-1.0),
        Stop("device", for_s=1.0),
        Describe("device"),
        Start("wheels"),
        Start("device"),
        Start("device"),
        Restart("client"),
        Stop("nothing"),
        Stop("log"),
        Start("log"),
        Begin(),
        ReloadKeys(),
        Shutdown(),
        Stop("network"),
        Migrate("Slow"),
        Stop("kernel"),
    ):
        told.ask("a", body)
    fleet.run_for(3.0)
    told.ask("a", Describe("device"))


def a_moving_task(fleet: FleetInTest, told: Story) -> None:
    """It moves while it is written to, stays where it cannot move, is in doubt, owned twice, and given up."""
    agents, sink = fleet.agents, TaskId("a", "Sink")
    told.tell("a creates Sink, and Slow, which is to follow it")
    assert agents["a"].ask(Create("Sink", "test.Sink")).ok
    assert agents["a"].ask(Create("Slow", "test.Slow")).ok and agents["a"].ask(Stop("Slow")).ok
    told.tell("c writes to it while it moves to b")
    agents["c"].publish("system", Numbered(1), to=SINK)
    moving = agents["a"].publish("sysctrl", Migrate("Sink", to="b", then="Slow"))
    agents["c"].publish("system", Numbered(2), to=SINK)
    assert agents["a"].reply_to(moving).ok
    fleet.run_for(3.0)
    told.tell("it is to move to c, which a full disk keeps from taking it")
    calm = fleet.faults.fill_disk("c")
    assert not agents["b"].ask(Migrate("Sink", to="c")).ok
    calm()
    fleet.run_for(6.0)
    before = {file: data for file, data in fleet.fleet.disk("b").items() if file != "lock"}
    told.tell("it is to move to c, which dies once it has the snapshot")
    agents["b"].publish("sysctrl", Migrate("Sink", to="c"))
    record = agents["c"].agent.records.get
    while (kept := record(sink)) is None or kept.phase is not Phase.PREPARED:
        assert fleet.fleet.dispatcher.step()
    fleet.crash("c")
    agents["a"].publish("system", Numbered(3), to=SINK)
    fleet.run_for(10.0)
    told.tell("c is back, and hears that it has it")
    fleet.restart("c")
    told.hear("c")
    fleet.connect()
    fleet.run_for(5.0)
    told.tell("b begins from an old copy of its disk")
    fleet.crash("b")
    fleet.fleet.disk("b").clear()
    fleet.fleet.disk("b").update(before)
    fleet.restart("b")
    told.hear("b")
    fleet.connect()
    fleet.run_for(3.0)
    told.tell("b gives it up")
    assert agents["b"].ask(Forget("Sink", owner="c")).ok
    agents["a"].publish("system", Numbered(4), to=SINK)
    fleet.run_for(2.0)
    told.tell("c is gone for good, and a revives it")
    fleet.crash("c")
    fleet.run_for(3.0)
    assert agents["a"].ask(Revive("a/Sink", "test.Sink", force=True)).ok
    fleet.run_for(3.0)


STORIES: dict[Callable[[FleetInTest, Story], None], str] = {
    a_moving_task: "abc",
    a_guarded_task: "abcd",
    two_guarded_tasks: "ab",
    tasks_of_one_agent: "a",
    services_of_one_agent: "b",
}
"""The agents that there are at the beginning of each."""


@pytest.mark.parametrize("story", STORIES, ids=lambda story: story.__name__)
def test_agents_say_the_same_as_before(story: Callable[[FleetInTest, Story], None], tmp_path: Path) -> None:
    known = Path(__file__).with_name(f"story_of_{story.__name__}.txt")
    lines, now = fleet_of(STORIES[story], story), tmp_path / known.name
    now.write_text("\n".join(lines) + "\n")
    assert lines == known.read_text().splitlines(), f"where the change is meant, copy {now} to {known}"
