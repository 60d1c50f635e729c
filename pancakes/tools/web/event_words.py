"""Say what events mean to a person who watches a page: its own sentences, and which events only the list of all shows.

Pure. `pancakes.client.rows` has the sentences of all other events, which terminals show too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from pancakes.client import rows

INTERNAL: Final = frozenset(
    (
        *("task_called", "task_taken", "guards_chosen", "mission_joined"),
        *("no_dead_man", "born_unasked", "not_born", "birth_waits", "clock_stepped"),
    )
)
"""Kinds of events that are steps of the protocols, or that a line of the log tells people as well."""
RULE, GUARDIANS = "rule", "guardians"


def is_quiet(record: Mapping[str, Any]) -> bool:
    """Return whether the news leave out a record of a log (`pancakes.events.record_of`)."""
    return record["kind"] in INTERNAL or rows.is_quiet(record)


def sentence_of(record: Mapping[str, Any]) -> str:
    """Return a record of a log as a short line."""
    make = _SENTENCES.get(record["kind"])
    if make is not None:
        try:
            sentence = make(str(record["agent"]), record)
        except (AttributeError, KeyError, TypeError, ValueError):
            sentence = ""  # an event of a user's own with the same name
        if sentence:
            return sentence
    return rows.sentence_of(record)


def _migration(agent: str, record: Mapping[str, Any]) -> str:
    task, source, by = record["task"], record["source"], record["asked_by"]
    if record["outcome"] == "moved" and by == GUARDIANS:
        return f"{record['winner']} took {task} over from {source}"
    if record["outcome"] == "stayed":
        return f"{task} stays on {source}: {_why(record)}" + (f" ({by})" if by in (RULE, GUARDIANS) else "")
    return ""


def _why(record: Mapping[str, Any]) -> str:
    """Return why a task was not migrated."""
    lines, only = record["lines"], record.get("to")
    failed = [line["peer"] for line in lines if line["fate"] == "failed"]
    if failed:
        return f"the migration to {' and '.join(failed)} failed"
    if not lines:
        return "no agent was asked"
    if all(line["answer"] == "silent" for line in lines):
        return f"{only} does not answer" if only else "no agent answers"
    return f"{only} cannot take it" if only else "no agent can take it"


def _asked(agent: str, record: Mapping[str, Any]) -> str:
    what = record.get("task") or record.get("service")
    return f"{agent} is asked to {record['what']}{f' {what}' if what else ''} by {str(record['by']).split('/')[0]}"


def _called(agent: str, record: Mapping[str, Any]) -> str:
    return f"{agent} is called to take {record['task']} over: its owner is silent for {record['silent_s']:.1f} s"


_SENTENCES: Final[Mapping[str, Callable[[str, Mapping[str, Any]], str]]] = {
    "migration": _migration,
    "asked": _asked,
    "permit_given": lambda agent, it: f"its guardians let {agent} run {it['task']}",
    "task_called": _called,
    "task_taken": lambda agent, it: f"the guardians of {it['task']} give it to {agent}",
    "guards_chosen": lambda agent, it: f"{' and '.join(it['guardians'])} guard {it['task']}",
    "mission_joined": lambda agent, it: f"{agent} has its mission time from {it['peer']}",
    "no_dead_man": lambda agent, it: f"{it['device']} of {agent} keeps its last command if its process ends",
}
