"""The courier: brings packets to tasks, wherever these are (`to="task:birthplace/name"`)."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from pancakes.errors import LocalProtocolError, MigrationError, PancakesError, RemoteProtocolError
from pancakes.hosting.deliveries import COURIER, CameFor, Say
from pancakes.kernel.component import Component
from pancakes.kernel.handlers import on
from pancakes.kernel.keep import queue
from pancakes.kernel.tell import tell
from pancakes.migration.outbox import Outbox
from pancakes.migration.post import RESEND_S, Dispatch, ForwardTo, Letter, Receipt
from pancakes.migration.record import TaskId
from pancakes.migration.snapshot import Posted
from pancakes.net.mesh import Mesh
from pancakes.packet import NETWORK, TO_TASK, Packet, agent_of, join
from pancakes.wire.codec import Encoder, packet_from_row, rows_from_payload
from pancakes.wire.framing import MAX_MESSAGE_BYTES

if TYPE_CHECKING:
    from pancakes.hosting.client import ClientService

ENVELOPE_BYTES: Final = 1024
"""What a letter takes besides the packet in it, at most."""
KEEP: Final = queue(4096)
"""What falls out comes again."""
_ONE_MESSAGE: Final = b"\x91"  # the head of a msgpack array of one


class Courier(Component):
    """Keeps what this agent's tasks send to others until it is acknowledged, and takes in what comes for tasks here.

    It belongs to no service: what goes from task to task on one agent needs no network, which may sleep.

    Args:
        outbox: what is not acknowledged; it outlives an actor that fails.
        mesh: says who the neighbours are.
    """

    def __init__(self, *args: Any, outbox: Outbox, mesh: Mesh, **others: Any) -> None:
        super().__init__(*args, **others)
        self._outbox = outbox
        self._mesh = mesh
        self._lock = threading.Lock()  # the books are filled in the publishers' threads, so that these hear what fails
        self._encoder = Encoder()
        self._looking = False

    def on_start(self) -> None:
        self.kernel.stream.courier = self.take
        self._look()

    def on_stop(self) -> None:
        self.kernel.stream.courier = None

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        self.kernel.stream.courier = None

    def on_receive(self, message: Any) -> Any:
        if not isinstance(message, Say):
            return super().on_receive(message)
        self.say(message.peer, message.body)
        return None

    def take(self, packet: Packet) -> None:
        """Takes a packet whose destination is a task. In the publisher's thread.

        Raises:
            LocalProtocolError: the destination is no task's, or the packet cannot travel.
            MailboxFull: too many wait for this task already.
        """
        try:
            task_id = TaskId.parse(packet.destination.removeprefix(TO_TASK))
        except MigrationError as error:
            raise LocalProtocolError(f"{packet.source} published {packet.type!r} to nobody: {error}") from None
        with self._lock:
            data = self._encoder.packet(packet)
            if len(data) > MAX_MESSAGE_BYTES - ENVELOPE_BYTES:
                raise LocalProtocolError(
                    f"the packet {packet.seq} of the type {packet.type!r} from {packet.source} takes {len(data)} bytes,"
                    f" and {MAX_MESSAGE_BYTES - ENVELOPE_BYTES} may be sent to a task"
                )
            sender = packet.fence.task_id if packet.fence is not None else ""
            host = self._outbox.host_of(sender, task_id)
            if not host:
                host = self.agent if self._service_of(task_id) is not None else task_id.birthplace
            letters = self._outbox.post(sender, task_id, data, host, self.kernel.host.now())
            # Under the lock: they are to go in the order in which they were numbered.
            self.call(lambda: self._send(letters))

    # A task that sends, and moves. Any thread.

    def leave(self, sender: TaskId) -> Posted | None:
        """A task stands still and is about to leave: returns what it takes along of what it has sent."""
        with self._lock:
            return self._outbox.leave(str(sender))

    def stay(self, sender: TaskId) -> None:
        """It does not leave after all."""
        with self._lock:
            self._outbox.stay(str(sender))

    def gone(self, sender: TaskId, ends: bool) -> None:
        """It has left for good; `ends`: its actor is still to end here, and `ended` is to follow."""
        with self._lock:
            self._outbox.gone(str(sender), ends)

    def ended(self, sender: str) -> None:
        """The actor of a task (`birthplace/name`) that has left for good has ended."""
        with self._lock:
            self._outbox.ended(sender)

    def arrive(self, sender: TaskId, posted: Posted | None, fresh: bool) -> None:
        """A task begins from a snapshot; `fresh`: nothing of it has run since that was taken."""
        with self._lock:
            self._outbox.arrive(str(sender), posted, fresh)
        if posted is not None:
            self.call(self._look)

    def say(self, peer: str, body: Letter | Receipt | ForwardTo) -> None:
        """Tells the courier of an agent something; it may be lost. In this actor."""
        if peer != self.agent:
            try:
                self.publish(NETWORK, body, to=join(peer, COURIER))
            except PancakesError as error:
                self.log("debug", f"{type(body).__name__} for {body.task_id} did not reach {peer}: {error}")
        elif isinstance(body, Letter):
            self._arrived(body)
        elif isinstance(body, Receipt):
            self._acknowledged(body, self.agent)
        else:
            self._forwarded(body)

    # What other couriers say -----------------------------------------------------------------------------------

    @on(NETWORK, Letter, keep=KEEP, addressed=True)
    def on_letter(self, packet: Packet) -> None:
        """A packet has come for a task that is, or was, here."""
        self._arrived(packet.body)

    @on(NETWORK, Receipt, keep=KEEP, addressed=True)
    def on_receipt(self, packet: Packet) -> None:
        """Letters have had their effect."""
        self._acknowledged(packet.body, agent_of(packet.source))

    @on(NETWORK, ForwardTo, keep=KEEP, addressed=True)
    def on_forward_to(self, packet: Packet) -> None:
        """A task is not where it was thought to be."""
        self._forwarded(packet.body)

    def _arrived(self, letter: Letter) -> None:
        try:
            task_id = TaskId.parse(letter.task_id)
        except MigrationError as error:
            self.log("warning", f"a letter of {letter.stream} was dropped: {error}")
            return
        service = self._service_of(task_id)
        if service is None:
            return
        packet: Packet | None = None
        try:
            packet = packet_from_row(rows_from_payload(_ONE_MESSAGE + letter.packet)[0])
        except RemoteProtocolError as error:
            self.log("warning", f"a packet for {task_id} cannot be read: {error}")
        tell(service, CameFor(letter, packet))

    def _acknowledged(self, receipt: Receipt, peer: str) -> None:
        with self._lock:
            letters = self._outbox.acknowledged(receipt, peer, self.kernel.host.now())
        self._send(letters)

    def _forwarded(self, news: ForwardTo) -> None:
        with self._lock:
            letters = self._outbox.forwarded(news, self.kernel.host.now())
        self._send(letters)

    # Sending ---------------------------------------------------------------------------------------------------

    def _send(self, letters: Sequence[Dispatch]) -> None:
        for dispatch in letters:
            for peer in (dispatch.peer,) if dispatch.peer else (self.agent, *self._mesh.neighbours()):
                self.say(peer, dispatch.letter)
        if letters and not self._looking:
            self._looking = True
            self.after_host(RESEND_S / 2, self._look)

    def _look(self) -> None:
        """Sends again what was not acknowledged for too long."""
        with self._lock:
            letters = self._outbox.due(self.kernel.host.now())
            waits = bool(self._outbox.waiting())
        self._looking = waits
        if waits:
            self.after_host(RESEND_S / 2, self._look)
        self._send(letters)

    def _service_of(self, task_id: TaskId) -> ClientService | None:
        """Returns the service here that knows the task. Any thread."""
        for component in self.kernel.registry.components():
            if getattr(component, "durable", False) and component.knows(task_id):  # type: ignore[attr-defined]
                return component  # type: ignore[return-value]
        return None
