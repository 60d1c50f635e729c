"""What comes for the tasks of one service that are addressed wherever they are: given to them, or sent after them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from msgspec.structs import replace

from pancakes.kernel.letters import ATTEMPTS
from pancakes.migration.core import handle
from pancakes.migration.effect import Deliver, Forward, Send
from pancakes.migration.event import Arrived, PacketId
from pancakes.migration.messages import Moved
from pancakes.migration.post import ForwardTo, Letter, Receipt, onward
from pancakes.migration.record import TaskId
from pancakes.packet import Packet, agent_of, join
from pancakes.slot import Slot, TaskState

if TYPE_CHECKING:
    from pancakes.services.courier import Courier
    from pancakes.services.recorded import RecordedService
    from pancakes.task import Task

COURIER: Final = "kernel/Courier"
"""Where on each agent the courier is."""

_Key = tuple[TaskId, str, int]


class Postbox:
    """Gives letters to the tasks of one service. All in that service's actor.

    Args:
        service: whose tasks they are.
    """

    def __init__(self, service: RecordedService) -> None:
        self._service = service
        self._owed: dict[TaskId, dict[str, int]] = {}  # handled, and to be acknowledged once that is on disk
        self._failures: dict[_Key, int] = {}

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
        sender = agent_of(letter.stream)
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
        if slot is None or slot.task is None or slot.state is not TaskState.RUNNING:
            return
        task = slot.task
        key = (task_id, letter.stream, letter.seq)
        if packet is None and key not in self._failures:
            self._failures[key] = ATTEMPTS
            reason = f"{slot.address} cannot read packet #{letter.seq} of {letter.stream}"
            self._service.kernel.letters.bury(reason)
        addressed = None
        if packet is not None and self._failures.get(key, 0) < ATTEMPTS:
            # To its handlers it is as any other packet that names them.
            addressed = replace(packet, destination=slot.address)

        def give() -> None:
            try:
                took = task.take_letter(letter.stream, letter.seq, letter.first, addressed)
            except BaseException:
                self._service.call(lambda: self._failed(key, slot.address, packet))
                raise
            if took:
                self._service.call(lambda: self._took(slot, task, key))

        task.call(give)

    def _failed(self, key: _Key, address: str, packet: Packet | None) -> None:
        """A handler raised: the letter is not acknowledged, so it comes again when the task has been restarted."""
        self._failures[key] = failures = self._failures.get(key, 0) + 1
        if failures == ATTEMPTS and packet is not None:
            self._service.kernel.letters.bury(
                f"{address} failed {failures} times on {packet.type!r} #{packet.seq} from {packet.source}"
            )

    def _took(self, slot: Slot, task: Task, key: _Key) -> None:
        task_id, stream, seq = key
        self._failures.pop(key, None)
        if slot.spec.durability != "each":
            self.acknowledge(task_id, PacketId(stream, seq))
        elif slot.task is task:
            # Also where it was handled before: what the task remembers need not be on disk yet.
            owed = self._owed.setdefault(task_id, {})
            owed[stream] = max(seq, owed.get(stream, 0))

    def owes(self, task_id: TaskId) -> bool:
        """Returns whether something that the task has handled waits for the disk."""
        return bool(self._owed.get(task_id))

    def consumed(self, task_id: TaskId, heard: Mapping[str, int]) -> tuple[PacketId, ...]:
        """Returns what may be acknowledged once a task is on disk that has `heard` so much, and forgets it."""
        owed = self._owed.get(task_id)
        if not owed:
            return ()
        ready = tuple(PacketId(stream, seq) for stream, seq in owed.items() if seq <= heard.get(stream, 0))
        for packet in ready:
            del owed[packet.stream]
        return ready

    def acknowledge(self, task_id: TaskId, packet: PacketId) -> None:
        """Tells the sender of a letter that it, and all before it, have had their effect."""
        epoch_n = self._service.hand_off(task_id).record.epoch.n
        self._say(agent_of(packet.stream), Receipt(str(task_id), packet.stream, packet.seq, epoch_n))

    def _say(self, peer: str, body: Letter | Receipt | ForwardTo) -> None:
        courier: Courier | None = self._service.kernel.registry.get(  # type: ignore[assignment]
            join(self._service.agent, COURIER)
        )
        if courier is not None:
            courier.call(lambda: courier.say(peer, body))
