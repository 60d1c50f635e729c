"""A robot with an ordinary certificate that lies, over TLS on this machine: nothing is doubled, and nothing is lost.

Each test says what must hold, and tries what today's messages allow; another protocol has other messages, and the same
promises.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from keys_in_test import KeysInTest

from pancakes.control import Guarding, Migrate
from pancakes.durable.arrivals import MOST_IN_DOUBT
from pancakes.durable.delivery import Letter, Receipt
from pancakes.durable.messages import (
    CheckpointBody,
    CheckpointId,
    Commit,
    KeepLease,
    LeaseKept,
    Nak,
    Pledge,
    Prepared,
    Reserve,
    Reserved,
    SeizeTask,
    Solicit,
    TakeTask,
    Transfer,
    YieldLease,
    addressed,
)
from pancakes.durable.record import Epoch, GuardianId, Guards, Phase, TaskId, forgotten_guards
from pancakes.durable.snapshot import Snapshot, cut
from pancakes.mesh.codec import encode_packet
from pancakes.packet import Packet, packet_type, task_address
from pancakes.supervision.messages import GUARDIAN
from pancakes.task import Task, every, on
from pancakes.testing import AgentHandle, threaded_agent

PATIENCE_S = 20.0
LEASE_S = 2.0
COUNT, SINK = TaskId("a", "Count"), TaskId("a", "Sink")
ACTS: list[tuple[float, str]] = []
"""When which agent has acted as the task that is guarded."""


@packet_type("lies.numbered")
@dataclass(frozen=True)
class Numbered:
    n: int


class Count(Task):
    """Acts twenty times a second."""

    @dataclass
    class State:
        n: int = 0

    @every(hz=20)
    def act(self, tick):
        self.state.n += 1
        ACTS.append((time.monotonic(), self.agent))


class Sink(Task):
    """Remember what it was sent."""

    @dataclass
    class State:
        numbers: list[int] = field(default_factory=list)

    @on("system", Numbered)
    def take(self, packet):
        self.state.numbers.append(packet.body.n)


def until(condition: Callable[[], object], what: str) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end_s, what
        Event().wait(0.02)


class Robots:
    """The agents a, b and c, which are honest, and d, which is not; each has keys of one authority."""

    def __init__(self, directory: Path, stack: ExitStack) -> None:
        self._keys = KeysInTest(directory)
        self._stack = stack
        self._peers: list[str] = []
        ACTS.clear()
        guarded = {"type": Count, "guard": 3, "lease_s": LEASE_S, "guardians": ["b", "c"]}
        self.a = self._start("a", {"Count": guarded, "Sink": {"type": Sink, "durability": "each"}})
        self.b, self.c, self.d = (self._start(name, {}) for name in "bcd")
        for agent in self.all:
            mesh = agent.agent.mesh
            agent.wait_until(lambda: len(mesh.neighbours()) == 3, PATIENCE_S, "all are linked")  # noqa: B023
        self.heard: list[object] = []  # what d is told
        self.d.kernel.stream.tap("network", lambda packet: self.heard.append(packet.body))
        self.a.wait_until(lambda: len(self.guards().members()) == 3 == len(self.guards().sets[0]), PATIENCE_S, "guards")

    def _start(self, name: str, tasks: dict) -> AgentHandle:
        keys = self._keys.of_agent("test", name)
        settings = {"keys": str(keys), "transports": {}}
        made = self._stack.enter_context(
            threaded_agent(
                name,
                tasks=tasks,
                services={"network": {"settings": settings}},
                classes={"test.Count": Count, "test.Sink": Sink},
                fleet="test",
                listen="tcp://127.0.0.1:0",
                peers=self._peers,
            )
        )
        self._peers = [*self._peers, next(it for it in made.agent.mesh.listen if it.startswith("tcp://"))]
        return made

    def told(self, kind: type) -> list:
        return [body for body in list(self.heard) if isinstance(body, kind)]

    @property
    def all(self) -> list[AgentHandle]:
        return [self.a, self.b, self.c, self.d]

    @property
    def honest(self) -> list[AgentHandle]:
        return [self.a, self.b, self.c]

    def guards(self) -> Guards:
        record = self.a.agent.records.get(COUNT)
        return record.guards if record is not None else Guards()

    def guardian(self, agent: AgentHandle) -> GuardianId:
        return GuardianId(agent.name, agent.agent.mesh.identity.journal)

    def version(self, kind: str = "Count") -> str:
        return self.a.slot(kind).spec.version

    def lie(self, to: AgentHandle, at: str, *bodies: Any) -> None:
        """D says something to an actor of another agent."""
        for body in bodies:
            meant = addressed(body, to.agent.mesh.identity.journal) if hasattr(body, "journal") else body
            self.d.publish("network", meant, to=f"{to.name}/{at}")

    def acted(self) -> set[str]:
        return {agent for _, agent in ACTS}

    def goes_on(self, for_s: float = 2.5 * LEASE_S) -> bool:
        """Return whether the task acts on for so long, on its agent, without a pause."""
        began_s = time.monotonic()
        until(lambda: ACTS and ACTS[-1][0] > began_s + for_s, "it acts no more")
        return self.acted() == {"a"} and not self.a.events("permit_lost")


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[Robots]:
    with ExitStack() as stack:
        yield Robots(tmp_path, stack)


def test_guarded_task_acts_on_one_agent_whatever_a_third_claims(robots):
    """Epochs and checkpoints are made up, and each lease would end early."""
    high, guards = Epoch(7, "d"), robots.guards()
    mine = Guards(high, 0, guards.sets)
    body = CheckpointBody(b"a lie")
    for guardian in robots.honest:
        robots.lie(
            guardian,
            GUARDIAN,
            SeizeTask(COUNT, "test.Count", high, guards),
            KeepLease(COUNT, "test.Count", high, 1, 0.5, CheckpointId(high, 1), mine, body),
            KeepLease(COUNT, "test.Count", high, 1, 0.5, CheckpointId(high, 1), forgotten_guards(high)),
            YieldLease(COUNT, Epoch(0, "a"), 2**62, 1),
            YieldLease(COUNT, high, 2**62, 1),
        )
    assert robots.goes_on()
    assert not robots.told(Pledge) and not robots.told(LeaseKept)
    rows = [row for agent in (robots.b, robots.c) for row in agent.ask(Guarding()).result]
    assert {row["owner"] for row in rows} == {"a"}


@pytest.mark.parametrize("task_id", [COUNT, SINK], ids=["guarded", "not guarded"])
def test_task_is_taken_over_by_none_while_its_owner_runs_it(robots, task_id):
    """D pledges the task to whoever asks, and hands out a state of its own making."""
    mine = Guards(Epoch(6, "d"), 0, ((robots.guardian(robots.d),),))
    kind = f"test.{task_id.name}"
    rule = {"guard": 3, "lease_s": LEASE_S, "checkpoint_s": 1.0, "guardians": [], "takeover": "auto"}
    body = CheckpointBody(Snapshot(task_id, kind, robots.version(task_id.name), "client", guard=rule).encode())

    def pledge(packet: Packet) -> None:
        if isinstance(packet.body, SeizeTask):
            checkpoint = CheckpointId(Epoch(6, "d"), 9)
            said = Pledge(task_id, packet.body.epoch, robots.guardian(robots.d), checkpoint, mine, body)
            robots.lie(robots.b, "client", said)

    robots.d.kernel.stream.tap("network", pledge)
    robots.lie(robots.b, "client", TakeTask(task_id, kind, Epoch(0, "a"), mine, CheckpointId(Epoch(0, "a"), 1)))
    assert robots.goes_on()
    assert robots.b.running() == [] and sorted(robots.a.running()) == ["Count", "Sink"]


def test_packets_for_a_task_have_their_effect_once_whatever_a_third_writes(robots):
    """D writes far ahead in all streams of b that it can know or guess, and acknowledges what b sends."""
    forged = Packet("system", "lies.numbered", "d/client/Source", task_address("a/Sink"), 0.0, 1, Numbered(-1))
    row, name = encode_packet(forged), robots.b.agent.outbox.name
    for stream in (name, f"{name}#", f"{name}/1", f"{name}/1#"):
        robots.lie(robots.a, "kernel/Courier", Letter("a/Sink", stream, 1000, 1000, row, "d"))
        robots.lie(robots.b, "kernel/Courier", Receipt("a/Sink", stream, 1000, 1000))
    for n in range(1, 31):
        robots.b.publish("system", Numbered(n), to=task_address("a/Sink"))
    robots.b.wait_until(lambda: not robots.b.agent.outbox.waiting(), PATIENCE_S, "all are acknowledged")
    assert [n for n in robots.a.task("Sink").state.numbers if n > 0] == list(range(1, 31))


def _request(robots: Robots, task_id: TaskId) -> Solicit:
    return Solicit(task_id, 1, "test.Sink", robots.version("Sink"), "client")


def test_what_is_brought_and_never_given_away_has_a_bound_and_leaves_others_their_place(robots):
    def answer(packet: Packet) -> None:
        if isinstance(packet.body, Reserved):
            task_id = packet.body.task_id
            snapshot = Snapshot(task_id, "test.Sink", robots.version("Sink"), "client").encode()
            robots.lie(robots.b, "client", *cut(Transfer(task_id, packet.body.offer, snapshot)))

    robots.d.kernel.stream.tap("network", answer)
    for first in range(0, 96, 32):  # of more at once some are declined because so many are under way
        for number in range(first, first + 32):
            task_id = TaskId("d", f"T{number}")
            robots.lie(robots.b, "client", Reserve(task_id, Epoch(1, "d"), _request(robots, task_id)))
        until(lambda: _decided(robots) >= first + 32, "each is answered")  # noqa: B023
    kept = [it for it in robots.b.agent.records.all().values() if it.phase is Phase.PREPARED]
    assert len(kept) == MOST_IN_DOUBT
    assert any("that d has brought and not handed over" in nak.refusal.text for nak in robots.told(Nak))
    assert robots.a.ask(Migrate("Sink", to="b")).ok, "an honest task has its place"


def _decided(robots: Robots) -> int:
    return len({it.task_id for kind in (Prepared, Nak) for it in robots.told(kind)})


def test_task_is_handed_over_only_by_an_agent_that_has_it(robots):
    """D has the code of the task, makes up the rest, and gives away what it never had."""
    offer = Epoch(9, "d")
    snapshot = Snapshot(SINK, "test.Sink", robots.version("Sink"), "client", state={"numbers": [666]}).encode()
    robots.lie(robots.b, "client", Reserve(SINK, offer, _request(robots, SINK)))
    until(lambda: robots.told(Nak), "it is refused")
    assert "d has no right to it" in robots.told(Nak)[0].refusal.text
    robots.lie(robots.b, "client", *cut(Transfer(SINK, offer, snapshot)), Commit(SINK, offer))
    robots.b.publish("system", Numbered(1), to=task_address("a/Sink"))
    robots.b.wait_until(lambda: not robots.b.agent.outbox.waiting(), PATIENCE_S, "it is acknowledged")
    assert robots.a.task("Sink").state.numbers == [1]
    assert robots.b.running() == [] and SINK not in robots.b.agent.records.all()
