"""Sends and receives packets that are addressed to a task (`to="task:BIRTHPLACE/NAME"`).

The courier belongs to no service, because packets between tasks of one agent need no network. `Outbox` holds what is
not acknowledged yet. The rules of each stream are in `delivery`.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from typing import Any, Final

from msgspec.structs import replace

from pancakes.durable.answers import fact_of
from pancakes.durable.delivery import (
    COURIER,
    MOST_STREAMS,
    RESEND_S,
    AskBegan,
    AskedBegan,
    CameFor,
    ForwardTo,
    Letter,
    LostLetters,
    Outgoing,
    Receipt,
    Say,
    Seek,
    SendUnsent,
    StreamsBegan,
    ToSend,
    asked_now,
    false_name,
)
from pancakes.durable.messages import REGISTRAR, Fact, Known, WhoHas
from pancakes.durable.record import TaskId
from pancakes.durable.register_messages import KnownCame
from pancakes.durable.snapshot import Posted
from pancakes.durable.store import Records
from pancakes.errors import LocalProtocolError, MigrationError, PancakesError, RemoteProtocolError
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import drop_oldest, on
from pancakes.kernel.mailbox import Reference, tell
from pancakes.mesh.codec import MAX_MESSAGE_BYTES, encode_packet, packet_from_row, rows_from_payload
from pancakes.mesh.mesh import Mesh
from pancakes.packet import NETWORK, TO_TASK, Packet, agent_of, join
from pancakes.util.codecs import blake2s
from pancakes.util.text import did_you_mean

ENVELOPE_BYTES: Final = 1024
"""What a letter takes besides the packet in it, at most."""


class Outbox:
    """The streams of one agent: publishers fill it, senders change it as they move, and the courier empties it.

    Any thread. Its lock is held for its own tables alone.

    A stream to which no task adds any more, because its task has gone on in another one, is kept until all of it is
    acknowledged. What a task sends on its way out (a thread of its own, its `on_stop`) goes in the common stream: of
    streams of its own, one for each move, there would be ever more if no agent acknowledges them.

    Args:
        name: begins the names of all streams that are begun here; no other start of any agent ever had it.
        agent: the agent.
        secret: what no other agent can guess; the secret of each stream is drawn from it.

    Attributes:
        name: the same name.
        agent: the same agent.
    """

    def __init__(self, name: str, agent: str, secret: str = "") -> None:
        self.name = name
        self.agent = agent
        self._secret = secret
        self._begun = 0
        self._lock = threading.Lock()
        self._unsent: list[ToSend] = []  # in the order in which they were numbered
        self._common = self._begin(name)
        self._streams: dict[str, Outgoing] = {self._common.stream: self._common}
        self._named: dict[str, Outgoing] = {}  # by what they are called in letters
        self._of: dict[str, Outgoing] = {}  # the streams that tasks add to, by the sender's id
        self._left: dict[str, Outgoing | None] = {}  # those of tasks that are paused for a migration
        self._ending: set[str] = set()  # tasks that have left for good, and whose actor has not ended

    def post(self, sender: str, task_id: TaskId, packet: bytes, host: str, now_s: float) -> None:
        """Take a packet for a task.

        Args:
            sender: the task that sends it, as `birthplace/name`; empty: the sender does not move.
            task_id: the task that it is for.
            packet: the packet, as the wire writes it.
            host: where that task is, as far as the caller knows, if nothing that is kept here was ever sent to it.
            now_s: host time.

        Raises:
            MailboxFullError: too many of this sender wait for this task already.
        """
        with self._lock:
            stream = self._stream_of(sender)
            self._unsent += stream.post(task_id, packet, self._host_of(stream, task_id) or host, now_s)
            self._named[stream.name_for(str(task_id))] = stream

    def take_unsent(self) -> Sequence[ToSend]:
        """Return what to send now, in order, and forget that."""
        with self._lock:
            unsent, self._unsent = self._unsent, []
        return unsent

    def acknowledged(self, receipt: Receipt, peer: str, now_s: float) -> None:
        """Forget what has had its effect; what follows may be sent."""
        with self._lock:
            if (stream := self._named.get(receipt.stream)) is not None:
                self._unsent += stream.acknowledged(receipt, peer, now_s)
                self._drop_done(stream)

    def unsure_of(self, task_id: str, epoch_n: int) -> tuple[str, ...]:
        """Return the streams, as letters to a task name them, whose letters may be lost now that an epoch owns it."""
        with self._lock:
            streams = self._streams.values()
            return tuple(stream.name_for(task_id) for stream in streams if stream.is_unsure_of(task_id, epoch_n))

    def began(self, news: StreamsBegan, peer: str) -> None:
        """Learn from what state a task began where it is now."""
        with self._lock:
            for stream in self._streams.values():
                stream.began(news, peer)

    def take_lost(self) -> list[LostLetters]:
        """Return what is known to be lost, and forget it."""
        with self._lock:
            senders = {stream.stream: sender for sender, stream in self._of.items()}
            found = [(name, lost) for name, stream in self._streams.items() for lost in stream.take_lost()]
        return [replace(lost, sender=senders.get(name, "")) for name, lost in found]

    def forwarded(self, news: ForwardTo, peer: str, now_s: float) -> None:
        """Learn of a peer where a task has gone; what waits for it is sent there."""
        with self._lock:
            for stream in self._streams.values():
                self._unsent += stream.forwarded(news, peer, now_s)

    def look(self, now_s: float) -> None:
        """Look for what was not acknowledged for too long: send that again."""
        with self._lock:
            self._look(now_s)

    def waiting(self) -> dict[str, int]:
        """Return how many packets wait for their acknowledgement, by the task that they are for."""
        waiting: dict[str, int] = {}
        with self._lock:
            for stream in self._streams.values():
                for task_id, count in stream.waiting().items():
                    waiting[task_id] = waiting.get(task_id, 0) + count
        return waiting

    # A sender that moves ---------------------------------------------------------------------------------------

    def leave(self, sender: str) -> Posted | None:
        """A sender is paused and is about to leave: return its stream, to which nothing may be added from now on.

        What is in it is sent all the same: its new host will send it again under the same numbers.
        """
        with self._lock:
            if sender not in self._left:
                self._left[sender] = self._of.pop(sender, None)
            stream = self._left[sender]
            return stream.posted() if stream is not None else None

    def stay(self, sender: str) -> None:
        """It does not leave after all, and goes on with its stream."""
        with self._lock:
            if (stream := self._left.pop(sender, None)) is not None:
                self._of[sender] = stream

    def gone(self, sender: str, ends: bool = False) -> None:
        """It has left for good, with its stream; `ends`: its actor is still to end here, and `ended` is to follow."""
        with self._lock:
            if (stream := self._left.pop(sender, None)) is not None:
                self._forget(stream)
            if ends:
                self._ending.add(sender)

    def ended(self, sender: str) -> None:
        """Nothing of a sender that has left runs here any more."""
        with self._lock:
            self._ending.discard(sender)

    def arrive(self, sender: str, posted: Posted | None, fresh: bool, now_s: float) -> None:
        """A sender begins from a snapshot.

        Args:
            sender: the task.
            posted: the stream that is in the snapshot.
            fresh: whether nothing of it has run since; else numbers may have been given out that the snapshot does not
                know of, so that only what is in it may be sent again, and the task begins a new stream.
            now_s: host time.
        """
        with self._lock:
            self._ending.discard(sender)
            if fresh or sender not in self._of:  # else it failed and begins again: its stream has never left
                self._take_in(sender, posted, fresh)
            if posted is not None:
                self._look(now_s)

    def _take_in(self, sender: str, posted: Posted | None, fresh: bool) -> None:
        former = [self._left.pop(sender, None), self._of.pop(sender, None)]
        if posted is not None:
            if fresh or posted.stream not in self._streams:
                arrived = self._streams[posted.stream] = Outgoing.of(posted, self.agent)
                self._named.update(dict.fromkeys(arrived.names(), arrived))
            stream = self._streams[posted.stream]
            if fresh:
                self._of[sender] = stream
            former.append(stream)
        for done in former:
            if done is not None:
                self._drop_done(done)

    # With the lock held ----------------------------------------------------------------------------------------

    def _look(self, now_s: float) -> None:
        for stream in self._streams.values():
            self._unsent += stream.due(now_s)

    def _host_of(self, stream: Outgoing, task_id: TaskId) -> str:
        """Return where a task is thought to be; empty: nothing that is kept here was ever sent to it."""
        own = stream.host_of(task_id)
        known = [own] if own is not None else filter(None, (it.host_of(task_id) for it in self._streams.values()))
        return max(known, default=(-1, ""))[1]

    def _stream_of(self, sender: str) -> Outgoing:
        if not sender or sender in self._left or sender in self._ending:
            return self._common
        stream = self._of.get(sender)
        if stream is None:
            self._begun += 1
            stream = self._of[sender] = self._begin(f"{self.name}/{self._begun}")
            self._streams[stream.stream] = stream
        return stream

    def _begin(self, name: str) -> Outgoing:
        # A secret of its own, as it moves with its sender, and the agent there learns it.
        secret = blake2s(name.encode(), key=self._secret.encode(), digest_size=16).hexdigest()
        return Outgoing(f"{name}#{secret}", self.agent)

    def _drop_done(self, stream: Outgoing) -> None:
        is_kept = self._streams.get(stream.stream) is stream  # and not another one, that has come under its name
        if is_kept and stream is not self._common and not stream.waiting() and stream not in self._open():
            self._forget(stream)

    def _forget(self, stream: Outgoing) -> None:
        self._streams.pop(stream.stream, None)
        for name in stream.names():
            self._named.pop(name, None)

    def _open(self) -> Iterator[Outgoing | None]:
        yield from self._of.values()
        yield from self._left.values()


def receiver_of(packet: Packet) -> TaskId:
    """Returns the task that a packet is for.

    Raises:
        LocalProtocolError: its destination is no task's.
    """
    try:
        return TaskId.parse(packet.destination.removeprefix(TO_TASK))
    except MigrationError as error:
        raise LocalProtocolError(f"{packet.source} published {packet.type!r} to no task: {error}") from None


KEEP: Final = drop_oldest(4096)
"""What falls out comes again."""
SOUGHT_IN_VAIN: Final = 3
"""A task that was asked for so often, and that no agent has, is doubted: its name may be wrong."""
_ONE_MESSAGE: Final = b"\x91"  # the head of a msgpack array of one


class Courier(ActorCore):
    """Sends what this agent's tasks have for others until it is acknowledged, and takes in what comes for tasks here.

    It belongs to no service: what goes from task to task on one agent needs no network, which may sleep.

    Args:
        outbox: what is not acknowledged; it outlives an actor that fails.
        records: says which service here has a task.
        mesh: says what neighbours there are.
    """

    def __init__(self, *args: Any, outbox: Outbox, records: Records, mesh: Mesh, **others: Any) -> None:
        super().__init__(*args, **others)
        self._outbox = outbox
        self._records = records
        self._mesh = mesh
        self._looking = False
        self._asked: set[tuple[str, str]] = set()
        self._sought: dict[str, int] = {}  # how often a task was asked for that no agent has

    def on_start(self) -> None:
        self.kernel.stream.courier = self.take
        self._look()

    def on_stop(self) -> None:
        self.kernel.stream.courier = None

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        self.kernel.stream.courier = None

    def take_message(self, message: Any) -> Any:
        match message:
            case Say():
                self._say(message.peer, message.body)
            case SendUnsent():
                self._send()
            case KnownCame():
                self._ask_began(message)
            case _:
                return super().take_message(message)
        return None

    def take(self, packet: Packet) -> None:
        """Takes a packet whose destination is a task. In the publisher's thread, which hears what fails.

        Raises:
            LocalProtocolError: the destination is no task's, or the packet cannot travel.
            MailboxFullError: too many wait for this task already.
        """
        task_id, data = receiver_of(packet), encode_packet(packet)
        if len(data) > MAX_MESSAGE_BYTES - ENVELOPE_BYTES:
            raise LocalProtocolError(
                f"the packet {packet.number} of the type {packet.type!r} from {packet.source} takes {len(data)}"
                f" bytes, and {MAX_MESSAGE_BYTES - ENVELOPE_BYTES} may be sent to a task"
            )
        sender = packet.fence.task_id if packet.fence is not None else ""
        host = self.agent if self._service_of(task_id) is not None else task_id.birthplace
        self._outbox.post(sender, task_id, data, host, self.kernel.host.now())
        tell(self, SendUnsent())

    def _say(self, peer: str, body: Letter | Receipt | ForwardTo | StreamsBegan) -> None:
        if peer != self.agent:
            try:
                self.publish(NETWORK, body, to=join(peer, COURIER))
            except PancakesError as error:
                self.log("debug", f"{type(body).__name__} for {body.task_id} did not reach {peer}: {error}")
        elif isinstance(body, Letter):
            self._arrived(body, peer)
        elif isinstance(body, Receipt):
            self._acknowledged(body, self.agent)
        elif isinstance(body, ForwardTo):
            self._forwarded(body, peer)

    def _ask_began(self, came: KnownCame) -> None:
        """Another agent owns tasks: asks what is lost of what was acknowledged for them."""
        for fact in came.known.claims:
            streams = self._outbox.unsure_of(str(fact.task_id), fact.register.epoch.n)
            if not streams:
                continue
            asked = AskBegan(str(fact.task_id), streams[:MOST_STREAMS])
            self._asked.add((came.peer, asked.task_id))
            try:
                self.publish(NETWORK, asked, to=join(came.peer, COURIER))
            except PancakesError as error:
                self.log("debug", f"{came.peer} was not asked about {asked.task_id}: {error}")

    # What other couriers say -----------------------------------------------------------------------------------

    @on(NETWORK, Letter, queue=KEEP, addressed=True)
    def on_letter(self, packet: Packet) -> None:
        """A packet has come for a task that is, or was, here."""
        self._arrived(packet.body, agent_of(packet.source))

    @on(NETWORK, Receipt, queue=KEEP, addressed=True)
    def on_receipt(self, packet: Packet) -> None:
        """Letters have had their effect."""
        self._acknowledged(packet.body, agent_of(packet.source))

    @on(NETWORK, ForwardTo, queue=KEEP, addressed=True)
    def on_forward_to(self, packet: Packet) -> None:
        """A task is not where it was thought to be."""
        self._forwarded(packet.body, agent_of(packet.source))

    @on(NETWORK, AskBegan, queue=KEEP, addressed=True)
    def on_ask_began(self, packet: Packet) -> None:
        """An agent that has sent letters to a task that is here must know what is lost of them."""
        try:
            service = self._service_of(TaskId.parse(packet.body.task_id))
        except MigrationError:
            return
        if service is not None:
            tell(service, AskedBegan(agent_of(packet.source), packet.body))

    @on(NETWORK, StreamsBegan, queue=KEEP, addressed=True)
    def on_task_began(self, packet: Packet) -> None:
        """The agent that owns a task answers."""
        peer = agent_of(packet.source)
        if (peer, packet.body.task_id) in self._asked:
            self._asked.remove((peer, packet.body.task_id))
            self._outbox.began(packet.body, peer)
            self._tell_lost()

    @on(NETWORK, Known, addressed=True)
    def on_known(self, packet: Packet) -> None:
        """An agent that was asked says which one has a task."""
        peer = agent_of(packet.source)
        for fact in packet.body.facts:
            self._found(fact, peer)

    def _arrived(self, letter: Letter, peer: str) -> None:
        try:
            task_id = TaskId.parse(letter.task_id)
        except MigrationError as error:
            self.log("warning", f"a letter of {letter.stream} was dropped: {error}")
            return
        service = self._service_of(task_id)
        if service is None:
            return
        if fault := self.kernel.access.fault(peer, "write", str(task_id)):
            self.log("warning", f"a packet for {task_id} was refused: {fault}")
            return
        packet: Packet | None = None
        try:
            packet = packet_from_row(rows_from_payload(_ONE_MESSAGE + letter.packet)[0])
        except RemoteProtocolError as error:
            self.log("warning", f"a packet for {task_id} cannot be read: {error}")
        if other := false_name(letter, packet, peer):
            self.log("warning", f"a packet for {task_id} was refused: {peer} speaks for {other}")
            return
        tell(service, CameFor(letter, packet))

    def _acknowledged(self, receipt: Receipt, peer: str) -> None:
        self._outbox.acknowledged(receipt, peer, self.kernel.host.now())
        self._tell_lost()
        self._send()

    def _tell_lost(self) -> None:
        for lost in self._outbox.take_lost():
            sender = lost.sender or self.agent
            self.log(
                "warning",
                f"packets {lost.first} to {lost.last} that {sender} has sent to {lost.task_id} may be lost: they were"
                f" acknowledged, and {lost.peer} has the task from a checkpoint without their effect",
            )
            self.event(
                "packets_lost", task=lost.task_id, sender=sender, first=lost.first, last=lost.last, owner=lost.peer
            )

    def _forwarded(self, news: ForwardTo, peer: str) -> None:
        self._outbox.forwarded(news, peer, self.kernel.host.now())
        self._send()

    def _found(self, fact: Fact, peer: str) -> None:
        if fact.owner:
            task_id = str(fact.task_id)
            self._sought.pop(task_id, None)
            self._forwarded(ForwardTo(task_id, fact.owner, fact.epoch.n), peer)

    # Sending ---------------------------------------------------------------------------------------------------

    def _send(self) -> None:
        unsent = self._outbox.take_unsent()
        for it in unsent:
            if isinstance(it, Seek):
                self._seek(it.task_id)
            else:
                self._say(it.peer, it.letter)
        if unsent and not self._looking:
            self._look_later()

    def _seek(self, task_id: str) -> None:
        asked = TaskId.parse(task_id)
        record = self._records.get(asked)
        if record is not None and not record.unborn:
            self._found(fact_of(record), self.agent)
        for peer in asked_now(self._mesh.neighbours(), self.kernel.host.now()):
            try:
                self.publish(NETWORK, WhoHas((asked,)), to=join(peer, REGISTRAR))
            except PancakesError as error:
                self.log("debug", f"{peer} was not asked about {task_id}: {error}")
        self._sought = {it: times for it, times in self._sought.items() if it in self._outbox.waiting()}
        self._sought[task_id] = times = self._sought.get(task_id, 0) + 1
        if times == SOUGHT_IN_VAIN:
            self.log(
                "warning", f"packets for {task_id} wait: no agent that is linked has that task{self._near(task_id)}"
            )

    def _near(self, task_id: str) -> str:
        """Returns which task may be meant by one that no agent has, as the end of a sentence."""
        birthplace, _, name = task_id.partition("/")
        agents = [self.agent, *self._mesh.connected()]
        if birthplace in agents:
            return did_you_mean(task_id, [str(it) for it in self._records.all() if it.birthplace == birthplace])
        return did_you_mean(task_id, [join(agent, name) for agent in agents])

    def _look_later(self) -> None:
        self._looking = True
        self.after_host(RESEND_S / 2, self._look)

    def _look(self) -> None:
        """Sends again what was not acknowledged for too long."""
        self._outbox.look(self.kernel.host.now())
        self._looking = False
        if self._outbox.waiting():
            self._look_later()
        self._send()

    def _service_of(self, task_id: TaskId) -> Reference | None:
        """Return the service here that has a record of a task, if it runs. Any thread."""
        service = self._records.service_of(task_id)
        return self.kernel.actor(service) if service else None
