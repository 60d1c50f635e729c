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
from pancakes.durable.bidding_messages import MIGRATOR
from pancakes.durable.delivery import Letter, Receipt
from pancakes.durable.messages import (
    REGISTRAR,
    Accept,
    Accepted,
    Bid,
    Call,
    Prepare,
    Promise,
    Refuse,
    Solicit,
    addressed,
)
from pancakes.durable.quotas import MOST_OFFERED
from pancakes.durable.record import TaskId
from pancakes.durable.register import NO_EPOCH, NOBODY, Epoch, Identity, Register, Standing, Wanted
from pancakes.durable.snapshot import Snapshot
from pancakes.mesh.codec import encode_packet
from pancakes.packet import Packet, packet_type, task_address
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
        guarded = {"type": Count, "guard": {"copies": 3, "lease_s": LEASE_S, "guardians": ["b", "c"]}}
        self.a = self._start("a", {"Count": guarded, "Sink": {"type": Sink, "durability": "each"}})
        self.b, self.c, self.d = (self._start(name, {}) for name in "bcd")
        for agent in self.all:
            mesh = agent.agent.mesh
            agent.wait_until(lambda: len(mesh.neighbours()) == 3, PATIENCE_S, "all are linked")  # noqa: B023
        self.heard: list[object] = []  # what d is told
        self.d.kernel.stream.tap("network", lambda packet: self.heard.append(packet.body))
        self.a.wait_until(lambda: [len(one) for one in self.register().sets] == [3], PATIENCE_S, "members")

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

    def register(self) -> Register:
        record = self.a.agent.records.get(COUNT)
        return record.register if record is not None else Register()

    def identity(self, agent: AgentHandle) -> Identity:
        return Identity(agent.name, agent.agent.mesh.identity.journal)

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
    """Epochs and states are made up, and each lease would end early."""
    high, own = Epoch(7, robots.identity(robots.d)), robots.register()
    kind, ours = robots.a.agent.records.get(COUNT).type, Register(high, 1, own.sets)
    goodbye = own.summary()._replace(no=own.no + 100, heir=robots.identity(robots.d))
    for member in robots.honest:
        robots.lie(
            member,
            REGISTRAR,
            Prepare(COUNT, kind, high, own.stamp, own.sets),
            Accept(COUNT, kind, "client", ours, 1, 0.5, state=b"a lie"),
            Accept(COUNT, kind, "client", ours._replace(wanted=Wanted.REMOVED), 1, 0.5),
            Accept(COUNT, kind, "client", goodbye, state=b"a lie"),
        )
    assert robots.goes_on()
    assert not robots.told(Promise) and not robots.told(Accepted)
    rows = [row for agent in (robots.b, robots.c) for row in agent.ask(Guarding()).result]
    assert {row["owner"] for row in rows} == {"a"}


@pytest.mark.parametrize("task_id", [COUNT, SINK], ids=["guarded", "not guarded"])
def test_task_is_taken_over_by_none_while_its_owner_runs_it(robots, task_id):
    """D promises the task to whoever asks, and hands out a state of its own making."""
    d = robots.identity(robots.d)
    made_up, kind = Register(Epoch(6, d), 9, ((d,),)), f"test.{task_id.name}"
    rule = {"copies": 3, "lease_s": LEASE_S, "checkpoint_s": 1.0, "guardians": [], "takeover": "auto"}
    state = Snapshot(task_id, kind, robots.version(task_id.name), "client", guard=rule).encode()

    def promise(packet: Packet) -> None:
        if isinstance(packet.body, Prepare):
            held = made_up._replace(promised=packet.body.epoch)
            robots.lie(robots.b, REGISTRAR, Promise(task_id, packet.body.epoch, d, held, state))

    robots.d.kernel.stream.tap("network", promise)
    robots.lie(robots.b, REGISTRAR, Call(task_id, kind, "client", NO_EPOCH, ((d,),)))
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
    return Solicit(task_id, 1, "test.Sink", robots.version("Sink"), "client", hold=True)


def _offer(robots: Robots, task_id: TaskId, **state: Any) -> Accept:
    """D offers a task, and says that it has another disk, so it is not asked whether it gives it away."""
    d, heir = Identity("d", "gone"), robots.identity(robots.b)
    register = Register(Epoch(0, d), 1, ((d,),), heir=heir)
    snapshot = Snapshot(task_id, "test.Sink", robots.version("Sink"), "client", state=state)
    return Accept(task_id, "test.Sink", "client", register, to=heir, state=snapshot.encode())


def test_what_is_brought_and_never_given_away_has_a_bound_and_leaves_others_their_place(robots):
    def answer(packet: Packet) -> None:
        if isinstance(packet.body, Bid) and packet.body.holds:
            robots.lie(robots.b, REGISTRAR, _offer(robots, packet.body.task_id))

    robots.d.kernel.stream.tap("network", answer)
    for first in range(0, 96, 32):  # of more at once some are declined because so many are under way
        for number in range(first, first + 32):
            robots.lie(robots.b, MIGRATOR, _request(robots, TaskId("d", f"T{number}")))
        until(lambda: _decided(robots) >= first + 32, "each is answered")  # noqa: B023
    assert len(_kept(robots)) == MOST_OFFERED
    assert any("that d has brought and not handed over" in it.refusal.text for it in robots.told(Refuse))
    assert robots.a.ask(Migrate("Sink", to="b")).ok, "an honest task has its place"


def _kept(robots: Robots) -> set[TaskId]:
    return {key for key, it in robots.b.agent.records.all().items() if it.standing is Standing.HEIR}


def _decided(robots: Robots) -> int:
    return len(_kept(robots) | {it.task_id for it in robots.told(Refuse)})


def test_task_is_handed_over_only_by_an_agent_that_has_it(robots):
    """D has the code of the task, makes up the rest, and gives away what it never had."""
    robots.lie(robots.b, MIGRATOR, _request(robots, SINK))
    until(lambda: robots.told(Refuse), "it is refused")
    assert "d has no right to it" in robots.told(Refuse)[0].refusal.text
    offer, d = _offer(robots, SINK, numbers=[666]), robots.identity(robots.d)
    given = Promise(SINK, Epoch(1, robots.identity(robots.b)), d, offer.register._replace(heir=NOBODY), offer.state)
    robots.lie(robots.b, REGISTRAR, offer, given)
    robots.b.publish("system", Numbered(1), to=task_address("a/Sink"))
    robots.b.wait_until(lambda: not robots.b.agent.outbox.waiting(), PATIENCE_S, "it is acknowledged")
    assert robots.a.task("Sink").state.numbers == [1]
    assert robots.b.running() == [] and SINK not in robots.b.agent.records.all()
