"""Trace a fault schedule in words. Tracing changes nothing, so that a traced schedule is the same."""

from __future__ import annotations

from collections.abc import Callable

from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Standing, Wanted
from pancakes.events import Event, LogLine
from pancakes.packet import Packet, agent_of

UNTOLD = ("migration",)
"""Fields of events that would fill pages, such as the whole ledger in the event `migration`."""


class Story:
    """Prints a line for each event.

    Args:
        tell: called with each line; None: nothing is traced.
        now: the virtual time, in seconds.
    """

    def __init__(self, tell: Callable[[str], None] | None, now: Callable[[], float]) -> None:
        self._tell = tell
        self._now = now
        self._known: dict[tuple[str, TaskId], tuple[object, ...]] = {}

    @property
    def told(self) -> bool:
        """Whether the schedule is traced."""
        return self._tell is not None

    def say(self, text: str) -> None:
        """Print a sentence."""
        if self._tell is not None:
            self._tell(f"{self._now():9.4f} {text}")

    def wrote(self, agent: str, record: Record) -> None:
        """Print that a record is on an agent's disk; checkpoints are skipped."""
        if self._tell is None:
            return
        news = (record.standing, record.epoch, record.register.heir, record.register.promised, record.wanted)
        if self._known.get((agent, record.task_id)) != news:
            self._known[agent, record.task_id] = news
            self.say(f"on the disk of {agent}: {_standing(record)}")

    def heard(self, name: str, packet: Packet, how: str = "") -> None:
        """Print that a packet of a migration has reached an agent."""
        if self._tell is None:
            return
        body = packet.body
        what = packet.type.partition(".")[2].upper()
        epoch = f" {body.epoch}" if hasattr(body, "epoch") else ""
        tasks = getattr(body, "task_id", None) or ", ".join(map(str, getattr(body, "task_ids", ())))
        self.say(f"{name} hears{how} from {agent_of(packet.source)}: {what}{epoch} for {tasks}")

    def logged(self, packet: Packet) -> None:
        """Print what an agent has published on `log`."""
        body = packet.body
        if isinstance(body, LogLine):
            if body.level != "debug":
                self.say(f"{packet.source} says ({body.level}): {body.text}")
        elif isinstance(body, Event):
            self.say(f"{packet.source}: {_words_of(body)}")


def _standing(record: Record) -> str:
    task = str(record.task_id)
    match record.standing:
        case Standing.OWNER:
            wanted = "to run" if record.wanted is Wanted.RUNNING else f"to be {record.wanted.value}"
            return f"{task} is its own under {record.epoch}, {wanted}"
        case Standing.OFFERED:
            return f"{task} is paused, and is offered to {record.peer}"
        case Standing.YIELDED:
            return f"{task} is promised to {record.peer} as {record.seen}, for good"
        case Standing.HEIR:
            return f"{task} of {record.peer} rests there, and is asked for"
        case Standing.RELEASED:
            return f"{task} has moved to {record.peer}, which has said so"
        case Standing.DISPUTED:
            return f"{task} is paused, as another agent owns it too"
        case Standing.MEMBER:
            return f"{task} of {record.peer} is guarded there"
        case Standing.NONE:
            return f"{task} was never there"


def _words_of(event: Event) -> str:
    fields = dict(event.fields)
    if event.kind in UNTOLD:
        lines = "; ".join(f"{line['peer']} {line['fate']} {line['reason']}".strip() for line in fields["lines"])
        who = f" to {fields['winner']}" if fields["winner"] else ""
        return f"the move of {fields['task']} has ended: {fields['outcome']}{who} ({lines or 'nobody was asked'})"
    words = event.kind.replace("_", " ")
    told = ", ".join(f"{key} {value}" for key, value in fields.items() if value not in (None, ""))
    return f"{words}: {told}" if told else words
