"""The order of events and effects on one agent: an event waits until all before it is carried out."""

from __future__ import annotations

from pancakes.durable.handoff_events import Ack, Award, Checkpoint, Frozen, PacketId, Persist, Received, Resume, Send
from pancakes.durable.messages import Activated, Prepared, Reserved, Solicit
from pancakes.durable.record import Epoch, Phase, Record, TaskId, Volatile
from pancakes.durable.state_machine import (
    AnyEffect,
    AnyEvent,
    AskRoom,
    NotPersisted,
    Now,
    Persisted,
    Prepare,
    Room,
    Standing,
    StartConfigured,
    StoodStill,
    TakeDown,
    handle,
    idle,
)
from pancakes.supervision.lifecycle import Admitted, Began, Life, State
from pancakes.supervision.restart import Restarts, RestartSpec

SCAN = TaskId("agent1", "ScanTarget")
REQUEST = Solicit(SCAN, 1, "encirclement.ScanTarget", "0.1.0", "client")
BIRTH = Epoch(0, "agent1")
OFFER = Epoch(1, "agent1")
OWN = Record(SCAN, Phase.OWNER, BIRTH, BIRTH, snapshot=b"0")


class Bench:
    """A task and its machine; notes what is to be done, and carries nothing out."""

    def __init__(self, record: Record) -> None:
        self.life: Life | None = Life("agent1/client/ScanTarget", Restarts(RestartSpec()))
        self.standing = Standing(record)
        self.effects: list[AnyEffect] = []

    def feed(self, event: AnyEvent) -> list[str]:
        """Feeds an event; returns what is to be done about the hand-off, by name."""
        at = Now("agent1", 0.0, lambda low, high: high, closing=False, permit=True)
        self.life, self.standing, self.effects = handle(self.life, self.standing, event, at)
        shown = (Persist, Prepare, Send, Resume, Ack, TakeDown, AskRoom)
        return [type(effect).__name__ for effect in self.effects if isinstance(effect, shown)]

    def run(self) -> None:
        """Starts the task from its record."""
        self.feed(StartConfigured())
        self.feed(Admitted(1))
        self.feed(Began())
        assert self.life is not None and self.life.state is State.RUNNING and idle(self.standing)


def test_what_follows_a_write_waits_for_the_disk() -> None:
    bench = Bench(Record(SCAN))
    bench.feed(StartConfigured())
    (asked,) = bench.effects
    assert isinstance(asked, AskRoom)
    assert bench.feed(Room(asked, snapshot=b"new")) == ["Persist"]
    assert bench.standing.record.phase is Phase.ABSENT and not idle(bench.standing)

    assert bench.feed(Persisted()) == ["Prepare"]
    assert bench.standing.record.phase is Phase.OWNER
    bench.feed(Admitted(1))
    assert not idle(bench.standing)
    bench.feed(Began())
    assert idle(bench.standing) and bench.standing.volatile == Volatile(running=True)


def test_events_wait_their_turn() -> None:
    bench = Bench(OWN)
    assert bench.feed(StartConfigured()) == ["Prepare"]
    assert bench.feed(Checkpoint(BIRTH, 0, b"1", (PacketId("s", 1),))) == []
    assert bench.feed(Checkpoint(BIRTH, 0, b"2", (PacketId("s", 2),))) == []
    bench.feed(Admitted(1))
    assert bench.feed(Began()) == ["Persist"]
    assert bench.effects[-1] == Persist(Record(SCAN, Phase.OWNER, BIRTH, BIRTH, snapshot=b"1"))
    assert bench.feed(Persisted()) == ["Ack", "Persist"]
    assert bench.effects == [
        Ack(PacketId("s", 1)),
        Persist(Record(SCAN, Phase.OWNER, BIRTH, BIRTH, snapshot=b"2")),
    ]
    assert bench.feed(Persisted()) == ["Ack"]
    assert idle(bench.standing)


def test_a_whole_hand_off_at_the_source() -> None:
    bench = Bench(OWN)
    bench.run()
    assert bench.feed(Award("agent2", REQUEST)) == ["Send"]
    assert bench.feed(Received("agent2", Reserved(SCAN, OFFER))) == []
    assert bench.standing.unanswered == 1
    assert bench.feed(StoodStill(OFFER, "what it carries")) == ["TakeDown"]
    assert bench.feed(Frozen(OFFER, b"1")) == ["Persist"]
    assert bench.feed(Persisted()) == ["Send"]
    assert bench.feed(Received("agent2", Prepared(SCAN, OFFER))) == ["Persist"]
    assert [type(effect).__name__ for effect in bench.effects] == ["Persist"]
    bench.feed(Persisted())
    names = [type(effect).__name__ for effect in bench.effects]
    assert names == ["Drop", "TellToEnd", "Send", "After", "After", "Lasts"]
    assert bench.feed(Received("agent2", Activated(SCAN, OFFER))) == ["Persist"]
    bench.feed(Persisted())
    assert "HandedOver" in [type(effect).__name__ for effect in bench.effects]
    assert bench.standing.record.phase is Phase.RELEASED


def test_after_a_failed_write_nothing_of_what_was_to_follow_happens() -> None:
    bench = Bench(OWN)
    bench.run()
    bench.feed(Award("agent2", REQUEST))
    bench.feed(Received("agent2", Reserved(SCAN, OFFER)))
    bench.feed(StoodStill(OFFER, "what it carries"))
    bench.feed(Frozen(OFFER, b"1"))

    assert bench.feed(NotPersisted("disk full")) == ["Resume"]
    assert bench.standing.record.phase is Phase.OWNER
    # The write that failed comes to an end after all: that changes nothing any more.
    assert bench.feed(Persisted()) == []
    assert bench.standing.record.phase is Phase.OWNER and idle(bench.standing)
