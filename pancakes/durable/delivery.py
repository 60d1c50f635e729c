"""Reliable delivery of packets to tasks wherever they run: numbered streams, receipts and duplicate filters. Pure.

A sender keeps each letter until it is acknowledged, and sends it again until then, in order. The receiver takes only
the next letter of each stream, so a late, doubled or reordered letter has no second effect and overtakes nothing. If
the task has migrated, the agent that had it names the new one, and the sender sends the letter there itself: each
agent speaks only for itself (docs/protocol.md, letters). A task that sends letters takes its stream along when it
migrates.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, Final, NamedTuple

import msgspec

from pancakes.durable.record import TaskId
from pancakes.durable.snapshot import Posted, PostedTo
from pancakes.errors import MailboxFullError
from pancakes.packet import Packet, agent_of, packet_type
from pancakes.util.codecs import blake2s

WINDOW: Final = 1024
"""Most letters to one task that wait for their acknowledgement."""
WINDOW_BYTES: Final = 4 * 1024 * 1024
"""Most bytes of these letters; one may always wait. A sender that moves takes them along, in its snapshot."""
IN_FLIGHT: Final = 64
"""Most letters to one task that are on their way at once; the others wait until one of these is acknowledged."""
RESEND_S: Final = 0.3
"""First pause before what is on its way is sent again, in host time; it doubles ..."""
LONGEST_S: Final = 2.4
"""... up to this; from then on neighbours are asked, because the agent that knew where the task is may be gone."""
ASKED: Final = 16
"""How many neighbours are asked at a time; of more, each in its turn, so that unused links may end all the same."""
STREAMS: Final = 1024
"""Most streams that a task's duplicate filter remembers; of more, the one not heard from for longest is forgotten."""
MOST_OF_SENDER: Final = STREAMS // 2
"""At most this many of them are of one agent: one that begins stream after stream has only its own forgotten."""
StreamName = Annotated[str, msgspec.Meta(max_length=512)]
MOST_STREAMS: Final = 1024
"""An owner is asked about at most this many streams at once; of the others nothing is known to be lost."""


class PacketId(NamedTuple):
    """Names a packet that its sender keeps until it is acknowledged: its stream, and its number there."""

    stream: str
    seq: int


@packet_type("post.letter")
class Letter(msgspec.Struct, frozen=True):
    """A packet on its way to a task.

    Attributes:
        task_id: the task, as `birthplace/name`.
        stream: the sender's stream as this task's agent knows it, see `name_to`; it moves with a task that sends. A
            sender that lost its memory begins a new one.
        seq: number in that stream, to this task, from 1.
        first: the lowest number that was not acknowledged when this was sent; nothing before it comes again.
        packet: the packet, as the wire writes it.
        sender: the agent that sends it, and wants to hear what became of it.
    """

    task_id: str
    stream: StreamName
    seq: int
    first: int
    packet: bytes
    sender: str


@packet_type("post.receipt")
class Receipt(msgspec.Struct, frozen=True):
    """Says that every letter of a stream up to `seq` has had its effect.

    Attributes:
        task_id: the task.
        stream: the stream.
        seq: up to which number.
        epoch_n: how many migrations the task has behind it; the task is with the sender of this.
        began_n: the number of the epoch under which the task began there from a snapshot; -1: that is not known.
        began_seq: up to which letter of the stream that snapshot has the effects; -1: that is not known.
        began_life: tells its beginnings under one epoch apart: each later one, after a crash of its agent, is higher.
    """

    task_id: str
    stream: str
    seq: int
    epoch_n: int
    began_n: int = -1
    began_seq: int = -1
    began_life: int = 0


@packet_type("post.when")
class AskBegan(msgspec.Struct, frozen=True):
    """Asks the agent that says that it owns a task from what state it began there; answered by `StreamsBegan`.

    Attributes:
        task_id: the task.
        streams: the streams in which the agent that asks has sent it letters.
    """

    task_id: str
    streams: Annotated[tuple[StreamName, ...], msgspec.Meta(max_length=MOST_STREAMS)]


@packet_type("post.streams_began")
class StreamsBegan(msgspec.Struct, frozen=True):
    """Says from what state a task began on its agent, so that its senders know what was lost with the last one.

    Attributes:
        task_id: the task.
        began_n: as in `Receipt`.
        upto: the `began_seq` of each stream that was asked for, as in `Receipt`.
        began_life: as in `Receipt`.
    """

    task_id: str
    began_n: int
    upto: dict[str, int]
    began_life: int = 0


@packet_type("post.forward_to")
class ForwardTo(msgspec.Struct, frozen=True):
    """Says that the task is not here, and which agent has it as far as is known here.

    Attributes:
        task_id: the task.
        peer: the agent to try.
        epoch_n: how many migrations that news knows of; older news never replaces newer.
    """

    task_id: str
    peer: str
    epoch_n: int


