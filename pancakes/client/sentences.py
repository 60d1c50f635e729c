"""What agents say on `log`, as short sentences for people. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from pancakes.events import SAID_IN_A_LINE

QUIET: Final = (
    "peer_up",
    "peer_down",
    "service_started",
    "service_stopped",
    "ready",
    "roster",
    "task_frozen",
    "safe_hold",
)
"""Kinds of events that a person need not see."""
_ENVELOPE: Final = ("t_s", "agent", "source", "kind", "number", "entry")


def is_quiet(record: Mapping[str, Any]) -> bool:
    """Returns whether a person need not see a record of a log (`pancakes.runtime.services.log_record.record_of`)."""
    kind = record["kind"]
    if kind == "line":
        return record.get("level") not in ("warning", "error")
    return kind in QUIET or kind in SAID_IN_A_LINE or record.get("service") in ("device", "network", "log")


def sentence_of(record: Mapping[str, Any]) -> str:
    """Returns a record of a log as a short line."""
    kind = record["kind"]
    agent = str(record["agent"])
    make = _SENTENCES.get(kind)
    if make is not None:
        try:
            return make(agent, record)
        except (KeyError, TypeError, ValueError):
            pass  # an event of a user's own that bears the same name
    rest = ", ".join(f"{key} {_short(value)}" for key, value in record.items() if key not in _ENVELOPE)
    return f"{agent}: {str(kind).replace('_', ' ')}" + (f" ({rest})" if rest else "")


def _migration(agent: str, record: Mapping[str, Any]) -> str:
    only = f" (only {record['to']} was asked)" if record.get("to") else ""
    return f"{record['task']} {record['outcome']}" + (f" to {record['winner']}" if record["winner"] else "") + only


def _asked(agent: str, record: Mapping[str, Any]) -> str:
    return f"{agent} asks {'only ' + record['to'] if record.get('to') else 'all neighbours'} to take {record['task']}"


_SENTENCES: Final = {
    "line": lambda agent, it: f"{agent}: {it['text']}",
    "task_started": lambda agent, it: f"{agent} runs {it['task']}",
    "task_stopped": lambda agent, it: f"{agent} stopped {it['task']}: {it['reason']}",
    "migration_asked": _asked,
    "migration_bid": lambda agent, it: f"{agent} bids {it['cost']:g} for {it['task']}",
    "migration_refused": lambda agent, it: f"{agent} refuses {it['task']}: {it['reason']}",
    "migration": _migration,
    "task_arrived": lambda agent, it: f"{agent} took {it['task']} from {it['source_agent']} with its state",
    "agent_lost": lambda agent, it: f"{agent} is killed",
    "agent_returned": lambda agent, it: f"{agent} is started again, on its disk",
    "task_handed_over": lambda agent, it: f"{agent} handed {it['task']} over to {it['to']}",
    "taken_over": lambda agent, it: f"{it['by']} took {it['task']} over from {it['source_agent']}, which is silent",
    "permit_lost": lambda agent, it: f"{it['task']} stands still on {agent}: its guardians do not answer",
    "rate_changed": lambda agent, it: f"{agent} runs {it['task']} at {it['rate_hz']:g} Hz, asked by {it['by']}",
    "collision": lambda agent, it: f"collision: {' and '.join(it['names'])}",
}


def _short(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_short(it)}" for name, it in value.items())
    if isinstance(value, list | tuple):
        return f"({', '.join(_short(it) for it in value)})"
    if isinstance(value, float):
        # What is next to nothing is nothing to a person.
        return f"{round(value, 6) + 0.0:.3g}" if abs(value) >= 0.001 else "0"
    return str(value)
