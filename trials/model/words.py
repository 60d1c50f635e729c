"""Steps of a search in words that a person understands."""

from __future__ import annotations

from typing import Any

from model.parts import Keep

from pancakes.durable.handoff_events import (
    Ack,
    AdoptionAsked,
    Award,
    Born,
    Checkpoint,
    Discard,
    Effect,
    Ended,
    Freeze,
    FreezeFailed,
    Frozen,
    GiveUp,
    Persist,
    Received,
    Resend,
    ReservationExpired,
    Resume,
    RunAsked,
    Send,
    StartTask,
)
from pancakes.durable.record import Phase, Record, Wanted


def cause(me: str, event: Any, late: bool = False) -> str:
    """Returns what happens, in words, before anything is done about it; `late`: it was under way in the agent."""
    if late and isinstance(event, Checkpoint):
        return f"the checkpoint that was stuck on agent {me} comes through"
    if late:
        return f"agent {me} tries once more to write down what it could not write before"
    match event:
        case Born():
            return f"the task is started on agent {me} for the first time in its life"
        case Received(peer, message, refusal):
            what = f"agent {me} receives {_message(message)} from {peer}"
            return f"{what}, and cannot do that" if refusal else what
        case Award(peer):
            return f"agent {me} is to move the task to {peer}, which made the best bid"
        case Frozen():
            return f"the task on agent {me} has come to a stop"
        case FreezeFailed():
            return f"the task on agent {me} cannot be stopped"
        case GiveUp(offer):
            return f"a timer of agent {me} says that the offer {offer} has taken long enough"
        case Resend(_, phase):
            return f"agent {me} is {phase.name} and has heard nothing: it is time to say it again"
        case ReservationExpired(peer):
            return f"agent {me} has waited long enough for {peer} to answer the reservation"
        case Checkpoint():
            return f"the task on agent {me} is written down"
        case RunAsked(again):
            what = "fails, and its service starts it again" if again else "is asked to start"
            return f"the task on agent {me} {what}"
        case Ended(wanted):
            how = "stopped as asked" if wanted is Wanted.STOPPED else "given up by its service"
            return f"the task on agent {me} is {how}"
        case AdoptionAsked():
            return f"a person has agent {me} adopt the task"
        case _:
            return f"agent {me}: {event}"


def deeds(effects: list[Effect]) -> str:
    """Returns what an agent does, in words; empty where nothing of it shows."""
    return ", ".join(word for effect in effects if (word := _deed(effect)))


def shows(effect: Effect) -> bool:
    """Returns whether a crash just after this effect differs from one just before it."""
    return isinstance(effect, Persist | Send | StartTask | Resume | Ack | Keep)


def _deed(effect: Effect | Keep) -> str:
    match effect:
        case Persist(record):
            return f"persists {_record(record)}"
        case Keep(record):
            return f"is {_record(record)} from now on, but does not persist it"
        case Send(peer, message):
            return f"sends {_message(message)} to {peer}"
        case StartTask(epoch):
            return f"starts the task under epoch {epoch}"
        case Resume(epoch):
            return f"lets the task go on under epoch {epoch}"
        case Freeze():
            return "begins to stop the task"
        case Discard():
            return "lets go of the object that stands still"
        case Ack(packet):
            return f"acknowledges packet {packet.seq}"
        case _:
            return ""


def _record(record: Record) -> str:
    match record.phase:
        case Phase.FROZEN | Phase.COMMITTED:
            return f"{record.phase.name} (offer {record.offer} to {record.peer})"
        case Phase.PREPARED:
            return f"PREPARED (offer {record.offer} from {record.peer})"
        case Phase.OWNER if record.wanted is not Wanted.RUNNING:
            return f"OWNER (epoch {record.epoch}, to be {record.wanted.value})"
        case Phase.OWNER:
            return f"OWNER (epoch {record.epoch})"
        case Phase.RELEASED:
            return f"RELEASED (to {record.peer})"
        case _:
            return record.phase.name


def _message(message: Any) -> str:
    return f"{type(message).__name__.upper()} {message.offer}"