UNKNOWN: Final = (-1, 0)


class _Correspondence(msgspec.Struct):
    """All that goes to one task in one stream.

    Attributes:
        name: what the stream is called in letters to this task.
        host: where the task is thought to be.
        epoch_n: how fresh that is.
        packets: what is not acknowledged, by number.
        size_bytes: how much they take.
        next_seq: number of the next letter.
        in_flight: how many of `packets`, from the first on, have been sent.
        due_s: when these are sent again.
        pause_s: how long that is put off the next time.
        began: `began_n` and `began_life` of the agent that has acknowledged last; `UNKNOWN`: none has.
    """

    name: str
    host: str
    epoch_n: int = -1
    packets: OrderedDict[int, bytes] = msgspec.field(default_factory=OrderedDict)
    size_bytes: int = 0
    next_seq: int = 1
    in_flight: int = 0
    due_s: float = 0.0
    pause_s: float = RESEND_S
    began: tuple[int, int] = UNKNOWN

    @property
    def acknowledged(self) -> int:
        """Up to which number all was acknowledged."""
        return self.next_seq - len(self.packets) - 1


class LostLetters(msgspec.Struct, frozen=True):
    """Letters that were acknowledged, and whose effect the state does not have that the task began from since.

    Attributes:
        task_id: the task that they were for.
        first: the number of the first one.
        last: that of the last one.
        peer: the agent that has the task now.
        sender: the task that has sent them, as `birthplace/name`; empty: the sender does not move.
    """

    task_id: str
    first: int
    last: int
    peer: str
    sender: str = ""


class OutgoingLetter(msgspec.Struct, frozen=True):
    """What to send, and to which agent.

    Attributes:
        peer: the agent.
        letter: the letter.
    """

    peer: str
    letter: Letter


class Seek(msgspec.Struct, frozen=True):
    """Ask this agent and neighbours (`asked_now`) which one has a task: the one that had it does not answer.

    They are not sent the letters, which are for that agent only.

    Attributes:
        task_id: the task, as `birthplace/name`.
    """

    task_id: str


ToSend = OutgoingLetter | Seek


def name_to(stream: str, task_id: str) -> str:
    """Returns what a stream is called in letters to one task.

    Only an agent that gets these letters may learn it. Another that knew it could send a letter of that name to the
    task, and the sender's own would be taken for old ones: acknowledged, without effect.

    Args:
        stream: `NAME#SECRET`; the name is for people.
        task_id: the task, as `birthplace/name`.
    """
    name, _, secret = stream.partition("#")
    if not secret:
        return stream  # it comes from a state directory of before, and is known by this name
    return f"{name}#{blake2s(task_id.encode(), key=secret.encode(), digest_size=12).hexdigest()}"


def asked_now(neighbours: Sequence[str], now_s: float) -> Sequence[str]:
    """Returns the neighbours that are asked now where a task is; at one time they are the same for all tasks."""
    if len(neighbours) <= ASKED:
        return neighbours
    first = int(now_s / LONGEST_S) * ASKED % len(neighbours)
    return [*neighbours, *neighbours][first : first + ASKED]


