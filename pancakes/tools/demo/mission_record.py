"""Read the record of a mission: the events of the agents, and which agent ran a task when."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO, TypeVar

from pancakes.errors import PancakesError
from pancakes.util.codecs import why_malformed

_T = TypeVar("_T")
_ENDS = ("task_frozen", "task_stopped", "task_failed", "task_given_up")


@dataclass(frozen=True, slots=True)
class MissionEvent:
    """An event of an agent: a line of `events.jsonl`.

    Attributes:
        t_s: mission time.
        agent: the agent that published it.
        kind: the kind of event.
        fields: the other fields of the line.
    """

    t_s: float
    agent: str
    kind: str
    fields: Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class MissionRecord:
    """All events of a mission.

    Attributes:
        events: the events, in the order of time.
    """

    events: list[MissionEvent]

    def running_at_first(self, task: str) -> list[str]:
        """Return the agents that ran a task when the mission began, according to the launcher's `roster`."""
        return [event.agent for event in self.told("roster") if task in event.fields.get("tasks", ())]

    def told(self, kind: str, agent: str = "", task: str = "") -> Iterator[MissionEvent]:
        """Yield the events of a kind, optionally only of one agent or about one task."""
        for event in self.events:
            if event.kind == kind and agent in ("", event.agent) and task in ("", event.fields.get("task")):
                yield event


@dataclass(frozen=True, slots=True)
class Holder:
    """An agent that ran a task for some time.

    Attributes:
        agent: the agent.
        start_s: mission time.
        end_s: mission time; the mission's end if the task still ran then.
    """

    agent: str
    start_s: float
    end_s: float


def read_events(out_dir: Path) -> list[MissionEvent]:
    """Read the `events.jsonl` of a mission.

    Raises:
        PancakesError: the file is missing, or a line is malformed; the message names the line.
    """
    path = out_dir / "events.jsonl"
    events = []
    for number, text in read_lines(path, iter):
        try:
            fields = json.loads(text)
            event = MissionEvent(float(fields.pop("t_s")), str(fields.pop("agent")), str(fields.pop("kind")), fields)
            events.append(event)
        except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
            raise PancakesError(f"{path}: line {number} is not an event: {why_malformed(error)}") from None
    return sorted(events, key=lambda event: event.t_s)


def read_lines(path: Path, split: Callable[[TextIO], Iterable[_T]]) -> Iterator[tuple[int, _T]]:
    """Yield the items into which `split` divides a mission's file, numbered from 1.

    Raises:
        PancakesError: the file cannot be read.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            yield from enumerate(split(file), start=1)
    except OSError as error:
        raise PancakesError(f"the mission's {path.name} cannot be read: {error.strerror}") from None


def holders(story: MissionRecord, task: str, end_s: float) -> list[Holder]:
    """Return the agents that ran a task, in the order of time.

    A task does not run from its freeze for a migration on, nor on an agent that was killed.
    """
    found = []
    since: dict[str, float] = dict.fromkeys(story.running_at_first(task), 0.0)
    for event in story.events:
        if event.kind == "agent_lost" and event.agent in since:
            found.append(Holder(event.agent, since.pop(event.agent), event.t_s))
        if event.fields.get("task") != task:
            continue
        if event.kind in ("task_started", "task_resumed"):
            since.setdefault(event.agent, event.t_s)
        elif event.kind in _ENDS and event.agent in since:
            found.append(Holder(event.agent, since.pop(event.agent), event.t_s))
    found += [Holder(agent, start_s, max(start_s, end_s)) for agent, start_s in since.items()]
    return sorted(_joined(found), key=lambda holder: holder.start_s)


def _joined(found: list[Holder]) -> list[Holder]:
    """Join stays of the same agent that a restart, or a cancelled migration, split."""
    joined: list[Holder] = []
    for holder in sorted(found, key=lambda holder: (holder.start_s, holder.end_s)):
        last = joined[-1] if joined else None
        if last is not None and last.agent == holder.agent:
            joined[-1] = Holder(last.agent, last.start_s, max(last.end_s, holder.end_s))
        else:
            joined.append(holder)
    return joined
