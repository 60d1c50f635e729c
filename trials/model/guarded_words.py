"""The steps of the search of guarded tasks as sentences."""

from __future__ import annotations

from typing import Any

from model.guarded_parts import Farewell, Word, short

from pancakes.durable.handoff_events import ClaimHeard
from pancakes.durable.messages import DenyLease, KeepLease, LeaseKept, Pledge, SeizeTask


def told(names: str, step: tuple[int, Any, int]) -> str:
    """Returns a step of an agent as a sentence."""
    i, what, cut = step
    text = f"Agent {names[i]} {_shown(what)}" if i >= 0 else str(what)
    crash = f", and crashes after {cut} of its effects" if cut else ""
    return f"{text}{crash}."


def _shown(what: Any) -> str:
    match what:
        case KeepLease():
            sets = " and ".join(
                "".join(f"{it.agent}{it.journal[1:].strip('0')}" for it in one) for one in what.guards.sets
            )
            return (
                f"gets KEEP {short(what.epoch)} (asking {what.beat}, checkpoint {what.checkpoint.no}"
                f"{'' if what.body is not None else ' without its body'}, guards {sets})"
            )
        case SeizeTask():
            return f"gets SEIZE {short(what.epoch)}"
        case Farewell(_, word):
            return f"gets YIELD {short(word.epoch)} (asking {word.beat}{'' if word.boot else ', to a former life'})"
        case Word(source, _, message):
            return f"gets {type(message).__name__.upper()} {short(message.offer)} of {source}"
        case ClaimHeard(peer, epoch):
            return f"hears that {peer} owns it under {short(epoch)}"
        case tuple():
            return f"hears {' and '.join(_answer(answer) for answer in what)}"
        case _:
            return str(what)


def _answer(answer: LeaseKept | DenyLease | Pledge) -> str:
    by = answer.guardian.agent
    match answer:
        case LeaseKept():
            return f"KEPT {short(answer.epoch)} of {by} (asking {answer.beat}, checkpoint {answer.no})"
        case Pledge():
            at = answer.checkpoint
            return f"PLEDGE {short(answer.epoch)} of {by} (checkpoint {short(at.epoch)}/{at.no})"
        case _:
            return f"DENY of {by}, which follows {short(answer.promised)}"