class Outgoing:
    """The letters of one stream that are not acknowledged.

    Args:
        stream: its name, that no other stream ever had, and its secret; see `name_to`.
        agent: the agent that sends them.
    """

    def __init__(self, stream: str, agent: str) -> None:
        self.stream = stream
        self._agent = agent
        self._to: dict[str, _Correspondence] = {}
        self._lost: list[LostLetters] = []

    @classmethod
    def of(cls, posted: Posted, agent: str) -> Outgoing:
        """Returns the stream as its sender took it along; what it has not been told of is sent again."""
        stream = cls(posted.stream, agent)
        for to in posted.to:
            first = to.next_seq - len(to.packets)
            packets = OrderedDict(enumerate(to.packets, first))
            size = sum(map(len, to.packets))
            name = name_to(posted.stream, to.task_id)
            stream._to[to.task_id] = _Correspondence(
                name, to.host, to.epoch_n, packets, size, to.next_seq, began=(to.began_n, to.began_life)
            )
        return stream

    def posted(self) -> Posted:
        """Returns the stream for a sender that takes it along."""
        return Posted(
            self.stream,
            tuple(
                PostedTo(task_id, to.host, to.epoch_n, to.next_seq, tuple(to.packets.values()), *to.began)
                for task_id, to in self._to.items()
            ),
        )

    def names(self) -> Iterable[str]:
        """Returns what the stream is called in letters, by the task that they are for."""
        return [to.name for to in self._to.values()]

    def name_for(self, task_id: str) -> str:
        """Returns what the stream is called in letters to a task that something was sent to; empty: nothing was."""
        to = self._to.get(task_id)
        return to.name if to is not None else ""

    def host_of(self, task_id: TaskId) -> tuple[int, str] | None:
        """Returns how fresh the news is of where a task is, and where that is; None: nothing was ever sent to it."""
        to = self._to.get(str(task_id))
        return (to.epoch_n, to.host) if to is not None else None

    def post(self, task_id: TaskId, packet: bytes, host: str, now_s: float) -> list[ToSend]:
        """Take a packet, and return what to send now.

        Args:
            task_id: the task that it is for.
            packet: the packet, as the wire writes it.
            host: where the task is, as far as the caller knows; used for the first packet to this task only.
            now_s: host time.

        Raises:
            MailboxFullError: too many wait for this task already.
        """
        to = self._to.get(str(task_id))
        if to is None:
            to = self._to[str(task_id)] = _Correspondence(name_to(self.stream, str(task_id)), host)
        if len(to.packets) >= WINDOW or (to.packets and to.size_bytes + len(packet) > WINDOW_BYTES):
            raise MailboxFullError(
                f"{len(to.packets)} packets for the task {task_id} ({to.size_bytes} bytes) wait for their"
                " acknowledgement already"
            )
        if not to.packets:
            to.pause_s = RESEND_S
            to.due_s = now_s + RESEND_S
        to.packets[to.next_seq] = packet
        to.size_bytes += len(packet)
        to.next_seq += 1
        return self._fill(str(task_id), to)

    def acknowledged(self, receipt: Receipt, peer: str, now_s: float) -> list[ToSend]:
        """Forgets what has had its effect, and returns what may follow.

        Only the agent that the letters went to is believed: of another, what it acknowledges is sent on to where the
        task is, whose filter knows it.
        """
        to = self._to.get(receipt.task_id)
        if to is None or receipt.stream != to.name or peer != to.host:
            return []
        self._began(receipt.task_id, to, (receipt.began_n, receipt.began_life), receipt.began_seq, peer)
        if receipt.epoch_n >= to.epoch_n:
            to.host, to.epoch_n = peer, receipt.epoch_n
        while to.packets and next(iter(to.packets)) <= receipt.seq:
            to.size_bytes -= len(to.packets.popitem(last=False)[1])
            to.in_flight = max(0, to.in_flight - 1)
            to.pause_s = RESEND_S
            to.due_s = now_s + RESEND_S
        return self._fill(receipt.task_id, to)

    def is_unsure_of(self, task_id: str, epoch_n: int) -> bool:
        """Returns whether what was acknowledged for a task may be lost, now that it is owned under an epoch.

        Under one epoch too: its agent may have crashed, and have begun from its last checkpoint.
        """
        to = self._to.get(task_id)
        return to is not None and to.acknowledged > 0 and 0 <= to.began[0] <= epoch_n

    def began(self, news: StreamsBegan, peer: str) -> None:
        """Learns from what state a task began where it is now."""
        to = self._to.get(news.task_id)
        if to is not None and to.name in news.upto:
            self._began(news.task_id, to, (news.began_n, news.began_life), news.upto[to.name], peer)

    def _began(self, task_id: str, to: _Correspondence, began: tuple[int, int], upto: int, peer: str) -> None:
        if began <= to.began:
            return
        first_time, to.began = to.began == UNKNOWN, began
        if not first_time and 0 <= upto < to.acknowledged:
            self._lost.append(LostLetters(task_id, upto + 1, to.acknowledged, peer))

    def take_lost(self) -> list[LostLetters]:
        """Returns what is known to be lost, and forgets it."""
        lost, self._lost = self._lost, []
        return lost

    def forwarded(self, news: ForwardTo, peer: str, now_s: float) -> list[ToSend]:
        """Learns of a peer where a task has gone, and returns what waits for it.

        Older news than what is known is ignored, and so is that of an agent that was not asked.
        """
        to = self._to.get(news.task_id)
        if to is None or (peer != to.host and to.pause_s < LONGEST_S):
            return []
        # Of one epoch there is one owner, whose own word is as good as a receipt of it.
        if news.epoch_n < to.epoch_n or (news.epoch_n == to.epoch_n and news.peer != peer):
            return []
        moved = news.peer != to.host
        to.host, to.epoch_n = news.peer, news.epoch_n
        if not moved or not to.packets:
            return []
        to.pause_s = RESEND_S
        return self._again(news.task_id, to, now_s)

    def due(self, now_s: float) -> list[ToSend]:
        """Return what to send again."""
        out: list[ToSend] = []
        for task_id, to in self._to.items():
            if not to.packets or to.due_s > now_s:
                continue
            lost = to.pause_s >= LONGEST_S
            out.extend(self._again(task_id, to, now_s))
            if lost:
                out.append(Seek(task_id))
            to.pause_s = min(2 * to.pause_s, LONGEST_S)
        return out

    def waiting(self) -> dict[str, int]:
        """Returns how many packets wait for their acknowledgement, by task."""
        return {task_id: len(to.packets) for task_id, to in self._to.items() if to.packets}

    def _again(self, task_id: str, to: _Correspondence, now_s: float) -> list[ToSend]:
        to.due_s = now_s + to.pause_s
        to.in_flight = 0
        return self._fill(task_id, to)

    def _fill(self, task_id: str, to: _Correspondence) -> list[ToSend]:
        """Returns what may be sent besides what is on its way."""
        if not to.packets:
            to.in_flight = 0
            return []
        first = next(iter(to.packets))
        sent = to.in_flight
        to.in_flight = min(len(to.packets), IN_FLIGHT)
        # The numbers of what is not acknowledged have no gap.
        return [
            OutgoingLetter(to.host, self._letter(task_id, to, seq)) for seq in range(first + sent, first + to.in_flight)
        ]

    def _letter(self, task_id: str, to: _Correspondence, seq: int) -> Letter:
        return Letter(task_id, to.name, seq, next(iter(to.packets)), to.packets[seq], self._agent)


