"""What a client returns: agents, tasks, events and packets as typed rows, and events as sentences for people.

Pure: no threads, no sockets, no time. The page and the demos use the sentences too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar, cast

import msgspec

from pancakes.events import SAID_IN_A_LINE, Event
from pancakes.packet import Packet, agent_of, body_to_plain, join

Body = TypeVar("Body")


@dataclass(frozen=True, slots=True)
class ReceivedPacket(Generic[Body]):
    """A packet that was received.

    Attributes:
        agent: on whose channel it was published.
        packet: the packet; its destination is this program.
        at_s: when it was received, in host time (`Client.now`).
    """

    agent: str
    packet: Packet
    at_s: float

    @property
    def body(self) -> Body:
        """Its body: an instance of its type's class, or a plain mapping if the type is not known here."""
        return cast("Body", self.packet.body)

    @property
    def type(self) -> str:
        """The name of its type, such as `battery`."""
        return self.packet.type

    @property
    def source(self) -> str:
        """The address of its publisher, `agent/service/task`."""
        return self.packet.source

    @property
    def stamp_s(self) -> float:
        """When it was published, in mission seconds of its publisher's agent."""
        return self.packet.stamp_s


class AgentInfo(msgspec.Struct, frozen=True, kw_only=True):
    """An agent that answers.

    Attributes:
        agent, fleet: its name, and that of its fleet.
        role: `agent` or `environment`.
        ready: whether all its services have begun.
        held: whether its mission is held at 0.
        mission_s: the time of its mission.
        speed: mission seconds for each second of host time.
        battery_level: from 0 to 1; None: it has no battery.
        devices: the types of its devices.
        channels: its channels, the core channels first.
        neighbours: the agents that it is connected to.
    """

    agent: str
    fleet: str
    role: str
    ready: bool
    held: bool
    mission_s: float
    speed: float
    battery_level: float | None = None
    devices: tuple[str, ...] = ()
    channels: tuple[str, ...] = ()
    neighbours: tuple[str, ...] = ()


class TaskInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A task that an agent has; a device is a task too.

    Attributes:
        agent, service, task: where it is, and its name.
        type: the name of its class, such as `sim.battery`.
        state: `running`, `stopped`, `failed` and so on.
        rest: why it does not run, in a word, if its agent knows more than its state says; else empty.
        reason: why it stopped or failed, as a sentence; else empty.
        rate_hz: ticks for each second of mission time; None: it has no timer.
        ticks, missed: ticks since it began, and ticks that were skipped because it was late.
        lateness_max_s: the largest lateness of a tick, in seconds.
        dropped: packets that it lost because it was too slow.
        incarnation: how many times it has started.
    """

    agent: str
    service: str
    task: str
    type: str
    state: str
    rest: str = ""
    reason: str = ""
    rate_hz: float | None = None
    ticks: int = 0
    missed: int = 0
    lateness_max_s: float = 0.0
    dropped: int = 0
    incarnation: int = 0

    @property
    def address(self) -> str:
        """Its address, `agent/service/task`."""
        return join(self.agent, self.service, self.task)

    def __str__(self) -> str:
        return self.address


QUIET: Final = (
    "peer_up",
    "peer_down",
    "service_started",
    "service_stopped",
    "ready",
    "roster",
    "task_frozen",
    "safe_hold",
    "allocation_began",
)
"""Kinds of events that most people need not see."""
_ENVELOPE: Final = ("t_s", "agent", "source", "kind", "number", "entry")


def is_quiet(record: Mapping[str, Any]) -> bool:
    """Return whether a person need not see a record of a log (`pancakes.events.record_of`)."""
    kind = record["kind"]
    if kind == "line":
        return record.get("level") not in ("warning", "error")
    return kind in QUIET or kind in SAID_IN_A_LINE or record.get("service") in ("device", "network", "log")


def sentence_of(record: Mapping[str, Any]) -> str:
    """Return a record of a log as a short line."""
    kind = record["kind"]
    agent = str(record["agent"])
    make = _SENTENCES.get(kind)
    if make is not None:
        try:
            return make(agent, record)
        except (KeyError, TypeError, ValueError):
            pass  # an event of a user's own with the same name
    rest = ", ".join(f"{key} {_short(value)}" for key, value in record.items() if key not in _ENVELOPE)
    return f"{agent}: {str(kind).replace('_', ' ')}" + (f" ({rest})" if rest else "")


def _migration(agent: str, record: Mapping[str, Any]) -> str:
    only = f" (only {record['to']} was asked)" if record.get("to") else ""
    return f"{record['task']} {record['outcome']}" + (f" to {record['winner']}" if record["winner"] else "") + only


def _allocation(agent: str, record: Mapping[str, Any]) -> str:
    moves = [
        f"{line['task'].rpartition('/')[2]} to {line['winner']}"
        for line in record["lines"]
        if line["winner"] not in ("", line["owner"])
    ]
    would = "would migrate" if record["dry_run"] else "migrates"
    gap = "" if record["gap"] is None else f"; {record['gap']:.1%} below the best allocation"
    return f"allocation {record['number']}, begun by {agent}: {would} {', '.join(moves) or 'nothing'}{gap}"


def _asked(agent: str, record: Mapping[str, Any]) -> str:
    return f"{agent} asks {'only ' + record['to'] if record.get('to') else 'all neighbours'} to take {record['task']}"


def _filtered(agent: str, record: Mapping[str, Any]) -> str:
    does = {"passes": "lets commands pass again", "changes": "changes commands", "holds": "holds it"}[record["doing"]]
    reason = f": {record['reason']}" if record["reason"] else ""
    return f"{agent}/{record['device']}: the filter {record['filter']} {does}{reason}"


def _drive_begun(agent: str, record: Mapping[str, Any]) -> str:
    before = f", taken over from {agent_of(record['taken_from'])}" if record["taken_from"] else ""
    waits = f": {record['holder']} waits" if record["holder"] else ""
    return f"{agent_of(record['by'])} drives {record['device']} of {agent} by hand{before}{waits}"


def _drive_ended(agent: str, record: Mapping[str, Any]) -> str:
    why = {"ended": "", "silent": ", and is silent"}.get(record["reason"], f": the drive was {record['reason']}")
    goes_on = f": {record['holder']} goes on" if record["holder"] else ""
    return f"{agent_of(record['by'])} no longer drives {record['device']} of {agent}{why}{goes_on}"


_SENTENCES: Final = {
    "line": lambda agent, it: f"{agent}: {it['text']}",
    "task_reloaded": lambda agent, it: f"{it['task']} goes on in a new class on {agent}: {it['type']} {it['version']}",
    "task_started": lambda agent, it: f"{agent} runs {it['task']}",
    "task_stopped": lambda agent, it: f"{agent} stopped {it['task']}: {it['reason']}",
    "migration_asked": _asked,
    "migration_bid": lambda agent, it: f"{agent} bids {it['cost']:g} for {it['task']}",
    "migration_refused": lambda agent, it: f"{agent} refuses {it['task']}: {it['reason']}",
    "migration": _migration,
    "allocation": _allocation,
    "task_arrived": lambda agent, it: f"{agent} took {it['task']} from {it['source_agent']} with its state",
    "agent_lost": lambda agent, it: f"{agent} is killed",
    "agent_returned": lambda agent, it: f"{agent} is started again, on its disk",
    "task_handed_over": lambda agent, it: f"{agent} handed {it['task']} over to {it['to']}",
    "taken_over": lambda agent, it: f"{it['by']} took {it['task']} over from {it['source_agent']}, which is silent",
    "permit_lost": lambda agent, it: f"{it['task']} is paused on {agent}: its guardians do not answer",
    "rate_changed": lambda agent, it: f"{agent} runs {it['task']} at {it['rate_hz']:g} Hz, asked by {it['by']}",
    "halted": lambda agent, it: f"{agent} is halted by {agent_of(it['by'])}" + (it["reason"] and f": {it['reason']}"),
    "halt_ended": lambda agent, it: f"{agent_of(it['by'])} ended the halt of {agent}",
    "command_filtered": _filtered,
    "dock_chosen": lambda agent, it: f"{agent} takes {it['dock']}: its reserve is {it['bids'][agent]:.0f} s",
    "docked": lambda agent, it: f"{agent} is at {it['dock']}, with {it['level']:.0%} of its battery",
    "dock_lost": lambda agent, it: f"{agent} asks for another dock: {it['reason']}",
    "charged": lambda agent, it: f"{agent} is charged, to {it['level']:.0%}",
    "drive_begun": _drive_begun,
    "drive_ended": _drive_ended,
    "collision": lambda agent, it: f"collision: {' and '.join(it['names'])}",
}


def _short(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_short(it)}" for name, it in value.items())
    if isinstance(value, list | tuple):
        return f"({', '.join(_short(it) for it in value)})"
    if isinstance(value, float):
        # To a person a tiny number is 0.
        return f"{round(value, 6) + 0.0:.3g}" if abs(value) >= 0.001 else "0"
    return str(value)


class EventInfo(msgspec.Struct, frozen=True, kw_only=True):
    """An event on `log`, or a line for people, whose kind is `line`. Its `str` is a sentence.

    Attributes:
        agent: the agent that said it.
        source: the address of the component that said it.
        stamp_s: when, in mission seconds of that agent.
        kind: what happened, such as `task_started`.
        fields: its values, plain; of a line `level` and `text`.
    """

    agent: str
    source: str
    stamp_s: float
    kind: str
    fields: Mapping[str, Any] = {}

    @classmethod
    def of(cls, received: ReceivedPacket[Any]) -> EventInfo:
        """Return the row of a packet on `log`."""
        packet = received.packet
        if isinstance(packet.body, Event):
            kind, fields = packet.body.kind, packet.body.fields
        else:
            kind, fields = packet.type, body_to_plain(packet.body)
        return cls(
            agent=agent_of(packet.source), source=packet.source, stamp_s=packet.stamp_s, kind=kind, fields=fields
        )

    def __str__(self) -> str:
        about = {"t_s": self.stamp_s, "agent": self.agent, "source": self.source, "kind": self.kind}
        return sentence_of({**self.fields, **about})
