"""All that the tasks of one agent send to tasks, wherever these are: a stream for each sender. Pure.

A task that sends takes its stream along when it moves, with what was not acknowledged, so that what it sends from its
new host comes after what it sent from the old one.
"""

from __future__ import annotations

from collections.abc import Iterator
from hashlib import blake2s

from msgspec.structs import replace

from pancakes.mesh.migration.post import ForwardTo, LostLetters, Outgoing, Receipt, StreamsBegan, ToSend
from pancakes.mesh.migration.record import TaskId
from pancakes.mesh.migration.snapshot import Posted


class Outbox:
    """The streams of one agent.

    A stream to which no task adds any more, because its task has gone on in another one, is kept until all of it is
    acknowledged. What a task sends on its way out (a thread of its own, its `on_stop`) goes in the common stream: of
    streams of its own, one for each move, there would be ever more where no agent acknowledges them.

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
        self._common = self._begin(name)
        self._streams: dict[str, Outgoing] = {self._common.stream: self._common}
        self._named: dict[str, Outgoing] = {}  # by what they are called in letters
        self._of: dict[str, Outgoing] = {}  # the streams that tasks add to, by the sender's id
        self._left: dict[str, Outgoing | None] = {}  # those of tasks that stand still for a hand-off
        self._ending: set[str] = set()  # tasks that have left for good, and whose actor has not ended

    def post(self, sender: str, task_id: TaskId, packet: bytes, host: str, now_s: float) -> list[ToSend]:
        """Takes a packet, and returns what is to be sent now.

        Args:
            sender: the task that sends it, as `birthplace/name`; empty: the sender does not move.
            task_id: the task that it is for.
            packet: the packet, as the wire writes it.
            host: where that task is, as far as is known; used for the first packet of this sender to it only.
            now_s: host time.

        Raises:
            MailboxFull: too many of this sender wait for this task already.
        """
        stream = self._stream_of(sender)
        follows = stream.post(task_id, packet, host, now_s)
        self._named[stream.name_for(str(task_id))] = stream
        return follows

    def host_of(self, sender: str, task_id: TaskId) -> str:
        """Returns where a task is thought to be; empty: nothing that is kept here was ever sent to it."""
        own = self._stream_of(sender).host_of(task_id)
        if own is not None:
            return own[1]
        known = [found for stream in self._streams.values() if (found := stream.host_of(task_id)) is not None]
        return max(known)[1] if known else ""

    def acknowledged(self, receipt: Receipt, peer: str, now_s: float) -> list[ToSend]:
        """Forgets what has had its effect, and returns what may follow."""
        stream = self._named.get(receipt.stream)
        if stream is None:
            return []
        follows = stream.acknowledged(receipt, peer, now_s)
        self._drop_done(stream)
        return follows

    def unsure_of(self, task_id: str, epoch_n: int) -> tuple[str, ...]:
        """Returns the streams, as letters to a task name them, whose letters may be lost now that an epoch owns it."""
        streams = self._streams.values()
        return tuple(stream.name_for(task_id) for stream in streams if stream.is_unsure_of(task_id, epoch_n))

    def began(self, news: StreamsBegan, peer: str) -> None:
        """Learns from what state a task began where it is now."""
        for stream in self._streams.values():
            stream.began(news, peer)

    def take_lost(self) -> list[LostLetters]:
        """Returns what is known to be lost, and forgets it."""
        senders = {stream.stream: sender for sender, stream in self._of.items()}
        return [
            replace(lost, sender=senders.get(name, ""))
            for name, stream in self._streams.items()
            for lost in stream.take_lost()
        ]

    def forwarded(self, news: ForwardTo, peer: str, now_s: float) -> list[ToSend]:
        """Learns of a peer where a task has gone, and returns what waits for it."""
        return [dispatch for stream in self._streams.values() for dispatch in stream.forwarded(news, peer, now_s)]

    def due(self, now_s: float) -> list[ToSend]:
        """Returns what is to be sent again."""
        return [dispatch for stream in self._streams.values() for dispatch in stream.due(now_s)]

    def waiting(self) -> dict[str, int]:
        """Returns how many packets wait for their acknowledgement, by the task that they are for."""
        waiting: dict[str, int] = {}
        for stream in self._streams.values():
            for task_id, count in stream.waiting().items():
                waiting[task_id] = waiting.get(task_id, 0) + count
        return waiting

    # A sender that moves ---------------------------------------------------------------------------------------

    def leave(self, sender: str) -> Posted | None:
        """A sender stands still and is about to leave: returns its stream, to which nothing may be added from now on.

        What is in it is sent all the same: its new host will send it again under the same numbers.
        """
        if sender not in self._left:
            self._left[sender] = self._of.pop(sender, None)
        stream = self._left[sender]
        return stream.posted() if stream is not None else None

    def stay(self, sender: str) -> None:
        """It does not leave after all, and goes on with its stream."""
        stream = self._left.pop(sender, None)
        if stream is not None:
            self._of[sender] = stream

    def gone(self, sender: str, ends: bool = False) -> None:
        """It has left for good, with its stream; `ends`: its actor is still to end here, and `ended` is to follow."""
        stream = self._left.pop(sender, None)
        if stream is not None:
            self._forget(stream)
        if ends:
            self._ending.add(sender)

    def ended(self, sender: str) -> None:
        """Nothing of a sender that has left runs here any more."""
        self._ending.discard(sender)

    def arrive(self, sender: str, posted: Posted | None, fresh: bool) -> None:
        """A sender begins from a snapshot.

        Args:
            sender: the task.
            posted: the stream that is in the snapshot.
            fresh: whether nothing of it has run since; else numbers may have been given out that the snapshot does not
                know of, so that only what is in it may be sent again, and the task begins a new stream.
        """
        self._ending.discard(sender)
        if not fresh and sender in self._of:
            return  # it failed and begins anew: its stream has never left
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
