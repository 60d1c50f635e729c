"""What the parts of a hosting service share: the place of each task, the service itself, and talk to peers.

A `Place` is everything that a service knows of one task: its slot, its record, its letters, its lease and its pending
requests. `HostingService` is what the parts may use of the service. `PeerTalk` sends messages to other agents, each
meant for one disk. Everything here belongs to one actor and needs no lock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol

import msgspec

from pancakes.control import Refusal
from pancakes.durable.bidding_messages import HasMoved
from pancakes.durable.courier import SharedOutbox
from pancakes.durable.delivery import STREAMS, Letter
from pancakes.durable.guarding import Owed, Seizing, Tenure
from pancakes.durable.handoff_events import PacketId
from pancakes.durable.host_state import HostState
from pancakes.durable.messages import (
    AskLease,
    CanGuard,
    GuardAnswer,
    HandOffMessage,
    KeepLease,
    LeaseSeen,
    MayGuard,
    Message,
    SeizeTask,
    Solicit,
    TakeTask,
    Transfer,
    YieldLease,
    addressed,
)
from pancakes.durable.record import Epoch, GuardianId, Record, TaskId
from pancakes.durable.snapshot import Posted, Snapshot, cut, why_unwritable
from pancakes.durable.state_machine import AnyEvent, Standing
from pancakes.errors import MigrationError, PancakesError
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.dead_letters import MOST_KNOWN
from pancakes.kernel.handlers import Queue
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Reference
from pancakes.kernel.permits import PermitEnd
from pancakes.kernel.registry import SettingsNote
from pancakes.kernel.timer import OneShot, TaskTimer
from pancakes.mesh.mesh import Mesh
from pancakes.migration import GuardRule, MigrationReport
from pancakes.packet import NETWORK, Packet, join
from pancakes.supervision.lifecycle import Request
from pancakes.supervision.messages import GUARDIAN, Carried
from pancakes.supervision.slots import Slot
from pancakes.task import Nothing, Task, TaskSpec
from pancakes.util import codecs
from pancakes.util.arrays import saved_array

MOST: Final = 256
"""Of so many peers it is remembered."""


class LastSaid:
    """Remembers what was said last of each peer. One actor."""

    def __init__(self) -> None:
        self._last: dict[str, int] = {}

    def is_news(self, peer: str, text: str) -> bool:
        """Returns whether something else was said of a peer last, or nothing."""
        said = hash(text)  # the peer may have had a part in how long it is
        is_news = self._last.pop(peer, None) != said
        self._last[peer] = said
        if len(self._last) > MOST:
            del self._last[next(iter(self._last))]
        return is_news


AfterHost = Callable[[float, Callable[[], None]], OneShot]


class Deadline:
    """Calls a function once its time has come, in the actor that it belongs to.

    Args:
        deadlines: those of that actor.
        function: what is called.

    Attributes:
        due_s: when, in host time; infinite: it is not set.
        function: see above.
    """

    __slots__ = ("_deadlines", "due_s", "function")

    def __init__(self, deadlines: Deadlines, function: Callable[[], None]) -> None:
        self._deadlines = deadlines
        self.function = function
        self.due_s = math.inf

    def set(self, delay_s: float) -> None:
        """Sets it to so many seconds of host time from now, instead of any other time."""
        self._deadlines.set(self, delay_s)

    def cancel(self) -> None:
        """Makes sure that it does not come."""
        self._deadlines.cancel(self)


class Deadlines:
    """The deadlines of one actor, which share one timer.

    Putting one off costs nothing: the timer stays as it was, and looks again when it fires. So leases that are renewed
    all the time take one timer for each lease that passes, and not one for each task and renewal.

    Args:
        after_host: calls a function in the actor in so many seconds of host time.
        now: the host clock, in seconds.
    """

    def __init__(self, after_host: AfterHost, now: Callable[[], float]) -> None:
        self._after_host = after_host
        self._now = now
        self._set: dict[Deadline, None] = {}
        self._timer: OneShot | None = None
        self._fires_s = math.inf

    def new(self, function: Callable[[], None]) -> Deadline:
        """Returns another one, which is not set."""
        return Deadline(self, function)

    def set(self, deadline: Deadline, delay_s: float) -> None:
        """See `Deadline`."""
        deadline.due_s = self._now() + delay_s
        self._set[deadline] = None
        if deadline.due_s < self._fires_s:
            self._start(deadline.due_s, delay_s)

    def cancel(self, deadline: Deadline) -> None:
        """See `Deadline`."""
        deadline.due_s = math.inf
        self._set.pop(deadline, None)
        if not self._set:
            self._stop()

    def _start(self, due_s: float, delay_s: float) -> None:
        self._stop()
        self._fires_s = due_s
        self._timer = self._after_host(delay_s, self._fired)

    def _stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer, self._fires_s = None, math.inf

    def _fired(self) -> None:
        if self._timer is None:
            return  # called off after the timer had put this call into the actor's mailbox
        self._stop()
        now_s = self._now()
        due = [it for it in self._set if it.due_s <= now_s]
        for it in due:
            del self._set[it]
        if self._set:
            due_s = min(it.due_s for it in self._set)
            self._start(due_s, due_s - now_s)
        for it in due:
            if it.due_s <= now_s and it not in self._set:  # one that came before it may have changed it
                it.due_s = math.inf
                it.function()


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


def last_checkpoint(cls: type[Task], carried: Carried, plain: bytes) -> LastCheckpoint:
    """Returns what is remembered of a checkpoint.

    Args:
        cls: the task's class.
        carried: what it carries.
        plain: the same, encoded.
    """
    return LastCheckpoint(plain, carried if cls.State is Nothing else None)


def plain_of(carried: Carried) -> bytes:
    """Returns what a task carries as bytes, which are the same as long as nothing has changed.

    Raises:
        MigrationError: its settings or its state cannot be encoded.
    """
    try:
        return _ENCODE([carried.settings, carried.state, carried.periods_s, carried.heard])
    except codecs.UNENCODABLE as error:
        raise MigrationError(why_unwritable(carried.settings, carried.state, error)) from None


_ENCODE: Final = codecs.encoder(saved_array)


KEPT: Final = 1024
"""Most letters of one task that are acknowledged before they are on disk, ..."""
KEPT_BYTES: Final = 4 * 1024 * 1024
"""... and most bytes of them; with more, the task is written down at once, and only then are they acknowledged."""


MOST_GIVEN: Final = 1024
"""So many letters of one agent a task has still to look at, ..."""
MOST_GIVEN_BYTES: Final = 16 * 1024 * 1024
"""... and so many bytes of them; of more, the agent keeps them and sends them again. One may always be given."""


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
        """Learns that an actor is given a letter; returns False where it has that still to look at, or too many."""
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
        """Keeps a letter that is acknowledged before it is on disk; returns False where there is no room for it."""
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


RULELESS_S: Final = 1.0
"""How often a task is written down that is to be guarded no longer."""


class Tenancy(msgspec.Struct):
    """A crash forgets all of it.

    Attributes:
        renewal: asks for leases again.
        end: the end of the permit.
        tenure: what its guardians have said.
        lost_s: since when, in host time, it may not act.
        type: entry point name of the task's class.
        rule: how the task is guarded; None: it is to be guarded no longer.
        until: until when each asking would let the task act, by beat; without those that a quorum has granted.
        told: the epoch, the checkpoint and the guards that guardians were told of last.
        bodies: which checkpoint each guardian was sent last, and with which beat.
        heard_s: when each guardian has said something last, in host time.
        as_of_s: when the task was known last to be as each of the newest checkpoints says, in host time, by number.
        owed: packets that are acknowledged once the checkpoint with their effect is at a quorum.
        stops: of each stop that is not answered yet, the checkpoint that says so, and what answers it, given a fault.
        answers: what neighbours have said that were asked whether they would guard it.
        asked_s: when they were asked last, in host time.
        unsafe: the actuators that people were told of as keeping their last command.
        thin: whether people were told that it has fewer guardians than it should.
    """

    renewal: Deadline
    end: Deadline
    tenure: Tenure
    lost_s: float
    type: str = ""
    rule: GuardRule | None = None
    until: dict[int, PermitEnd] = {}
    told: tuple[Epoch, int, int] | None = None
    bodies: dict[GuardianId, tuple[int, int]] = {}
    heard_s: dict[GuardianId, float] = {}
    as_of_s: dict[int, float] = {}
    owed: list[Owed] = []
    stops: list[tuple[int, Callable[[str], None]]] = []
    answers: dict[str, CanGuard] = {}
    asked_s: float = -1e9
    unsafe: frozenset[str] = frozenset()
    thin: bool = False

    @property
    def lease_s(self) -> float:
        """How long its leases are, in host seconds."""
        return self.rule.lease_s if self.rule is not None else GuardRule(3).lease_s

    @property
    def checkpoint_s(self) -> float:
        """How often the task is written down where it has changed, in host seconds."""
        return self.rule.checkpoint_s if self.rule is not None else RULELESS_S

    @property
    def number(self) -> int:
        """How many guardians it is to have."""
        return self.rule.guard if self.rule is not None else 1

    def cancel(self) -> None:
        """Ends its timers."""
        self.renewal.cancel()
        self.end.cancel()


class Taking(msgspec.Struct):
    """A task that this agent is to take.

    Attributes:
        seizing: what its guardians have said.
        until_s: when it is given up, in host time; None: never, as it was given away to this agent.
        again: asks once more.
    """

    seizing: Seizing
    until_s: float | None
    again: OneShot | None = None


class Move(msgspec.Struct):
    """A move that is under way.

    Attributes:
        request: what the neighbours are asked.
        then: a task to start here once the other has gone.
        answer: the request to answer; None where a rule asked.
        dry_run: whether nothing is to be moved.
        ledger: the account as it stands while a hand-off is under way; None before the first, and between two.
    """

    request: Solicit
    then: str
    answer: Request | None
    dry_run: bool
    ledger: MigrationReport | None = None

    def take_ledger(self) -> MigrationReport | None:
        """Returns the account as it stood: the hand-off has come to nothing."""
        ledger, self.ledger = self.ledger, None
        return ledger


class Adoption(msgspec.Struct, frozen=True):
    """A person has said that the task shall run here; the answer waits until that is decided.

    Attributes:
        request: the request to answer.
        peer: the agent that is gone; empty: the record was lost.
        reason: what was decided, as a sentence.
        ledger: the account of the hand-off that was in doubt.
        as_it_stands: whether it is here already, and goes on as it stands.
    """

    request: Request
    peer: str
    reason: str
    ledger: MigrationReport | None
    as_it_stands: bool = False


class Creation(msgspec.Struct, frozen=True):
    """A task is to be created here.

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
    """

    peer: str
    epoch: Epoch


class BeganFrom(msgspec.Struct, frozen=True):
    """What a task began from where it is owned.

    Attributes:
        epoch_n: the number of the epoch under which it began.
        heard: the duplicate filter in the snapshot that it began from.
        life: as `began_life` of `pancakes.durable.delivery.Receipt`.
    """

    epoch_n: int
    heard: Mapping[str, int]
    life: int = 0

    def upto(self, stream: str) -> int:
        """Returns up to which letter of a stream it had the effects; -1: that is not known."""
        # Of more streams than it remembers it has forgotten some.
        return self.heard.get(stream, 0 if len(self.heard) < STREAMS else -1)


def began_from(epoch: Epoch, snapshot: Snapshot, life: int = 0) -> BeganFrom:
    """Returns what a task begins from that is owned under an epoch; `life`: 0 where it has just come under that."""
    return BeganFrom(epoch.n, snapshot.heard, life)


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


class Place(msgspec.Struct):
    """The place of one task, whether it runs here or has left only its record.

    Its life is in its slot, as that of every task; a task without one has no life here.

    Attributes:
        task_id: the task.
        slot: its slot; None: it has none.
        standing: its record, and what its hand-off is about to do.
        letters: what is known of the letters that have come for it; None: none has.
        written: what was written down of it last; None: nothing since it began.
        began: what it began from here, as far as letters are concerned; None: it is not owned here.
        looked_s: when the task was known last to be as `written` says, in host time.
        promised: the agent to which this one said RESERVED last, and its offer; None: to none since it began.
        came_from: the agent that it is on its way from; empty: none.
        move: the move that was asked for; None: none.
        ask_again_s: its rule leaves it alone until this host time.
        account: the account of its move, which the Task Migrator has not kept yet; None: there is none.
        adoption: the adoption that waits for its start; None: none.
        forgetting: the requests to forget it that wait for the disk.
        creation: the creation that waits for its start; None: none.
        removal: the request to remove it that waits for its end, or for the disk; None: none.
        follows: the task that it is started after; None: none.
        permit: of a guarded task: whether it may act, as far as its service has looked; its actor looks at the clock.
        tenancy: of a guarded task that is owned here: what its guardians have said; None: it is none.
        taking: what guardians have said of a task that this agent is to take; None: it is to take none.
        other: the agent that said of all others that it owns it under the highest epoch; None: none has said so.
        unsure: why it does not run, where this agent does not know what it must know.
        unwritable: whether what it carries could not be written down when it was last looked at.
        reminders: the timers that its hand-off waits for, by the event that each feeds.
    """

    task_id: TaskId
    standing: Standing
    slot: Slot | None = None
    letters: TaskLetters | None = None
    written: LastCheckpoint | None = None
    began: BeganFrom | None = None
    looked_s: float = 0.0
    promised: tuple[str, Epoch] | None = None
    came_from: str = ""
    move: Move | None = None
    ask_again_s: float = 0.0
    account: HasMoved | None = None
    adoption: Adoption | None = None
    forgetting: tuple[Request, ...] = ()
    creation: Creation | None = None
    removal: Request | None = None
    follows: TaskId | None = None
    permit: bool = False
    tenancy: Tenancy | None = None
    taking: Taking | None = None
    other: OtherOwner | None = None
    unsure: Unsure = SURE
    unwritable: bool = False
    reminders: dict[type, OneShot] = msgspec.field(default_factory=dict)

    @property
    def owes(self) -> bool:
        """Whether something that the task has handled waits for the disk."""
        return self.letters is not None and bool(self.letters.owed)


class Places(dict[TaskId, Place]):
    """All places, by task, and which of them each slot belongs to. In the service's actor.

    To look up a task that the service has never heard of makes a place for it.

    Args:
        agent: the agent's name.
        slots: the service's slots, by the names of tasks.

    Attributes:
        at: the place that each slot belongs to, by the name of the task.
    """

    def __init__(self, agent: str, slots: Mapping[str, Slot]) -> None:
        super().__init__()
        self.at: dict[str, Place] = {}
        self._agent = agent
        self._slots = slots
        self._by_name: dict[str, list[Place]] = {}

    def __missing__(self, task_id: TaskId) -> Place:
        return self.open(Record(task_id))

    def open(self, record: Record) -> Place:
        """Makes a place for a task of which there is a record."""
        place = Place(record.task_id, Standing(record))
        self.keep(place)
        return place

    def keep(self, place: Place) -> None:
        """Takes a place in, unless it is there."""
        if place.task_id not in self:
            self[place.task_id] = place
            self._by_name.setdefault(place.task_id.name, []).append(place)

    def drop(self, place: Place) -> None:
        """Forgets a place where nothing has come of what was asked, and of which there is no record."""
        if self.pop(place.task_id, None) is not None:
            self._by_name[place.task_id.name].remove(place)

    def named(self, name: str) -> list[Place]:
        """Returns the places of all tasks of a name: each birthplace may have one."""
        return list(self._by_name.get(name, ()))

    def bind(self, name: str) -> None:
        """Finds out anew which place the slot of a name belongs to: a record has changed, or the slot has."""
        for place in self._by_name.get(name, ()):
            place.slot = None
        slot = self._slots.get(name)
        if slot is None:
            self.at.pop(name, None)
            return
        here = [place for place in self._by_name.get(name, ()) if place.standing.leaving or place.standing.record.here]
        place = here[0] if here else self[TaskId(self._agent, name)]
        place.slot = slot
        self.at[name] = place


class HostingService(Reference, Protocol):
    """A service that hosts tasks. All in its actor."""

    kernel: Kernel
    slots: dict[str, Slot]
    places: Places
    residents: frozenset[str]
    outbox: SharedOutbox
    state: HostState
    closing: bool

    def subscribe(
        self, channel: str, body: type | str | None, handler: Callable[[Packet], None], queue: Queue = ...
    ) -> None: ...

    def feed_place(self, place: Place, event: AnyEvent | None) -> None:
        """Feeds an event to a task, and carries out what follows; None: nothing has happened to it."""

    def snapshot(self, slot: Slot, carried: Carried | None, posted: Posted | None = None) -> bytes:
        """Returns a task as data, encoded."""

    def snapshot_at_rest(self, slot: Slot) -> bytes:
        """Returns a task that does not run as data, encoded; empty: what its record has is what counts."""

    def look_after(self, place: Place, request: Request) -> None:
        """Sees to it that a request which waits for the journal is told so in time."""

    def drop_state(self, slot: Slot) -> None: ...

    def admit(self, slot: Slot) -> str: ...

    def first_guardian(self, place: Place, snapshot: bytes = b"") -> GuardianId | None:
        """Returns the first guardian of a task that begins here: this agent; None: the task is not guarded."""

    def connected(self, agent: str) -> bool:
        """Returns whether there is a link to an agent now."""

    def open_slot(self, spec: TaskSpec) -> Slot: ...

    def hold_actuators(self, slot: Slot, reason: str) -> None: ...

    def reply(self, request: Request, refusal: Refusal | None = None, result: Any = None) -> None: ...

    def put_off(self, request: Request, reason: str) -> None: ...

    def waits(self, request: Request) -> bool: ...

    def publish(self, channel: str, body: Any, to: str = "") -> Any: ...

    def log(self, level: str, text: str) -> None: ...

    def event(self, kind: str, /, **fields: Any) -> None: ...

    def call(self, function: Callable[[], None]) -> Any: ...

    def after_host(self, delay_s: float, function: Callable[[], None]) -> Any: ...


ToGuardian = KeepLease | SeizeTask | YieldLease | AskLease
ToPeer = Message | ToGuardian | MayGuard | GuardAnswer | LeaseSeen | CanGuard | TakeTask


class PeerTalk:
    """Sends messages to actors of other agents, or of this one; each may be lost. All in one actor.

    Args:
        speaker: that actor.
        mesh: knows this agent's journal, and the neighbours with theirs.

    Attributes:
        me: this agent as a guardian: its name, the id of its journal, and which copy of that it has.
        boot: which life of this agent this is.
    """

    def __init__(self, speaker: ActorCore | HostingService, mesh: Mesh) -> None:
        self.me = GuardianId(speaker.agent, mesh.identity.journal, mesh.identity.copy)
        self.boot = mesh.identity.boot
        self._speaker = speaker
        self._mesh = mesh

    def neighbours(self) -> list[str]:
        """Returns the agents that are linked and have a journal."""
        return [name for name, hello in self._mesh.connected().items() if hello.journal]

    def to_guardian(self, guardian: GuardianId, message: ToGuardian) -> None:
        """Sends a message to a guardian, on this agent or another one."""
        self.say(guardian.agent, GUARDIAN, message, guardian.journal)

    def connected(self, agent: str) -> bool:
        """Returns whether there is a link to an agent now."""
        return agent in self._mesh.connected()

    def hand_off(self, agent: str, message: HandOffMessage) -> None:
        """Sends a hand-off message to the service of the same name on another agent; a snapshot in pieces."""
        for part in cut(message) if isinstance(message, Transfer) else (message,):
            self.say(agent, self._speaker.name, part)

    def say(self, agent: str, actor: str, message: ToPeer, journal: str = "") -> None:
        """Sends a message to an actor of an agent.

        Args:
            agent: the agent, which may be this one. Where it is not linked, and not known, nothing is sent.
            actor: the address of the actor there, without the agent's name.
            message: the message.
            journal: the id of the journal that the agent is to have; empty: that which it has now.
        """
        known = self.me.journal
        if agent != self.me.agent:
            hello = self._mesh.connected().get(agent)
            if hello is not None:
                known = hello.journal
            else:  # it may be known, and the message waits for a link where the disk is known as well
                known = journal if self._mesh.seek(agent) else ""
        if not known or journal not in ("", known):
            return
        try:
            self._speaker.publish(NETWORK, addressed(message, known), to=join(agent, actor))
        except PancakesError as error:
            self._speaker.log("debug", f"{type(message).__name__} of {message.task_id} did not reach {agent}: {error}")