def false_name(letter: Letter, packet: Packet | None, peer: str) -> str:
    """Returns the name in a letter that is another's than the peer's that brought it; empty: there is none.

    Args:
        letter: the letter.
        packet: the packet in it; None: it cannot be read.
        peer: the agent that brought it.
    """
    if letter.sender != peer:
        return letter.sender
    return packet.source if packet is not None and agent_of(packet.source) != peer else ""


class Incoming:
    """A task's duplicate filter: how far each stream has had its effect. It moves with the task.

    Args:
        heard: what it begins with, by stream.
    """

    __slots__ = ("_heard", "_of")

    def __init__(self, heard: Mapping[str, int] | None = None) -> None:
        self._heard = dict(heard or {})
        self._of: dict[str, dict[str, None]] = {}  # the streams of each agent, since it began here

    def is_next(self, stream: str, seq: int, first: int) -> bool:
        """Returns whether a letter is the next of its stream.

        What lies before `first` was acknowledged, and never comes again: a task that went back to an earlier
        checkpoint goes on from there.
        """
        return seq == max(self._heard.get(stream, 0) + 1, first)

    def is_old(self, stream: str, seq: int) -> bool:
        """Returns whether a letter has had its effect already."""
        return seq <= self._heard.get(stream, 0)

    def took(self, stream: str, seq: int, sender: str = "") -> None:
        """A letter of an agent has had its effect."""
        # To the end of the table, which is in the order in which they were heard.
        self._heard.pop(stream, None)
        self._heard[stream] = seq
        if sender:
            mine = self._of[sender] = self._of.pop(sender, {})
            mine.pop(stream, None)
            mine[stream] = None
            if len(mine) > MOST_OF_SENDER:
                self._heard.pop(_take_first(mine), None)
            if len(self._of) > STREAMS:
                _take_first(self._of)
        while len(self._heard) > STREAMS:
            del self._heard[next(iter(self._heard))]

    def heard(self) -> dict[str, int]:
        """Returns the whole filter, what was heard from last at its end."""
        return dict(self._heard)


def _take_first(table: dict[str, Any]) -> str:
    first = next(iter(table))
    del table[first]
    return first


# What other actors of an agent tell its courier, and it tells the services ------------------------------------------

COURIER: Final = "kernel/Courier"
"""Where on each agent the courier is."""


class CameFor(msgspec.Struct, frozen=True):
    """The courier tells a service that a packet has come for one of its tasks.

    Attributes:
        letter: the letter that it came in.
        packet: what is in it; None: it cannot be read here.
    """

    letter: Letter
    packet: Packet | None


class Say(msgspec.Struct, frozen=True):
    """Tell the courier of another agent something; it may be lost.

    Attributes:
        peer: the other agent.
        body: what to tell it.
    """

    peer: str
    body: Letter | Receipt | ForwardTo | StreamsBegan


class AskedBegan(msgspec.Struct, frozen=True):
    """The courier tells a service that another agent asks from what state one of its tasks began; answered by `Say`.

    Attributes:
        peer: the agent that asks.
        asked: what it asks.
    """

    peer: str
    asked: AskBegan


class SendUnsent(msgspec.Struct, frozen=True):
    """There is something in the outbox that was not sent yet."""
