"""All that can happen next to a hosted task in its world."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from model.hosting_rim import Rim
from model.hosting_world import BIRTH, LATER, PEER, REQUEST, Bounds, Violation, World
from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.durable import state_machine as event
from pancakes.durable.handoff import is_disputed
from pancakes.durable.handoff_events import (
    AdoptionAsked,
    Award,
    Checkpoint,
    ClaimHeard,
    ForgettingAsked,
    Received,
    RemovalAsked,
    Resend,
)
from pancakes.durable.messages import Abort, Activated, Commit, Nak, Prepared, Reserved, Transfer
from pancakes.durable.record import NO_EPOCH, Epoch, Phase, Record, TaskId, Wanted
from pancakes.durable.state_machine import Standing, idle, settled
from pancakes.supervision.lifecycle import (
    CLOSES,
    Began,
    Finished,
    Overdue,
    Request,
    Retry,
    StartAsked,
    State,
    StopAsked,
)

TASK: Final = TaskId("a", "Task")
LACKS: Final = Refusal("unsupported", "lacks the device type motors")
GOING: Final = (Phase.FROZEN, Phase.COMMITTED, Phase.PREPARED)
"""The phases in which nothing can be asked of a task."""
MOST_WAIT: Final = 1
"""So many events wait for a record to be written; messages and timers that repeat themselves come later then."""
MESSAGES: Final = (Received, Award, AdoptionAsked, ForgettingAsked, RemovalAsked, ClaimHeard)
RESTS: Final = (State.STOPPED, State.REFUSED, State.FAILED)
Following = Iterator[tuple[str, World]]


class Steps:
    """Yields what can happen next.

    Args:
        rim: carries out what follows.
        bounds: what may happen.

    Attributes:
        what: what was tried last.
    """

    def __init__(self, rim: Rim, bounds: Bounds) -> None:
        self._rim = rim
        self._bounds = bounds
        self.what = ""

    def begin(self) -> Following:
        """Yields the worlds in which a history begins."""
        task_id = TaskId(PEER, "Task") if self._bounds.visitor else TASK
        none = Record(task_id)
        nowhere = World(Standing(none), none, blocked=self._bounds.blocked, lost=self._bounds.lost)
        for world in self._rim.arise(none, nowhere):
            yield "its service begins", world

    def after(self, world: World) -> Following:
        """Yields the worlds that can follow one, each with what has happened."""
        waiting = world.standing.events
        for what, before, told in self._all(world):
            self.what = what
            if told in waiting or (len(waiting) >= MOST_WAIT and isinstance(told, (*MESSAGES, Resend))):
                continue
            for following in self._rim.feed(before, told):
                refused = following.life is not None and following.life.state is State.REFUSED
                if isinstance(told, Retry) and refused and settled(world.standing) and following.writing == world.disk:
                    raise Violation("each try of its start is written down")
                yield what, following
        yield from self._of_the_service(world)

    def _all(self, world: World) -> Iterator[Any]:
        yield from self._of_the_disk(world)
        yield from self._of_its_actor(world)
        yield from self._timers(world)
        yield from self._requests(world)
        yield from self._decisions(world)
        yield from self._claims(world)
        yield from self._knowledge(world)
        yield from self._as_a_source(world)
        yield from self._as_a_destination(world)
        if world.parts:
            yield "a part of what follows is done", replace(world, parts=world.parts - 1), event.PartConcluded()
        if world.blocked:
            yield "the other task has left", replace(world, blocked=False), event.PlaceFree()
        elif self._bounds.blocked:
            yield "another task of its name has left", world, event.PlaceFree()

    # This agent ------------------------------------------------------------------------------------------------

    def _of_the_disk(self, world: World) -> Iterator[Any]:
        record, spent = world.writing, world.spent
        if record is None:
            return
        done = replace(world, writing=None)
        yield "the record is written", _on_disk(done, record), event.Persisted()
        if spent.faults < self._bounds.faults:
            fault = replace(done, spent=replace(spent, faults=spent.faults + 1))
            yield "the record cannot be written", fault, event.NotPersisted("the disk is full")
            written = _on_disk(fault, record)
            yield "the record is written, and an error reported", written, event.NotPersisted("the disk is full")

    def _of_its_actor(self, world: World) -> Iterator[Any]:
        actor, bounds, spent = world.actor, self._bounds, world.spent
        if world.stood:
            (offer, still), *later = world.stood
            told = event.StoodStill(offer, "what it carries") if still else event.StoodStill(offer, reason="it cannot")
            what = "it says that it stands still" if still else "it says that it cannot stand still"
            yield what, replace(world, stood=tuple(later)), told
        elif actor == "made":
            yield "it runs", replace(world, actor="runs"), Began()
        elif actor == "told early":
            yield "it runs, late", replace(world, actor="told"), Began()
        if not actor or world.stood:
            return
        ends = actor in ("told", "told early")
        if ends or spent.ends < bounds.ends:
            gone = replace(world, actor="", inbox=(), spent=spent if ends else replace(spent, ends=spent.ends + 1))
            closing = bool(world.closing)
            if actor != "made":
                yield "it ends", replace(gone, carried=LATER), Finished("it ended", closing=closing)
            if actor != "made" and bounds.checkpoints:
                yield "it ends as it began", replace(gone, carried=BIRTH), Finished("it ended", closing=closing)
            if bounds.errors and not ends:
                yield "it fails", gone, Finished("it failed", True, closing=closing)
                yield "it fails for good", gone, Finished("it failed", True, True, closing)

    def _timers(self, world: World) -> Iterator[Any]:
        for timer in sorted(world.timers, key=str):
            if isinstance(timer, Overdue) and not self._bounds.sticks:
                continue
            yield f"{type(timer).__name__} comes", replace(world, timers=world.timers - {timer}), timer
        life, bounds = world.life, self._bounds
        runs = life is not None and life.state is State.RUNNING
        if bounds.checkpoints and runs and idle(world.standing) and world.standing.record.snapshot != LATER:
            record = world.standing.record
            yield "it is written down", world, Checkpoint(record.epoch, record.incarnation, LATER)

    def _of_the_service(self, world: World) -> Following:
        """Yields what happens without the machine, and what makes all begin anew."""
        if world.inbox:
            yield from self._actor_reads(world)
        life, spent = world.life, world.spent
        if world.closing == "" and self._bounds.closes:
            left = life is not None and life.state not in (State.STOPPED, State.REFUSED)
            yield "its service begins to end", replace(world, closing="begun" if left else "over")
        if world.closing == "begun":
            told = replace(world, closing="told")
            if life is None or life.at_rest:
                yield "its turn to end has come, and it rests", replace(world, closing="over")
            else:
                self.what = "its turn to end has come"
                for following in self._rim.feed(told, StopAsked(reason=CLOSES)):
                    yield self.what, following
        if world.closing == "over" and world.writing is None and spent.crashes < self._bounds.crashes:
            again = replace(world, spent=replace(spent, crashes=spent.crashes + 1))
            for fresh in (False, True):
                self.what = "its service has ended and begins again" + (", anew" if fresh else "")
                for following in self._rim.arise(world.disk, again, fresh):
                    yield self.what, following
        if spent.crashes < self._bounds.crashes:
            again = replace(world, spent=replace(spent, crashes=spent.crashes + 1))
            for record in dict.fromkeys((world.disk, world.writing or world.disk)):
                told_of = replace(again, lost=world.lost and record == world.disk)
                self.what = f"the agent crashes, and finds {record.phase.name}"
                for following in self._rim.arise(record, told_of):
                    yield self.what, following

    def _actor_reads(self, world: World) -> Following:
        offer, *later = world.inbox
        read = replace(world, inbox=tuple(later))
        if offer is None:
            yield "it goes on", replace(read, actor="runs" if world.actor == "still" else world.actor)
        else:
            yield "it stands still", replace(read, actor="still", stood=(*world.stood, (offer, True)))
            if self._bounds.refusals:
                yield "it cannot stand still", replace(read, actor="runs", stood=(*world.stood, (offer, False)))

    # People ----------------------------------------------------------------------------------------------------

    def _requests(self, world: World) -> Iterator[Any]:
        life, record, spent = world.life, world.standing.record, world.spent
        if self._bounds.follows and not spent.followed and life is not None and life.state in RESTS:
            asked = replace(world, asked_for=world.asked_for | {"follow"}, spent=replace(spent, followed=True))
            yield "another task has left, and it is to follow", asked, event.StartWanted()
        if life is None or life.asker is not None or spent.requests >= self._bounds.requests:
            return
        if world.standing.volatile.freezing or world.standing.leaving or record.phase in GOING:
            return
        number = spent.requests + 1
        request = Request("b/task", ("b/task", number), number)
        spent = replace(spent, requests=number)
        for what in ("start", "stop", "restart"):
            asked = replace(world, open=world.open | {(number, what)}, spent=spent)
            if what == "start" and life.state in (*RESTS, State.RESTARTING):
                yield "a start is asked for", asked, StartAsked(request)
            elif what == "stop" and life.state is not State.STOPPED and record.phase is not Phase.RELEASED:
                yield "a stop is asked for", asked, StopAsked(request, "asked for")
            elif what == "restart":
                yield "a restart is asked for", replace(asked, fresh=True), StopAsked(request, "asked for", again=True)

    def _decisions(self, world: World) -> Iterator[Any]:
        record, spent = world.standing.record, world.spent
        if spent.decisions >= self._bounds.decisions:
            return
        if world.asked_for & {"adopt", "forget", "forgotten", "give up", "remove"}:
            return
        asked = replace(world, spent=replace(spent, decisions=spent.decisions + 1))
        adopting = replace(asked, asked_for=world.asked_for | {"adopt"})
        stands = record.phase is Phase.OWNER and world.life is not None and world.life.at_rest
        if self._bounds.removals and stands and not is_disputed(record) and not world.closing:
            yield "it is removed", replace(asked, asked_for=world.asked_for | {"remove"}), RemovalAsked()
        if record.in_doubt:
            yield "it is adopted", adopting, AdoptionAsked()
        if is_disputed(record) and world.life is not None and world.life.at_rest and not world.closing:
            yield "it is adopted", adopting, AdoptionAsked()
            giving_up = replace(asked, asked_for=world.asked_for | {"give up"})
            yield "it is given up", giving_up, ForgettingAsked(record.seen, PEER)
        if record.phase is Phase.RELEASED and not record.sequel and not world.closing:
            yield "it is revived", adopting, AdoptionAsked(BIRTH, 0, 2)
        if world.unsure and record.unborn and not world.closing:
            yield "it is adopted", adopting, AdoptionAsked(BIRTH, 0, 2)
        if world.lost and record.phase is Phase.ABSENT:
            yield "it is adopted", adopting, AdoptionAsked(BIRTH, 0, 2)
            forgetting = replace(asked, asked_for=world.asked_for | {"forget"})
            yield "it is forgotten", forgetting, ForgettingAsked(NO_EPOCH)

    def _claims(self, world: World) -> Iterator[Any]:
        record, spent = world.standing.record, world.spent
        may = spent.claims < self._bounds.claims and world.closing != "over"
        if may and record.phase is Phase.OWNER and not is_disputed(record):
            heard = replace(world, spent=replace(spent, claims=spent.claims + 1))
            yield "another agent says that it owns it", heard, ClaimHeard(PEER, Epoch(record.epoch.n + 1, PEER))

    def _knowledge(self, world: World) -> Iterator[Any]:
        life, record, spent = world.life, world.standing.record, world.spent
        owns = record.phase is Phase.OWNER and life is not None
        lives = life is not None and life.state in (State.STARTING, State.RUNNING)
        # One that is being handed over stands still, and is looked at again once that is over.
        halts = owns and lives and idle(world.standing) and not world.standing.volatile.asked
        told = StopAsked(reason="it may be elsewhere", again=True) if halts else Retry()
        if world.unsure:
            yield "others have told what they know of it", replace(world, unsure=False), Retry()
            if halts:
                yield "its agent looks again whether it stands still", world, told
        elif spent.copies < self._bounds.copies and owns:
            copied = replace(world, unsure=True, spent=replace(spent, copies=spent.copies + 1))
            yield "others take the disk of its agent for an old copy", copied, told

    # The other agent -------------------------------------------------------------------------------------------

    def _as_a_source(self, world: World) -> Iterator[Any]:
        record, bounds = world.standing.record, self._bounds
        spent = world.spent
        may = spent.awards < bounds.awards and record.seen.n < bounds.offers and "move" not in world.asked_for
        if may and not world.closing and record.phase is Phase.OWNER and record.wanted is Wanted.RUNNING:
            spent = replace(spent, awards=spent.awards + 1)
            asked = replace(world, asked_for=world.asked_for | {"move"}, spent=spent)
            yield "the other agent is chosen", asked, Award(PEER, REQUEST)
        for kind, offer in sorted(world.sent):
            if kind in ("reserve", "transfer"):
                yield "NAK comes", world, Received(PEER, Nak(TASK, offer, LACKS))
            if kind == "reserve":
                yield "RESERVED comes", world, Received(PEER, Reserved(TASK, offer))
            if kind == "transfer":
                yield "PREPARED comes", world, Received(PEER, Prepared(TASK, offer))
            if kind == "commit":
                yield "ACTIVATED comes", world, Received(PEER, Activated(TASK, offer))

    def _as_a_destination(self, world: World) -> Iterator[Any]:
        theirs, bounds, task_id = world.theirs, self._bounds, world.standing.record.task_id
        if len(theirs) < bounds.theirs and self._is_theirs(world) and (not theirs or theirs[-1][1] != "offered"):
            highest = max([0, *(offer.n for offer, _ in theirs), *(offer.n for _, offer in world.sent)])
            offer = Epoch(highest + 1, PEER)
            offered = self._with(world, (*theirs, (offer, "offered")), True)
            yield "TRANSFER comes", offered, Received(PEER, Transfer(task_id, offer, BIRTH))
        for index, (offer, became) in enumerate(theirs):
            again = Received(PEER, Transfer(task_id, offer, BIRTH))
            yield "TRANSFER comes again", self._with(world, theirs, offer > world.standing.record.seen), again
            if became != "committed":
                aborted = (*theirs[:index], (offer, "aborted"), *theirs[index + 1 :])
                yield "ABORT comes", replace(world, theirs=aborted), Received(PEER, Abort(task_id, offer))
            if became == "committed" or (became == "offered" and ("prepared", offer) in world.sent):
                committed = (*theirs[:index], (offer, "committed"), *theirs[index + 1 :])
                yield "COMMIT comes", replace(world, theirs=committed), Received(PEER, Commit(task_id, offer))

    def _with(self, world: World, theirs: tuple[tuple[Epoch, str], ...], news: bool) -> World:
        """Returns the world in which a snapshot comes: where it is news, actuators are kept for it."""
        taken = news and world.standing.record.phase in (Phase.ABSENT, Phase.RELEASED, Phase.PREPARED)
        return replace(world, theirs=theirs, reserved=world.reserved or taken)

    def _is_theirs(self, world: World) -> bool:
        """Returns whether the other agent may own the task, and so may offer it."""
        ours = [offer for kind, offer in world.sent if kind == "commit"]
        given = [offer for offer, became in world.theirs if became == "committed"]
        birth = Epoch(0, PEER if self._bounds.visitor else "a")
        anew = self._bounds.lost or self._bounds.wiped
        return anew or max([birth, *ours, *given]) in ([*ours, birth] if self._bounds.visitor else ours)


def _on_disk(world: World, record: Record) -> World:
    """Returns the world in which a record is on disk."""
    forgotten = "forget" in world.asked_for and record.phase is Phase.ABSENT and record.seen != NO_EPOCH
    asked_for = world.asked_for - {"forget"} | {"forgotten"} if forgotten else world.asked_for
    unsure = world.unsure and not world.disk.unborn  # once there is a record, nothing is asked about it
    return replace(world, disk=record, lost=False, unsure=unsure, asked_for=asked_for)
