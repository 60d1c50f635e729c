"""The story of a task that moves, message by message: what a change of the protocol changes can be read there.

It is in `story_of_a_moving_task.txt`, beside this file. `test_task_talk.py` has who asks whom of guarded tasks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from services.numbered import SINK, Numbered, Sink

from pancakes.control import Create, Forget, Migrate, Revive, Stop
from pancakes.durable.record import TaskId
from pancakes.durable.register import Standing
from pancakes.events import Event, LogLine
from pancakes.packet import LOG, NETWORK, Packet
from pancakes.task import Task, Tick, every
from pancakes.testing import Fleet

KNOWN = Path(__file__).with_name("story_of_a_moving_task.txt")
HEAD = [
    "A task that moves, as its agents a, b and c tell it. Each line begins with the time in seconds.",
    "`a/client > b/client: KIND` is a message, `a/client: KIND` an event, `a/client: warning` a line for people.",
    "A line with -- is what the test does.",
    "",
]
SHOWN = ("offer", "epoch", "no", "to")
"""The fields of messages and events that a story shows."""


class Slow(Task):
    """Follows the task that moves away."""

    @dataclass
    class State:
        n: int = 0

    state: State

    @every(hz=0.5)
    def tick(self, tick: Tick) -> None:
        self.state.n += 1


class Story:
    """Writes down what agents say to each other, and what they tell people.

    Args:
        fleet: the agents.
    """

    def __init__(self, fleet: Fleet) -> None:
        self.lines = list(HEAD)
        self._fleet = fleet

    def hear(self, name: str) -> None:
        """Hears an agent from now on."""
        stream = self._fleet.agents[name].kernel.stream
        stream.tap(NETWORK, lambda packet: self._heard(name, packet))
        stream.tap(LOG, lambda packet: self._said(name, packet))

    def tell(self, what: str) -> None:
        """Writes down what the test does."""
        self.lines.append(f"-- {what}")

    def _heard(self, name: str, packet: Packet) -> None:
        here = f"{name}/"
        if (packet.destination or "").startswith(here) and not packet.source.startswith(here):
            shown = {field: getattr(packet.body, field, None) for field in SHOWN}
            self._note(f"{packet.source} > {packet.destination}", packet.type, shown)

    def _said(self, name: str, packet: Packet) -> None:
        body = packet.body
        if not packet.source.startswith(f"{name}/"):
            return
        if isinstance(body, Event):
            self._note(packet.source, body.kind, body.fields)
        elif isinstance(body, LogLine) and body.level in ("warning", "error"):
            self._note(packet.source, body.level, {})

    def _note(self, who: str, kind: str, fields: Mapping[str, Any]) -> None:
        shown = "".join(f" {name}={fields[name]}" for name in SHOWN if fields.get(name) not in (None, "", b""))
        self.lines.append(f"{self._fleet.now():6.2f} {who}: {kind}{shown}")


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet(seed=5, classes={"test.Slow": Slow, "test.Sink": Sink}) as made:
        for name in "abc":
            made.start(name)
        made.connect()
        yield made


def test_migration_story(fleet: Fleet, tmp_path: Path) -> None:
    """A task moves while it is written to, cannot move, is in doubt, is owned twice, is given up and is revived."""
    agents, sink, told = fleet.agents, TaskId("a", "Sink"), Story(fleet)
    for name in agents:
        told.hear(name)
    told.tell("a creates Sink, and Slow, which will follow it")
    assert agents["a"].ask(Create("Sink", "test.Sink")).ok
    assert agents["a"].ask(Create("Slow", "test.Slow")).ok and agents["a"].ask(Stop("Slow")).ok
    told.tell("c writes to Sink while Sink moves to b")
    agents["c"].publish("system", Numbered(1), to=SINK)
    moving = agents["a"].publish("sysctrl", Migrate("Sink", to="b", then="Slow"))
    agents["c"].publish("system", Numbered(2), to=SINK)
    assert agents["a"].reply_to(moving).ok
    fleet.run_for(3.0)
    told.tell("Sink is asked to move to c, whose disk is full")
    calm = fleet.faults.fill_disk("c")
    assert not agents["b"].ask(Migrate("Sink", to="c")).ok
    calm()
    fleet.run_for(6.0)
    before = {file: data for file, data in fleet.disk("b").items() if file != "lock"}
    told.tell("Sink is asked to move to c, which dies when it has the snapshot; a writes to Sink")
    agents["b"].publish("sysctrl", Migrate("Sink", to="c"))
    record = agents["c"].agent.records.get
    while (kept := record(sink)) is None or kept.standing is not Standing.HEIR:
        assert fleet.dispatcher.step()
    fleet.crash("c")
    agents["a"].publish("system", Numbered(3), to=SINK)
    fleet.run_for(10.0)
    told.tell("c is back, and learns that Sink is its own")
    fleet.restart("c")
    told.hear("c")
    fleet.connect()
    fleet.run_for(5.0)
    told.tell("b begins again from an old copy of its disk, so two agents own Sink")
    fleet.crash("b")
    fleet.disk("b").clear()
    fleet.disk("b").update(before)
    fleet.restart("b")
    told.hear("b")
    fleet.connect()
    fleet.run_for(3.0)
    told.tell("a person has b give Sink up; a writes to Sink")
    assert agents["b"].ask(Forget("Sink", owner="c")).ok
    agents["a"].publish("system", Numbered(4), to=SINK)
    fleet.run_for(2.0)
    told.tell("c is gone for good, and a person has a revive Sink")
    fleet.crash("c")
    fleet.run_for(3.0)
    assert agents["a"].ask(Revive("a/Sink", "test.Sink")).ok
    fleet.run_for(3.0)
    now = tmp_path / KNOWN.name
    now.write_text("\n".join(told.lines) + "\n")
    assert told.lines == KNOWN.read_text().splitlines(), f"if the change is meant, copy {now} to {KNOWN}"
