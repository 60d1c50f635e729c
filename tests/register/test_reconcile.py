"""What joins the register of a task with the life of its actor, event by event."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec.structs import replace
from register.registers import GUARDED, OWNED, REGISTERS, STATE, A, B, record

from pancakes.control import Refusal
from pancakes.durable import rules
from pancakes.durable.reconcile import (
    AskRoom,
    AttemptFailed,
    Award,
    Came,
    CameToRest,
    Course,
    Drop,
    Freeze,
    FreezeFailed,
    Frozen,
    GiveUpDue,
    HandedOver,
    Hold,
    InDoubt,
    LetGoOn,
    Now,
    OpenPlace,
    PlaceFree,
    Prepare,
    Refused,
    Resume,
    Room,
    ServiceBegan,
    StillOverdue,
    StoodStill,
    TakeDown,
    Tell,
    Vacate,
    Warn,
    Write,
    handle,
)
from pancakes.durable.record import Record
from pancakes.durable.register import NOBODY, Epoch, Register, Standing, Wanted
from pancakes.durable.register_messages import Outcome
from pancakes.durable.rules import Desired
from pancakes.supervision.lifecycle import (
    Admitted,
    Answer,
    Began,
    Finished,
    LeaveRefused,
    Life,
    Request,
    Spawn,
    StartAsked,
    State,
    StopAsked,
    TellToEnd,
)
from pancakes.supervision.restart import Restarts, RestartSpec

REQUEST = Request("b/task", ("b/task", 1), 1)
LATER = b"later"
SEQUEL = b"what follows"


class Bench:
    """A task with its course; notes what is to be done, and carries nothing out."""

    def __init__(self, register: Register | Standing, desired: Desired = Desired.END, has_place: bool = True) -> None:
        self.life = Life("a/client/Scan", Restarts(RestartSpec("no", at_most=1))) if has_place else None
        self.course = Course(record(register), desired)
        self.effects: list[Any] = []

    def feed(self, *events: Any) -> list[Any]:
        """Feed events; return what is to be done after the last one."""
        for event in events:
            at = Now("a", 0.0, lambda low, high: high, closing=False)
            self.life, self.course, self.effects = handle(self.life, self.course, event, at)
        return self.effects

    def came(self, register: Register | Record | None, desired: Desired, *outcomes: Any) -> list[Any]:
        """Have the registrar say how the task stands; None: as before."""
        if register is None:
            held = self.course.record
        else:
            held = register if isinstance(register, Record) else record(register)
        return self.feed(Came(held, desired, outcomes))

    def kinds(self) -> list[str]:
        return [type(effect).__name__ for effect in self.effects]

    def of(self, kind: type) -> Any:
        """Return the only effect of a kind."""
        (found,) = [effect for effect in self.effects if type(effect) is kind]
        return found

    def running(self) -> Bench:
        """Start the task from its register."""
        self.feed(ServiceBegan())
        self.feed(Room())
        self.feed(Admitted(), Began())
        assert self.life is not None and self.life.state is State.RUNNING and self.course.settled
        return self

    def moving(self, carried: object = "carried") -> Bench:
        """Have the task offered to B."""
        self.feed(Award(B))
        self.feed(StoodStill(self.of(Freeze).number, carried))
        self.feed(Frozen(LATER, SEQUEL))
        offered = OFFERED if not self.course.record.guarded else OFFERED._replace(sets=GUARDED.sets)
        self.came(record(offered, SEQUEL), Desired.PAUSE, (Write.OFFER, Outcome.WRITTEN, ""))
        return self


OFFERED = OWNED._replace(no=4, heir=B, state=LATER)
BACK = OFFERED._replace(no=5, heir=NOBODY)
GIVEN = OFFERED._replace(promised=Epoch(1, B, 4))
GONE = Register(Epoch(1, B, 4), -1, ((B,),), promised=Epoch(1, B, 4))


def bench() -> Bench:
    return Bench(OWNED, Desired.RUN).running()


def test_task_that_is_new_is_written_before_it_starts() -> None:
    it = Bench(Standing.NONE)
    it.feed(ServiceBegan())
    it.feed(Room(snapshot=STATE))
    told = it.of(Tell)
    assert (told.write, told.event) == (Write.START, rules.Begin(Epoch(-1, NOBODY), STATE))
    it.came(OWNED, Desired.RUN, (Write.START, Outcome.WRITTEN, ""), (Write.START, Outcome.COUNTS, ""))
    assert it.kinds() == ["Prepare"]
    it.feed(Admitted())
    assert isinstance(it.of(Spawn), Spawn)


def test_task_that_is_here_starts_without_a_write() -> None:
    it = Bench(OWNED, Desired.RUN)
    it.feed(ServiceBegan())
    it.feed(Room())
    assert it.of(Prepare) == Prepare(fresh=False)


@pytest.mark.parametrize("standing", [Standing.YIELDED, Standing.HEIR, Standing.MEMBER, Standing.RELEASED])
def test_task_that_is_elsewhere_is_not_started(standing: Standing) -> None:
    it = Bench(standing)
    assert it.feed(ServiceBegan()) and it.kinds()[-1] == "Settle"
    it.feed(StartAsked(REQUEST))
    assert it.of(Answer).reason and it.life is not None and it.life.state is State.STOPPED


def test_start_that_has_no_room_is_refused() -> None:
    it = Bench(OWNED, Desired.RUN)
    it.feed(ServiceBegan())
    it.feed(Room("lacks the device type motors"))
    assert it.life is not None and (it.life.state, it.life.reason) == (State.REFUSED, "lacks the device type motors")


def test_start_that_cannot_be_written_is_put_off() -> None:
    it = Bench(Standing.NONE)
    it.feed(ServiceBegan())
    it.feed(Room(snapshot=STATE))
    it.came(None, Desired.END, (Write.START, Outcome.DELAYED, "the disk is full"))
    assert it.life is not None and (it.life.state, it.life.reason) == (State.ASKED, "the disk is full")
    it.came(OWNED, Desired.RUN, (Write.START, Outcome.WRITTEN, ""))
    assert it.kinds() == ["Prepare"]


def test_guarded_task_waits_for_its_permit() -> None:
    it = Bench(GUARDED, Desired.PAUSE)
    it.feed(ServiceBegan(), StartAsked(REQUEST))
    it.feed(Room())
    assert it.course.granted and "Prepare" not in it.kinds()
    it.came(None, Desired.RUN)
    assert it.kinds() == ["Prepare"]


def test_stop_is_answered_once_it_is_written() -> None:
    it = bench()
    it.feed(StopAsked(REQUEST, "asked for"))
    assert isinstance(it.of(TellToEnd), TellToEnd)
    it.feed(Finished("it ended"), CameToRest(LATER))
    assert it.of(Tell) == Tell(Write.REST, rules.Want(Wanted.STOPPED, LATER))
    stopped = OWNED._replace(no=4, wanted=Wanted.STOPPED, state=LATER)
    it.came(stopped, Desired.PAUSE, (Write.REST, Outcome.WRITTEN, ""), (Write.REST, Outcome.COUNTS, ""))
    assert it.of(Answer) == Answer(REQUEST)


def test_stop_of_a_guarded_task_is_answered_once_its_members_know() -> None:
    it = Bench(GUARDED, Desired.RUN).running()
    it.feed(StopAsked(REQUEST, "asked for"), Finished("it ended"), CameToRest(LATER))
    stopped = GUARDED._replace(no=4, wanted=Wanted.STOPPED, state=LATER)
    assert "Answer" not in [
        type(it).__name__ for it in it.came(stopped, Desired.PAUSE, (Write.REST, Outcome.WRITTEN, ""))
    ]
    it.came(None, Desired.PAUSE, (Write.REST, Outcome.COUNTS, ""))
    assert it.of(Answer) == Answer(REQUEST)


def test_stop_that_another_owner_may_not_know_is_answered_so() -> None:
    it = Bench(GUARDED, Desired.RUN).running()
    it.feed(StopAsked(REQUEST, "asked for"), Finished("it ended"), CameToRest(LATER))
    stopped = GUARDED._replace(no=4, wanted=Wanted.STOPPED, state=LATER)
    it.came(stopped, Desired.PAUSE, (Write.REST, Outcome.WRITTEN, ""))
    it.came(REGISTERS[Standing.MEMBER], Desired.END, (Write.REST, Outcome.LAPSED, ""))
    assert "taken over" in it.of(Answer).reason


def test_stop_that_cannot_be_written_is_answered_so() -> None:
    """Although a rest before it, that of a restart, does not count yet: its members may confirm that one."""
    it = Bench(GUARDED, Desired.RUN).running()
    it.feed(StopAsked(REQUEST, "restart", again=True), Finished("it ended"), CameToRest(LATER))
    it.came(GUARDED._replace(no=4, state=LATER), Desired.RUN, (Write.REST, Outcome.WRITTEN, ""))
    it.feed(Room(), Admitted(), Began())
    it.feed(StopAsked(REQUEST, "asked for"), Finished("it ended"), CameToRest(STATE))
    it.came(None, Desired.RUN, (Write.REST, Outcome.FAILED, "the disk is full"))
    assert it.of(Answer) == Answer(REQUEST, "the disk is full")
    it.came(None, Desired.RUN, (Write.REST, Outcome.COUNTS, ""))
    assert "Answer" not in it.kinds()


def test_migration_from_the_award_to_the_end() -> None:
    it = bench()
    it.feed(Award(B))
    freeze = it.of(Freeze)
    it.feed(StoodStill(freeze.number, "carried"))
    assert it.of(TakeDown) == TakeDown("carried")
    it.feed(Frozen(LATER, SEQUEL))
    assert it.of(Tell) == Tell(Write.OFFER, rules.Offer(B, LATER), SEQUEL)
    it.came(record(OFFERED, SEQUEL), Desired.PAUSE, (Write.OFFER, Outcome.WRITTEN, ""))
    assert it.course.paused and "Hold" not in it.kinds(), "its actuators are held already"
    it.came(record(GIVEN, SEQUEL), Desired.PAUSE)
    assert it.of(Drop) == Drop(ends=True) and isinstance(it.of(TellToEnd), TellToEnd)
    it.came(record(GONE, SEQUEL), Desired.END)
    assert it.of(HandedOver) == HandedOver("b", Epoch(1, B, 4), SEQUEL)
    it.feed(Finished("it ended"))
    assert isinstance(it.of(Vacate), Vacate) and not it.course.leaving


def test_stop_during_a_migration_takes_the_offer_back() -> None:
    it = bench().moving()
    it.feed(StopAsked(REQUEST, "asked for"), Finished("it ended"), CameToRest(b""))
    assert it.of(Tell).event == rules.Want(Wanted.STOPPED)
    stopped = BACK._replace(wanted=Wanted.STOPPED)
    it.came(stopped, Desired.PAUSE, (Write.REST, Outcome.WRITTEN, ""), (Write.REST, Outcome.COUNTS, ""))
    assert it.of(Answer) == Answer(REQUEST)
    assert it.of(AttemptFailed) == AttemptFailed("b", Refusal("conflict", "the task was stopped"))
    assert not it.course.paused


def test_stop_of_a_task_that_left_is_refused() -> None:
    """The heir asked for it before the registrar heard of the stop. Then its place is cleared."""
    it = bench().moving()
    it.feed(StopAsked(REQUEST, "asked for"), Finished("it ended"), CameToRest(b""))
    it.came(record(GIVEN, SEQUEL), Desired.PAUSE)
    assert "Vacate" not in it.kinds() and "Answer" not in it.kinds()
    it.came(None, Desired.PAUSE, (Write.REST, Outcome.DECLINED, ""))
    assert "was given to b" in it.of(Answer).reason and isinstance(it.of(Vacate), Vacate)


@pytest.mark.parametrize("event", ["it cannot", "it is stuck", "it cannot be written"])
def test_task_that_cannot_be_paused_goes_on(event: str) -> None:
    it = bench()
    it.feed(Award(B))
    number = it.of(Freeze).number
    if event == "it cannot":
        it.feed(StoodStill(number, reason=event))
    elif event == "it is stuck":
        it.feed(StillOverdue(number))
    else:
        it.feed(StoodStill(number, "carried"), FreezeFailed(event))
    failed = it.of(AttemptFailed)
    assert (failed.peer, failed.refusal.code) == ("b", "failed") and event in failed.refusal.text
    assert not it.course.paused and it.course.settled


def test_late_answer_of_a_paused_actor_lets_it_go_on() -> None:
    it = bench()
    it.feed(Award(B))
    number = it.of(Freeze).number
    it.feed(StillOverdue(number))
    assert it.feed(StoodStill(number, "carried")) == [LetGoOn()]


def test_answer_to_an_older_question_means_nothing() -> None:
    it = bench()
    it.feed(Award(B))
    first = it.of(Freeze).number
    it.feed(StillOverdue(first), Award(B))
    second = it.of(Freeze).number
    assert it.feed(StoodStill(first, "carried")) == []
    assert it.feed(StoodStill(second, "carried")) == [TakeDown("carried")]


def test_heir_that_does_not_ask_loses_the_offer() -> None:
    it = bench().moving()
    it.feed(GiveUpDue(it.course.moves, "did not ask for the task within 5.0 s"))
    assert it.of(Tell) == Tell(Write.GIVE_UP, rules.GiveUp())
    it.came(BACK, Desired.RUN, (Write.GIVE_UP, Outcome.WRITTEN, ""), (Write.GIVE_UP, Outcome.COUNTS, ""))
    assert isinstance(it.of(Resume), Resume)
    assert it.of(AttemptFailed).refusal == Refusal("unable", "did not ask for the task within 5.0 s")


def test_heir_that_declines_is_told_of() -> None:
    it = bench().moving()
    refusal = Refusal("unsupported", "lacks the device type motors")
    it.feed(Refused(refusal))
    it.came(BACK, Desired.RUN)
    assert it.of(AttemptFailed) == AttemptFailed("b", refusal)


def test_offer_that_cannot_be_written_is_no_migration() -> None:
    it = bench()
    it.feed(Award(B))
    it.feed(StoodStill(it.of(Freeze).number, "carried"), Frozen(LATER, SEQUEL))
    it.came(None, Desired.RUN, (Write.OFFER, Outcome.FAILED, "the disk is full"))
    assert isinstance(it.of(Resume), Resume)
    assert it.of(AttemptFailed).refusal == Refusal("failed", "the disk is full")


def test_task_that_does_not_run_cannot_be_given_away() -> None:
    it = Bench(OWNED._replace(wanted=Wanted.STOPPED), Desired.PAUSE)
    (failed,) = it.feed(Award(B))
    assert (failed.peer, failed.refusal.code) == ("", "conflict")


def test_task_that_is_taken_over_while_it_is_paused_ends() -> None:
    it = Bench(GUARDED, Desired.RUN).running().moving()
    taken = GUARDED._replace(epoch=Epoch(1, B), no=0, promised=Epoch(1, B), state=LATER)
    it.came(taken, Desired.END)
    assert it.of(Drop) == Drop(ends=True) and isinstance(it.of(TellToEnd), TellToEnd)
    it.feed(Finished("it ended"))
    assert isinstance(it.of(Vacate), Vacate)


def test_task_without_its_permit_is_held_until_it_is_back() -> None:
    it = Bench(GUARDED, Desired.RUN).running()
    assert it.came(None, Desired.PAUSE) == [Hold()]
    assert it.came(None, Desired.RUN) == [LetGoOn()]


def test_owner_of_a_later_state_starts_again_from_it() -> None:
    it = Bench(GUARDED, Desired.RUN).running()
    it.came(None, Desired.PAUSE)
    again = GUARDED._replace(epoch=Epoch(2, A), no=0, promised=Epoch(2, A), state=LATER)
    it.came(again, Desired.PAUSE)
    assert isinstance(it.of(TellToEnd), TellToEnd)
    it.feed(Finished("it ended"), CameToRest(b"what it carried"))
    assert not any(isinstance(told, Tell) for told in it.effects), "what it carried is not written any more"


def test_disputed_task_is_paused_and_keeps_its_last_state() -> None:
    it = bench()
    disputed = OWNED._replace(no=4, wanted=Wanted.DISPUTED)
    it.came(disputed, Desired.PAUSE)
    assert isinstance(it.of(TellToEnd), TellToEnd)
    it.feed(Finished("it ended"), CameToRest(LATER))
    assert it.of(Tell).event == rules.Want(Wanted.RUNNING, LATER)
    it.came(disputed._replace(no=5, state=LATER), Desired.PAUSE, (Write.REST, Outcome.WRITTEN, ""))
    it.feed(StartAsked(REQUEST))
    assert "is owned by another agent too" in it.of(Answer).reason


def test_task_that_comes_opens_a_place_and_starts_there() -> None:
    it = Bench(Standing.HEIR, has_place=False)
    owned = OWNED._replace(epoch=Epoch(3, A, 5), promised=Epoch(3, A, 5))
    assert it.came(owned, Desired.RUN) == [OpenPlace()]
    it.life = Life("a/client/Scan", Restarts(RestartSpec()))
    it.feed(PlaceFree())
    it.feed(Room())
    assert it.of(Prepare) == Prepare(fresh=True)


@pytest.mark.parametrize("standing", [Standing.HEIR, Standing.YIELDED])
def test_migration_in_doubt_is_told_of_once_it_lasts(standing: Standing) -> None:
    it = Bench(standing, has_place=False)
    it.feed(ServiceBegan())
    (later,) = it.effects
    assert isinstance(later.event, InDoubt)
    assert [type(told) for told in it.feed(later.event)] == [Warn]
    it.came(GONE, Desired.END)
    assert it.feed(later.event) == []


def test_sequel_is_done_after_a_restart() -> None:
    it = Bench(Standing.RELEASED, has_place=False)
    it.course = replace(it.course, record=record(GONE, SEQUEL))
    it.feed(ServiceBegan())
    assert it.of(HandedOver) == HandedOver("b", Epoch(1, B, 4), SEQUEL)


def test_offer_of_a_service_that_ended_is_taken_back() -> None:
    it = Bench(OFFERED, Desired.PAUSE)
    it.feed(ServiceBegan())
    assert it.of(Tell) == Tell(Write.GIVE_UP, rules.GiveUp())
    it.came(BACK, Desired.RUN, (Write.GIVE_UP, Outcome.WRITTEN, ""))
    assert isinstance(it.of(AskRoom), AskRoom), "it goes on here"


def test_start_that_was_refused_leave_is_tried_again() -> None:
    it = Bench(OWNED, Desired.RUN)
    it.feed(ServiceBegan())
    it.feed(Room(), LeaveRefused("its actuators are not free"))
    assert it.life is not None and it.life.state is State.REFUSED and not it.course.granted
