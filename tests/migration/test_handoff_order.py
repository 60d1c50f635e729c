"""The order of events and effects on one agent: an event waits until all before it is carried out."""

from __future__ import annotations

from collections.abc import Callable

from pancakes.migration.effect import Ack, Effect, Persist, Resume, Send, StartTask
from pancakes.migration.event import Award, Born, Checkpoint, Frozen, PacketId, Received
from pancakes.migration.handoff import HandOff
from pancakes.migration.messages import Activated, Prepared, Reserved, Solicit
from pancakes.migration.record import Epoch, Phase, Record, TaskId
from pancakes.migration.volatile import Volatile

SCAN = TaskId("agent1", "ScanTarget")
REQUEST = Solicit(SCAN, 1, "encirclement.ScanTarget", "0.1.0", "client")
BIRTH = Epoch(0, "agent1")
OFFER = Epoch(1, "agent1")


class Bench:
    """A rim that notes what it is asked for; writes and starts take until the test ends them."""

    def __init__(self, record: Record) -> None:
        self.asked: list[Effect] = []
        self.waiting: list[Callable[[], None]] = []
        self.handoff = HandOff("agent1", record, self)

    def carry_out(self, task_id: TaskId, effect: Effect, done: Callable[[], None]) -> None:
        assert task_id == SCAN
        self.asked.append(effect)
        if isinstance(effect, Persist | StartTask):
            self.waiting.append(done)
        else:
            done()

    def finish(self) -> None:
        self.waiting.pop()()

    def kinds(self) -> list[str]:
        kinds = [type(effect).__name__ for effect in self.asked]
        self.asked.clear()
        return kinds


def test_what_follows_a_write_waits_for_the_disk() -> None:
    bench = Bench(Record(SCAN))
    bench.handoff.feed(Born(b"new"))
    assert bench.kinds() == ["Persist"]
    assert bench.handoff.record.phase is Phase.ABSENT and not bench.handoff.idle

    bench.finish()
    assert bench.kinds() == ["StartTask"]
    assert bench.handoff.record.phase is Phase.OWNER
    bench.finish()
    assert bench.handoff.idle and bench.handoff.volatile == Volatile(running=True)


def test_events_wait_their_turn() -> None:
    own = Record(SCAN, Phase.OWNER, BIRTH, BIRTH, snapshot=b"0")
    bench = Bench(own)
    bench.handoff.recover()
    bench.handoff.feed(Checkpoint(BIRTH, 0, b"1", (PacketId("s", 1),)))
    bench.handoff.feed(Checkpoint(BIRTH, 0, b"2", (PacketId("s", 2),)))
    assert bench.kinds() == ["StartTask"]
    bench.finish()
    assert bench.asked == [Persist(Record(SCAN, Phase.OWNER, BIRTH, BIRTH, snapshot=b"1"))]
    bench.finish()
    assert bench.asked[1:] == [
        Ack(PacketId("s", 1)),
        Persist(Record(SCAN, Phase.OWNER, BIRTH, BIRTH, snapshot=b"2")),
    ]
    bench.finish()
    assert bench.asked[-1] == Ack(PacketId("s", 2))
    assert bench.handoff.idle


def test_a_whole_hand_off_at_the_source() -> None:
    bench = Bench(Record(SCAN, Phase.OWNER, BIRTH, BIRTH, snapshot=b"0"))
    bench.handoff.recover()
    bench.finish()
    bench.kinds()

    bench.handoff.feed(Award("agent2", REQUEST))
    assert bench.kinds() == ["Send", "After"]
    bench.handoff.feed(Received("agent2", Reserved(SCAN, OFFER)))
    assert bench.kinds() == ["Freeze"]
    bench.handoff.feed(Frozen(OFFER, b"1"))
    assert bench.kinds() == ["Persist"]
    bench.finish()
    assert bench.kinds() == ["Send", "After", "After"]
    bench.handoff.feed(Received("agent2", Prepared(SCAN, OFFER)))
    assert bench.kinds() == ["Persist"]
    bench.finish()
    assert bench.kinds() == ["Discard", "Send", "After", "After"]
    bench.handoff.feed(Received("agent2", Activated(SCAN, OFFER)))
    bench.finish()
    assert bench.kinds() == ["Persist", "HandedOver"]
    assert bench.handoff.record.phase is Phase.RELEASED


def test_after_a_failed_write_nothing_of_what_was_to_follow_happens() -> None:
    bench = Bench(Record(SCAN, Phase.OWNER, BIRTH, BIRTH, snapshot=b"0"))
    bench.handoff.recover()
    bench.finish()
    bench.handoff.feed(Award("agent2", REQUEST))
    bench.handoff.feed(Received("agent2", Reserved(SCAN, OFFER)))
    bench.handoff.feed(Frozen(OFFER, b"1"))
    bench.asked.clear()

    bench.handoff.failed("disk full")

    assert isinstance(bench.asked[0], Resume)
    assert not any(isinstance(effect, Send) for effect in bench.asked)
    assert bench.handoff.record.phase is Phase.OWNER
    # The write that failed comes to an end after all: that changes nothing any more.
    bench.finish()
    assert bench.handoff.record.phase is Phase.OWNER and bench.handoff.idle


def test_a_second_call_of_done_changes_nothing() -> None:
    bench = Bench(Record(SCAN))
    bench.handoff.feed(Born(b"new"))
    done = bench.waiting.pop()
    done()
    done()
    assert bench.kinds() == ["Persist", "StartTask"]
    assert not bench.handoff.idle
