"""Letters that come for hosted tasks: given to the task, or answered with where it went."""

from __future__ import annotations

from msgspec.structs import replace

from pancakes.errors import MigrationError
from pancakes.mesh.migration.core import handle
from pancakes.mesh.migration.effect import Deliver, Forward
from pancakes.mesh.migration.event import Arrived, PacketId
from pancakes.mesh.migration.post import ForwardTo, Letter, Receipt, StreamsBegan
from pancakes.mesh.migration.record import Phase, TaskId
from pancakes.mesh.migration.snapshot import Snapshot
from pancakes.packet import Packet
from pancakes.runtime.hosting.courier_messages import COURIER, AskedBegan, CameFor, Say
from pancakes.runtime.hosting.hosting_service import HostingService
from pancakes.runtime.hosting.place import Place, began_from
from pancakes.runtime.hosting.task_letters import TaskLetters
from pancakes.runtime.kernel.dead_letters import ATTEMPTS
from pancakes.runtime.kernel.reference import Reference
from pancakes.runtime.kernel.tell import tell
from pancakes.runtime.life.life import State
from pancakes.runtime.supervision.task_messages import Give, LetterGiven, LetterOutcome, Look


class Deliveries:
    """Gives letters to the tasks of one service. All in that service's actor.

    With `durability = "each"` a letter is acknowledged once its effect is on disk. With `"lazy"` that runs ahead of the
    disk: the letter is kept here until it is written down, and given again to a task that failed and begins anew from
    its checkpoint. So only a crash of the whole agent, or a failure of the service itself, loses what was acknowledged.

    Args:
        host: the service.
    """

    def __init__(self, host: HostingService) -> None:
        self._host = host

    def heard(self, message: CameFor | LetterGiven | AskedBegan) -> None:
        """Another actor of this agent has said something about letters."""
        match message:
            case CameFor():
                self._arrived(message)
            case LetterGiven():
                self._given(message)
            case AskedBegan():
                self._asked_began(message)

    def _arrived(self, came: CameFor) -> None:
        """Takes a letter; where it cannot be given to the task now, its sender keeps it and sends it again."""
        letter, host = came.letter, self._host
        place = host.places.get(TaskId.parse(letter.task_id))
        if place is None:
            return
        standing = place.standing
        # Asked past the queue of events: it changes nothing, and what is being written now is no reason to wait.
        for effect in handle(host.agent, standing.record, standing.volatile, Arrived()):
            match effect:
                case Deliver():
                    self._deliver(place, letter, came.packet)
                case Forward():
                    self._say(letter.sender, ForwardTo(letter.task_id, effect.peer, effect.epoch.n))

    def _deliver(self, place: Place, letter: Letter, packet: Packet | None) -> None:
        slot = place.slot
        if slot is None or slot.task is None or slot.life.state is not State.RUNNING:
            return
        place.letters = letters = place.letters or TaskLetters()
        key = (letter.stream, letter.seq)
        if packet is None and key not in letters.failures:
            letters.note_failures(letter, ATTEMPTS)
            reason = f"{slot.address} cannot read packet #{letter.seq} of {letter.stream}"
            self._host.kernel.dead_letters.bury(reason)
        addressed = None
        if packet is not None and letters.failures.get(key, 0) < ATTEMPTS:
            # To its handlers it is as any other packet that names them.
            addressed = replace(packet, destination=slot.address)
        # It comes again and again while the task computes or waits, and would fill the memory.
        if letters.give(slot.task, letter, packet):
            tell(slot.task, Give(letter, addressed))

    def _given(self, told: LetterGiven) -> None:
        """A task says what has become of a letter."""
        letter, task = told.give.letter, told.task
        place = self._host.places.get(TaskId.parse(letter.task_id))
        letters = place.letters if place is not None else None
        if place is None or letters is None:
            return  # the task was given away meanwhile
        packet = letters.looked_at(task, letter)
        if told.outcome is LetterOutcome.FAILED:
            # It is not acknowledged, so it comes again when the task has been restarted.
            failures = letters.failures.get((letter.stream, letter.seq), 0) + 1
            letters.note_failures(letter, failures)
            if failures == ATTEMPTS and packet is not None:
                self._host.kernel.dead_letters.bury(
                    f"{task.address} failed {failures} times on {packet.type!r} #{packet.number} from {packet.source}"
                )
        elif told.outcome is LetterOutcome.TAKEN:
            self._took(place, letters, task, letter, packet)

    def _took(self, place: Place, letters: TaskLetters, task: Reference, letter: Letter, packet: Packet | None) -> None:
        slot = place.slot
        if slot is None or slot.task is not task:
            return  # the actor that took it has ended; its sender, which has not been told so, sends it again
        letters.took(letter)
        if slot.spec.durability == "each":
            return
        if letters.keep(letter, packet):
            self._acknowledge(place, PacketId(letter.stream, letter.seq), letter.sender)
        elif not letters.asked:
            letters.asked = True
            tell(task, Look())

    def became_owner(self, place: Place) -> None:
        """A task is owned here from now on, or under another epoch: remembers what it begins from."""
        record, slot = place.standing.record, place.slot
        if slot is not None and slot.task is not None:
            return  # it goes on as it is
        try:
            snapshot = Snapshot.decode(record.snapshot)
        except MigrationError:  # it cannot be started either, which is said where that is tried
            return
        place.began = began_from(record.epoch, snapshot)

    def _asked_began(self, message: AskedBegan) -> None:
        """An agent that has sent letters to a task asks from what state it began here."""
        place = self._host.places.get(TaskId.parse(message.asked.task_id))
        if place is not None and place.began is not None and place.standing.record.phase is Phase.OWNER:
            upto = {stream: place.began.upto(stream) for stream in message.asked.streams}
            began = StreamsBegan(message.asked.task_id, place.began.epoch_n, upto, place.began.life)
            self._say(message.peer, began)

    def again(self, place: Place) -> None:
        """Gives a task that has begun anew what was acknowledged and is not in its checkpoint; all else comes after."""
        if place.letters is not None:
            for letter, packet in list(place.letters.kept.values()):
                self._deliver(place, letter, packet)

    def on_disk(self, place: Place, packet: PacketId) -> None:
        """A letter, and all before it in its stream, have had their effect for good."""
        sender = place.letters.on_disk(packet) if place.letters is not None else ""
        if sender:
            self._acknowledge(place, packet, sender)

    def _acknowledge(self, place: Place, packet: PacketId, sender: str) -> None:
        """Tells the sender of a letter that it, and all before it, have had their effect."""
        began, epoch_n = place.began, place.standing.record.epoch.n
        receipt = Receipt(str(place.task_id), packet.stream, packet.seq, epoch_n)
        if began is not None:
            upto = began.upto(packet.stream)
            receipt = replace(receipt, began_n=began.epoch_n, began_seq=upto, began_life=began.life)
        self._say(sender, receipt)

    def _say(self, peer: str, body: Receipt | ForwardTo | StreamsBegan) -> None:
        self._host.kernel.tell(COURIER, Say(peer, body))
