"""What the parts of a hosting service share: the place of each task.

A `Place` is everything that a service knows of one task: its slot, its record, its letters and its pending requests.
Everything here belongs to one actor and needs no lock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import msgspec

from pancakes.durable.bidding_messages import HasMoved
from pancakes.durable.delivery import STREAMS, Letter, PacketId
from pancakes.durable.messages import Solicit
from pancakes.durable.reconcile import Course, Outcome, Write
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Epoch, Identity
from pancakes.durable.snapshot import why_unwritable
from pancakes.errors import MigrationError
from pancakes.kernel.dead_letters import MOST_KNOWN
from pancakes.kernel.mailbox import Reference
from pancakes.kernel.registry import SettingsNote
from pancakes.kernel.timer import TaskTimer
from pancakes.migration import MigrationReport
from pancakes.packet import Packet
from pancakes.supervision.lifecycle import Request
from pancakes.supervision.messages import Carried
from pancakes.supervision.slots import Slot
from pancakes.task import TaskSpec
from pancakes.util import codecs
from pancakes.util.arrays import saved_array


class LastCheckpoint(msgspec.Struct, frozen=True):
    """What was written down of a task last.

    Attributes:
        plain: what it carried, encoded; see `plain_of`.
        carried: of a task without state what it carried; None: it has state.
    """

    plain: bytes
    carried: Carried | None

    def surely_holds(self, note: SettingsNote | None, timers: Sequence[TaskTimer]) -> bool:
        """Returns whether what a task carries has surely not changed, without a turn of its: most have no state at all.

        Args:
            note: its settings, as it has entered them.
            timers: its timers.
        """
        carried = self.carried
        return (
            carried is not None
            and note is not None
            and note.plain is carried.settings
            and all(timer.period_s == carried.periods_s.get(timer.method) for timer in timers)
        )


def plain_of(carried: Carried) -> bytes:
    """Returns what a task carries as bytes, which are the same as long as nothing has changed.

    Raises:
        MigrationError: its settings or its state cannot be encoded.
    """
    try:
        return _ENCODE([carried.settings, carried.state, carried.periods_s, carried.heard, carried.requests])
    except codecs.UNENCODABLE as error:
        raise MigrationError(why_unwritable(carried.settings, carried.state, error)) from None


_ENCODE: Final = codecs.encoder(saved_array)


KEPT: Final = 1024
"""Most letters of one task that are acknowledged before they are on disk, ..."""
KEPT_BYTES: Final = 4 * 1024 * 1024
"""... and most bytes of them; with more, the task is written down at once, and only then are they acknowledged."""


MOST_GIVEN: Final = 1024
"""At most this many letters of one agent wait for a task to look at them, ..."""
MOST_GIVEN_BYTES: Final = 16 * 1024 * 1024
"""... and this many bytes of them; of more, the agent keeps them and sends them again. One may always be given."""


class TaskLetters(msgspec.Struct):
    """The letters that have come for one task.

    Attributes:
        owed: handled, and not known to be on disk: up to which number, and which agent waits to hear of it, by stream.
        kept: acknowledged before they are on disk, by stream and number, and the packets in them.
        kept_bytes: how many bytes they have.
        asked: whether the task is being written down because there is no more room for them.
        failures: how often the task has failed on a letter, by stream and number.
        given_to: the task's actor that was given the following.
        given: what it has still to look at: which letter, and what its sender said then of those before it.
        given_of: how many of these are of each agent, and how many bytes they have.
    """

    owed: dict[str, tuple[int, str]] = {}
    kept: dict[tuple[str, int], tuple[Letter, Packet | None]] = {}
    kept_bytes: int = 0
    asked: bool = False
    failures: dict[tuple[str, int], int] = {}
    given_to: Reference | None = None
    given: dict[tuple[str, int, int], Packet | None] = {}
    given_of: dict[str, tuple[int, int]] = {}

    def give(self, task: Reference, letter: Letter, packet: Packet | None) -> bool:
        """Learns that an actor is given a letter; returns False if it has still to look at that, or at too many."""
        if self.given_to is not task:
            self.given_to, self.given, self.given_of = task, {}, {}
        place = (letter.stream, letter.seq, letter.first)
        if place in self.given:
            return False
        count, size = self.given_of.get(letter.sender, (0, 0))
        size += len(letter.packet)
        if count >= MOST_GIVEN or (count and size > MOST_GIVEN_BYTES):
            return False
        self.given[place], self.given_of[letter.sender] = packet, (count + 1, size)
        return True

    def looked_at(self, task: Reference, letter: Letter) -> Packet | None:
        """Learns that an actor has looked at a letter; returns the packet in it."""
        place = (letter.stream, letter.seq, letter.first)
        if self.given_to is not task or place not in self.given:
            return None
        count, size = self.given_of.pop(letter.sender)
        if count > 1:
            self.given_of[letter.sender] = (count - 1, size - len(letter.packet))
        return self.given.pop(place)

    def note_failures(self, letter: Letter, failures: int) -> None:
        """Learns how often the task has failed on a letter."""
        key = (letter.stream, letter.seq)
        self.failures.pop(key, None)
        self.failures[key] = failures
        if len(self.failures) > MOST_KNOWN:  # a letter whose sender has gone never comes again, and nothing says so
            del self.failures[next(iter(self.failures))]

    def took(self, letter: Letter) -> None:
        """Learns that the task has handled a letter, now or before: what it remembers need not be on disk yet."""
        self.failures.pop((letter.stream, letter.seq), None)
        seq, _ = self.owed.get(letter.stream, (0, ""))
        self.owed[letter.stream] = (max(letter.seq, seq), letter.sender)
        if len(self.owed) > STREAMS:  # its filter has forgotten that stream
            del self.owed[next(iter(self.owed))]

    def keep(self, letter: Letter, packet: Packet | None) -> bool:
        """Keeps a letter that is acknowledged before it is on disk; returns False if there is no room for it."""
        key = (letter.stream, letter.seq)
        if key not in self.kept:
            if len(self.kept) >= KEPT or self.kept_bytes >= KEPT_BYTES:
                return False
            self.kept[key] = (letter, packet)
            self.kept_bytes += len(letter.packet)
        return True

    def consumed(self, heard: Mapping[str, int]) -> tuple[PacketId, ...]:
        """Returns what is on disk once a task is that has `heard` so much."""
        return tuple(PacketId(stream, seq) for stream, (seq, _) in self.owed.items() if seq <= heard.get(stream, 0))

    def on_disk(self, packet: PacketId) -> str:
        """Learns that a letter, and all before it in its stream, have had their effect for good.

        Returns:
            The agent that waits to hear of it; empty: none, for it was told, or the task was given away meanwhile.
        """
        for key in [key for key in self.kept if key[0] == packet.stream and key[1] <= packet.seq]:
            self.kept_bytes -= len(self.kept.pop(key)[0].packet)
            self.asked = False
        seq, sender = self.owed.get(packet.stream, (0, ""))
        if sender and seq <= packet.seq:
            del self.owed[packet.stream]
        return sender


class Move(msgspec.Struct):
    """A move that is under way.

    Attributes:
        request: what the neighbours are asked.
        then: a task to start here once the other has gone.
        answer: the request to answer; None: a rule asked.
        dry_run: whether nothing is moved.
        ledger: the account as it stands while a migration is under way; None before the first, and between two.
    """

    request: Solicit
    then: str
    answer: Request | None
    dry_run: bool
    ledger: MigrationReport | None = None

    def take_ledger(self) -> MigrationReport | None:
        """Returns the account as it stood: the migration has come to nothing."""
        ledger, self.ledger = self.ledger, None
        return ledger


class Recovery(msgspec.Struct, frozen=True):
    """A person has decided about a task; the answer waits until that is done.

    Attributes:
        request: the request to answer.
        peer: the agent that is gone; empty: the record was lost.
        reason: what was decided, as a sentence.
        ledger: the account of the migration that was in doubt.
    """

    request: Request
    peer: str
    reason: str
    ledger: MigrationReport | None


class Creation(msgspec.Struct, frozen=True):
    """Create a task here.

    Attributes:
        request: the request to answer.
        spec: how it is started.
        snapshot: how it begins, encoded.
        dry_run: whether it is not to begin.
        silent: the agents that have not said whether they know it.
    """

    request: Request
    spec: TaskSpec
    snapshot: bytes
    dry_run: bool
    silent: tuple[str, ...] = ()


class OtherOwner(msgspec.Struct, frozen=True):
    """Another agent that owns the task too, as it says.

    Attributes:
        peer: that agent.
        epoch: under which epoch.
        journal: of its disk, as it says this; empty: unknown.
    """

    peer: str
    epoch: Epoch
    journal: str = ""


class BeganFrom(msgspec.Struct, frozen=True):
    """From what state a task began on the agent that owns it.

    Attributes:
        epoch_n: the number of the epoch under which it began.
        heard: the duplicate filter in the snapshot that it began from.
        life: as `began_life` of `pancakes.durable.delivery.Receipt`; 0 if it has just come under that epoch.
    """

    epoch_n: int
    heard: Mapping[str, int]
    life: int = 0

    def upto(self, stream: str) -> int:
        """Returns up to which letter of a stream it had the effects; -1: that is not known."""
        # Of more streams than it remembers it has forgotten some.
        return self.heard.get(stream, 0 if len(self.heard) < STREAMS else -1)


class Unsure(msgspec.Struct, frozen=True):
    """Why a task does not run here now: its agent does not know what it must know.

    Attributes:
        word: that in a word; see `pancakes.durable.record`.
        why: as a sentence.
        for_good: whether only a person, or the task's coming here, changes that.
    """

    word: str = ""
    why: str = ""
    for_good: bool = False


SURE: Final = Unsure()
"""Its agent knows what it must know."""


class Pending(msgspec.Struct):
    """A write that the registrar was told of.

    Attributes:
        place: the place of its task.
        write: what it is for, if the machine of the task asked for it; None: something else did.
        then: hears what became of it; None: the machine does.
        written: whether it is on disk, or never will be.
    """

    place: Place
    write: Write | None = None
    then: Callable[[Outcome, str], None] | None = None
    written: bool = False


class Place(msgspec.Struct):
    """The place of one task, whether it runs here or has left only its record.

    Its life is in its slot, as that of every task; a task without one has no life here.

    Attributes:
        task_id: the task.
        course: its record, and what is about to be done.
        slot: its slot; None: it has none.
        letters: what is known of the letters that have come for it; None: none has.
        written: what was written down of it last; None: nothing since it began.
        began: what it began from here, as far as letters are concerned; None: it is not owned here.
        looked_s: when the task was known last to be as `written` says, in host time.
        came_from: the agent that it is on its way from; empty: none.
        move: the migration that was asked for; None: none.
        ask_again_s: its rule leaves it alone until this host time.
        account: the account of its migration, which the Task Migrator has not kept yet; None: there is none.
        recovery: the decision of a person that waits until it is done; None: none.
        creation: the creation that waits for its start; None: none.
        removal: the request to remove it that waits for its end, or for the disk; None: none.
        then: the task that starts here in its place once it is stopped; empty: none.
        follows: the task that it is started after; None: none.
        to_follow: how much of what follows its migration, or its stop, is still to be done.
        other: the agent that said of all others that it owns it under the highest epoch; None: none has said so.
        unsure: why it does not run, if this agent does not know what it must know.
        unwritable: whether what it carries could not be written down when it was last looked at.
        unsafe: the actuators that people were told of as keeping their last command.
        held: whether its actuators are held, as it may not act.
    """

    task_id: TaskId
    course: Course
    slot: Slot | None = None
    letters: TaskLetters | None = None
    written: LastCheckpoint | None = None
    began: BeganFrom | None = None
    looked_s: float = 0.0
    came_from: str = ""
    move: Move | None = None
    ask_again_s: float = 0.0
    account: HasMoved | None = None
    recovery: Recovery | None = None
    creation: Creation | None = None
    removal: Request | None = None
    then: str = ""
    follows: TaskId | None = None
    to_follow: int = 0
    other: OtherOwner | None = None
    unsure: Unsure = SURE
    unwritable: bool = False
    unsafe: frozenset[str] = frozenset()
    held: bool = False

    @property
    def record(self) -> Record:
        """What is on disk."""
        return self.course.record

    @property
    def owes(self) -> bool:
        """Whether something that the task has handled waits for the disk."""
        return self.letters is not None and bool(self.letters.owed)


class Places(dict[TaskId, Place]):
    """All places, by task, and which of them each slot belongs to. In the service's actor.

    To look up a task that the service has never heard of makes a place for it.

    Args:
        me: the agent as an owner of tasks.
        slots: the service's slots, by the names of tasks.

    Attributes:
        at: the place that each slot belongs to, by the name of the task.
    """

    def __init__(self, me: Identity, slots: Mapping[str, Slot]) -> None:
        super().__init__()
        self.at: dict[str, Place] = {}
        self._me = me
        self._slots = slots
        self._by_name: dict[str, list[Place]] = {}

    def __missing__(self, task_id: TaskId) -> Place:
        return self.open(Record(task_id, me=self._me))

    def unkept(self, task_id: TaskId) -> Place:
        """Return a place for a task of which nothing is known, without keeping it."""
        return Place(task_id, Course(Record(task_id, me=self._me)))

    def open(self, record: Record) -> Place:
        """Makes a place for a task of which there is a record."""
        place = Place(record.task_id, Course(record))
        self.keep(place)
        return place

    def keep(self, place: Place) -> None:
        """Takes a place in, unless it is there."""
        if place.task_id not in self:
            self[place.task_id] = place
            self._by_name.setdefault(place.task_id.name, []).append(place)

    def drop(self, place: Place) -> None:
        """Forget a place without a record, if nothing has come of what was asked."""
        if self.pop(place.task_id, None) is not None:
            self._by_name[place.task_id.name].remove(place)

    def named(self, name: str) -> list[Place]:
        """Returns the places of all tasks of a name: each birthplace may have one."""
        return list(self._by_name.get(name, ()))

    def bind(self, name: str) -> None:
        """Find out again which place the slot of a name belongs to: a record has changed, or the slot has."""
        for place in self._by_name.get(name, ()):
            place.slot = None
        slot = self._slots.get(name)
        if slot is None:
            self.at.pop(name, None)
            return
        named = self._by_name.get(name, ())
        # Without one that is here, the slot was opened for what a former self owned, whose disk was replaced by a copy.
        here = [it for it in named if it.course.leaving or it.record.here or it.removal is not None]
        here = here or [it for it in named if it.record.was_ours]
        place = here[0] if here else self[TaskId(self._me.agent, name)]
        place.slot = slot
        self.at[name] = place
