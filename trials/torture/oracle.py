"""Check the promises about migrating tasks from outside of all agents, after each turn of each actor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from pancakes.durable.record import Record
from pancakes.durable.snapshot import Snapshot
from pancakes.errors import MailboxFullError
from pancakes.kernel.actor import core_of
from pancakes.packet import SYSTEM, Packet, packet_type, task_address
from pancakes.task import Task, every, on

PARTNERS = {"One": "b/Two", "Two": "a/Three", "Three": "c/Four", "Four": "a/One"}
"""The task that each task writes to."""


class Violation(AssertionError):
    """Something happened that must never happen."""


@packet_type("test.note")
@dataclass(frozen=True)
class Note:
    """A letter of a copy of a task to another task.

    Attributes:
        copy: the copy that writes: its address, and its number among all that were started.
        n: the number of this note, from 1.
    """

    copy: str
    n: int


class Oracle:
    """Counts the running copies of each task, and remembers what is on disk.

    A copy that was stopped, that stands still for a hand-over or whose agent was killed does not run.

    Args:
        now: the virtual time.
        talk: whether the tasks write to each other.
        each: the tasks that acknowledge only what is on disk.

    Attributes:
        notes: how many letters have had their effect.
        starts: how many copies were ever started.
        moves: how many of these were the first with a new epoch, on another agent than the birthplace.
        durable: the highest count of each task that was ever on a disk, by the task's name.
    """

    def __init__(self, now: Callable[[], float], talk: bool = False, each: Sequence[str] = ()) -> None:
        self._now = now
        self._each = each
        self._wrong = ""  # raised at the next check, because an error in a task would end only the task
        self.talk = talk
        self.notes = 0
        self._copies: dict[str, list[Task]] = {}
        self._epochs: dict[str, tuple[int, str]] = {}
        self.starts = 0
        self.moves = 0
        self.durable: dict[str, int] = {}

    def started(self, task: Task) -> None:
        """Check the start of a copy, in its first turn: neither its epoch nor its state is older than any before."""
        name = task.name
        self.starts += 1
        self._copies.setdefault(name, []).append(task)
        fence = core_of(task).fence
        assert fence is not None
        epoch = (fence.epoch[0], fence.epoch[1])
        if epoch < (highest := self._epochs.get(name, epoch)):
            self._wrong = f"{task.address} starts under {epoch} although {highest} has run"
        self.moves += epoch > highest
        self._epochs[name] = max(epoch, highest)
        if task.state.n < (known := self.durable.get(name, 0)):
            self._wrong = f"{task.address} starts with {task.state.n} although {known} was written down"

    def ticked(self, task: Task) -> None:
        """Check that a copy that works may do so."""
        if task not in self.running(task.name):
            raise Violation(f"{task.address} works although it does not run, at {self._now():.4f} s")

    def heard(self, task: Task, note: Note, last: int) -> None:
        """Check a letter to a task that has `last` of its copy: once and in order; all letters, if promised."""
        self.notes += 1
        lost = note.n > last + 1 and task.name in self._each
        if note.n <= last or lost:
            what = "lacks some" if lost else "gets it twice, or too late"
            self._wrong = f"{task.address} gets note {note.n} of {note.copy} after {last}: it {what}"

    def written(self, record: Record) -> None:
        """Note that a record is on a disk."""
        if record.snapshot:
            n = Snapshot.decode(record.snapshot).state.get("n", 0)  # none before its first checkpoint
            name = record.task_id.name
            self.durable[name] = max(n, self.durable.get(name, 0))

    def running(self, name: str) -> list[Task]:
        """Return the running copies of a task."""
        alive = [copy for copy in self._copies.get(name, ()) if not copy.actor_stopped.is_set()]
        self._copies[name] = alive
        # A napping copy counts, too: its own timer may wake it.
        return [copy for copy in alive if copy.actor_inbox.component is core_of(copy) and not core_of(copy).is_frozen]

    def check(self) -> None:
        """Raise if any task runs twice, or an earlier check has failed."""
        if self._wrong:
            raise Violation(f"{self._wrong}, at {self._now():.4f} s")
        for name, copies in self._copies.items():
            if len(copies) > 1 and len(running := self.running(name)) > 1:
                where = " and on ".join(copy.agent for copy in running)
                raise Violation(f"{name} runs on {where}, at {self._now():.4f} s")


class Roamer(Task):
    """Counts its ticks, naps after some, writes letters to another task, and reports its work to an oracle.

    Attributes:
        oracle: the one of the fleet that runs just now: there is one at a time. A class made for each would stay for
            good, and its fleet with it, because the kernel remembers what it has read of a class.
    """

    oracle: ClassVar[Oracle | None] = None

    @dataclass
    class Settings:
        colour: str = "red"

    @dataclass
    class State:
        n: int = 0
        notes: dict[str, int] = field(default_factory=dict)  # the last of each copy

    def on_start(self) -> None:
        assert self.oracle is not None
        self.oracle.started(self)
        self.copy = f"{self.address} #{self.oracle.starts}"
        self.written = 0

    @on(SYSTEM, Note, addressed=True)
    def read(self, packet: Packet) -> None:
        assert self.oracle is not None
        note: Note = packet.body
        self.oracle.heard(self, note, self.state.notes.get(note.copy, 0))
        self.state.notes[note.copy] = note.n

    @every(hz=10)
    def tick(self, tick: Any) -> None:
        assert self.oracle is not None
        self.oracle.ticked(self)
        self.state.n += 1
        if self.state.n % 10 == 0:
            self.pause()
            self.after(0.25, self.wake)
        if not self.oracle.talk:
            return
        try:
            self.publish(SYSTEM, Note(self.copy, self.written + 1), to=task_address(PARTNERS[self.name]))
        except MailboxFullError:
            return  # its partner has been away for long
        self.written += 1

    def wake(self) -> None:
        assert self.oracle is not None
        self.oracle.ticked(self)  # it acts, as in a tick
        self.resume()


class Drives(Roamer):
    """The same, and needs the wheels for itself."""

    requires = ("motors",)
