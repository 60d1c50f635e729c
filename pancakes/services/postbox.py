"""What comes for the tasks of one service that are addressed wherever they are: given to them, or sent after them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final
from weakref import WeakKeyDictionary

import msgspec
from msgspec.structs import replace

from pancakes.kernel.letters import ATTEMPTS, MOST_KNOWN
from pancakes.kernel.tell import tell
from pancakes.life.life import State
from pancakes.migration.core import handle
from pancakes.migration.effect import Deliver, Forward, Send
from pancakes.migration.event import Arrived, PacketId
from pancakes.migration.messages import Moved
from pancakes.migration.post import ForwardTo, Letter, Receipt, onward
from pancakes.migration.record import TaskId
from pancakes.packet import Packet, join
from pancakes.slot import Slot
from pancakes.task import Task
from pancakes.task_messages import Give, LetterGiven, LetterOutcome

if TYPE_CHECKING:
    from pancakes.services.courier import Courier
    from pancakes.services.recorded import RecordedService

COURIER: Final = "kernel/Courier"
"""Where on each agent the courier is."""

KEPT: Final = 1024
"""Most letters of one task that are acknowledged before they are on disk, ..."""
KEPT_BYTES: Final = 4 * 1024 * 1024
"""... and most bytes of them; with more, the task is written down at once, and only then are they acknowledged."""

_Key = tuple[TaskId, str, int]


class CameFor(msgspec.Struct, frozen=True):
    """The courier tells a service that a packet has come for one of its tasks.

    Attributes:
        letter: the letter that it came in.
        packet: what is in it; None: it cannot be read here.
    """

    letter: Letter
    packet: Packet | None


class Say(msgspec.Struct, frozen=True):
    """A service tells the courier to tell that of another agent something.

    Attributes:
        peer: the other agent.
        body: what to tell it.
    """

    peer: str
    body: Letter | Receipt | ForwardTo


class _Kept:
    """What a task has handled and its sender has forgotten, and what is not on disk: its letters, in order."""

    def __init__(self) -> None:
        self.letters: dict[tuple[str, int], tuple[Letter, Packet | None]] = {}
        self.asked = False  # for a checkpoint, because there is no more room
        self._bytes = 0

    def add(self, letter: Letter, packet: Packet | None) -> bool:
        """Keeps a letter; returns False where there is no room for it."""
        key = (letter.stream, letter.seq)
        if key not in self.letters:
            if len(self.letters) >= KEPT or self._bytes >= KEPT_BYTES:
                return False
            self.letters[key] = (letter, packet)
            self._bytes += len(letter.packet)
        return True

    def drop(self, stream: str, upto: int) -> None:
        """Forgets the letters of a stream up to a number: they are on disk."""
        for key in [key for key in self.letters if key[0] == stream and key[1] <= upto]:
            self._bytes -= len(self.letters.pop(key)[0].packet)
            self.asked = False


class Postbox:
    """Gives letters to the tasks of one service. All in that service's actor.

    With `durability = "each"` a letter is acknowledged once its effect is on disk. With `"lazy"` that runs ahead of the
    disk: the letter is kept here until it is written down, and given again to a task that failed and begins anew from
    its checkpoint. So only a crash of the whole agent, or a failure of the service itself, loses what was acknowledged.

    Args:
        service: whose tasks they are.
    """

    def __init__(self, service: RecordedService) -> None:
        self._service = service
        # Handled, and not known to be on disk: up to which number, and which agent wants to hear of it, by stream.
        self._owed: dict[TaskId, dict[str, tuple[int, str]]] = {}
        self._kept: dict[TaskId, _Kept] = {}  # acknowledged before that
        self._failures: dict[_Key, int] = {}
        # What each task has still to look at: which letter, and what its sender said then of those before it.
        self._given: WeakKeyDictionary[Task, dict[tuple[str, int, int], Packet | None]] = WeakKeyDictionary()

    def arrived(self, letter: Letter, packet: Packet | None) -> None:
        """Takes a letter; where it cannot be given to the task now, its sender keeps it and sends it again.

        Args:
            letter: the letter.
            packet: what is in it; None: it cannot be read here.
        """
        service = self._service
        task_id = TaskId.parse(letter.task_id)
        hand_off = service.hand_offs.get(task_id)
        if hand_off is None:
            return
        sender = letter.sender
        # Asked past the queue of events: it changes nothing, and what is being written now is no reason to wait.
        for effect in handle(service.agent, hand_off.record, hand_off.volatile, Arrived(sender)):
            match effect:
                case Deliver():
                    self._deliver(task_id, letter, packet)
                case Send(message=Moved() as moved):
                    self._say(sender, ForwardTo(letter.task_id, moved.peer, moved.epoch.n))
                case Forward():
                    further = onward(letter)
                    if further is not None:
                        self._say(effect.peer, further)

    def _deliver(self, task_id: TaskId, letter: Letter, packet: Packet | None) -> None:
        slot = self._service.slots.get(task_id.name)
        if slot is None or slot.task is None or slot.life.state is not State.RUNNING:
            return
        task = slot.task
        key = (task_id, letter.stream, letter.seq)
        if packet is None and key not in self._failures:
            self._note_failures(key, ATTEMPTS)
            reason = f"{slot.address} cannot read packet #{letter.seq} of {letter.stream}"
            self._service.kernel.letters.bury(reason)
        addressed = None
        if packet is not None and self._failures.get(key, 0) < ATTEMPTS:
            # To its handlers it is as any other packet that names them.
            addressed = replace(packet, destination=slot.address)
        given = self._given.setdefault(task, {})
        place = (letter.stream, letter.seq, letter.first)
        if place in given:
            return  # it comes again and again while the task computes or waits, and would fill the memory
        given[place] = packet
        tell(task, Give(letter, addressed))

    def given(self, told: LetterGiven) -> None:
        """A task says what has become of a letter."""
        letter, task = told.give.letter, told.task
        assert isinstance(task, Task)
        packet = self._given[task].pop((letter.stream, letter.seq, letter.first))
        task_id = TaskId.parse(letter.task_id)
        if told.outcome is LetterOutcome.FAILED:
            self._failed((task_id, letter.stream, letter.seq), task.address, packet)
        elif told.outcome is LetterOutcome.TAKEN:
            slot = self._service.slots.get(task_id.name)
            if slot is not None:
                self._took(slot, task, letter, packet)

    def _failed(self, key: _Key, address: str, packet: Packet | None) -> None:
        """A handler raised: the letter is not acknowledged, so it comes again when the task has been restarted."""
        failures = self._failures.get(key, 0) + 1
        self._note_failures(key, failures)
        if failures == ATTEMPTS and packet is not None:
            self._service.kernel.letters.bury(
                f"{address} failed {failures} times on {packet.type!r} #{packet.seq} from {packet.source}"
            )

    def _note_failures(self, key: _Key, failures: int) -> None:
        self._failures.pop(key, None)
        self._failures[key] = failures
        if len(self._failures) > MOST_KNOWN:  # a letter whose sender has gone never comes again, and nobody says so
            del self._failures[next(iter(self._failures))]

    def _took(self, slot: Slot, task: Task, letter: Letter, packet: Packet | None) -> None:
        task_id = TaskId.parse(letter.task_id)
        self._failures.pop((task_id, letter.stream, letter.seq), None)
        if slot.task is not task:
            return  # the actor that took it has ended; its sender, who has not been told so, sends it again
        # Also where it was handled before: what the task remembers need not be on disk yet.
        owed = self._owed.setdefault(task_id, {})
        seq, _ = owed.get(letter.stream, (0, ""))
        owed[letter.stream] = (max(letter.seq, seq), letter.sender)
        if slot.spec.durability == "each":
            return
        kept = self._kept.setdefault(task_id, _Kept())
        if kept.add(letter, packet):
            self._acknowledge(task_id, PacketId(letter.stream, letter.seq), letter.sender)
        elif not kept.asked:
            kept.asked = True
            self._service.checkpoint(slot, task)

    def again(self, slot: Slot) -> None:
        """Gives a task that has begun anew what was acknowledged and is not in its checkpoint; all else comes after."""
        task_id = self._service.id_of(slot)
        kept = self._kept.get(task_id)
        if kept is not None:
            for letter, packet in list(kept.letters.values()):
                self._deliver(task_id, letter, packet)

    def forget(self, task_id: TaskId) -> None:
        """The task was given away, with all that it has handled."""
        self._owed.pop(task_id, None)
        self._kept.pop(task_id, None)
        for key in [key for key in self._failures if key[0] == task_id]:
            del self._failures[key]

    def owes(self, task_id: TaskId) -> bool:
        """Returns whether something that the task has handled waits for the disk."""
        return bool(self._owed.get(task_id))

    def consumed(self, task_id: TaskId, heard: Mapping[str, int]) -> tuple[PacketId, ...]:
        """Returns what is on disk once a task is that has `heard` so much."""
        owed = self._owed.get(task_id, {})
        return tuple(PacketId(stream, seq) for stream, (seq, _) in owed.items() if seq <= heard.get(stream, 0))

    def on_disk(self, task_id: TaskId, packet: PacketId) -> None:
        """A letter, and all before it in its stream, have had their effect for good."""
        if task_id in self._kept:
            self._kept[task_id].drop(packet.stream, packet.seq)
        owed = self._owed.get(task_id, {})
        if packet.stream not in owed:
            return  # it was given away meanwhile, or its sender has been told
        seq, sender = owed[packet.stream]
        if seq <= packet.seq:
            del owed[packet.stream]
        self._acknowledge(task_id, packet, sender)

    def _acknowledge(self, task_id: TaskId, packet: PacketId, sender: str) -> None:
        """Tells the sender of a letter that it, and all before it, have had their effect."""
        epoch_n = self._service.hand_off(task_id).record.epoch.n
        self._say(sender, Receipt(str(task_id), packet.stream, packet.seq, epoch_n))

    def _say(self, peer: str, body: Letter | Receipt | ForwardTo) -> None:
        courier = self.courier()
        if courier is not None:
            tell(courier, Say(peer, body))

    def courier(self) -> Courier | None:
        """Returns this agent's courier; None while it is being started anew."""
        return self._service.kernel.registry.get(join(self._service.agent, COURIER))  # type: ignore[return-value]
