"""What the tasks of an agent have sent to others and is not acknowledged, for all of its threads."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from msgspec.structs import replace

from pancakes.errors import LocalProtocolError, MigrationError
from pancakes.mesh.migration.claim import OwnerClaim
from pancakes.mesh.migration.outbox import Outbox
from pancakes.mesh.migration.post import (
    MOST_STREAMS,
    AskBegan,
    ForwardTo,
    LostLetters,
    Receipt,
    StreamsBegan,
    ToSend,
)
from pancakes.mesh.migration.record import TaskId
from pancakes.mesh.migration.snapshot import Posted
from pancakes.mesh.wire.codec import Encoder, of_agent
from pancakes.mesh.wire.framing import MAX_MESSAGE_BYTES
from pancakes.packet import TO_TASK, Packet

ENVELOPE_BYTES: Final = 1024
"""What a letter takes besides the packet in it, at most."""


class SharedOutbox:
    """An outbox that publishers fill, senders change as they move, and the courier empties. Any thread.

    Its lock is held for the outbox alone: no method calls anything outside.

    Args:
        outbox: what is not acknowledged.
    """

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._lock = threading.Lock()
        self._encoder = Encoder()
        self._unsent: list[ToSend] = []  # in the order in which they were numbered

    @property
    def name(self) -> str:
        """The name of this agent's own stream, with which the names of all its streams begin."""
        return self._outbox.name

    def post(self, packet: Packet, host: str, now_s: float) -> None:
        """Takes a packet whose destination is a task.

        Args:
            packet: the packet.
            host: where that task is, as far as is known; used for the first packet of this sender to it only.
            now_s: host time.

        Raises:
            LocalProtocolError: the packet cannot travel.
            MailboxFull: too many wait for this task already.
        """
        task_id = receiver_of(packet)
        sender = packet.fence.task_id if packet.fence is not None else ""
        with self._lock:
            data = self._encoder.packet(packet)
            if len(data) > MAX_MESSAGE_BYTES - ENVELOPE_BYTES:
                raise LocalProtocolError(
                    f"the packet {packet.number} of the type {packet.type!r} from {packet.source} takes {len(data)}"
                    f" bytes, and {MAX_MESSAGE_BYTES - ENVELOPE_BYTES} may be sent to a task"
                )
            host = self._outbox.host_of(sender, task_id) or host
            self._unsent += self._outbox.post(sender, task_id, data, host, now_s)

    def acknowledged(self, receipt: Receipt, peer: str, now_s: float) -> None:
        """Forgets what has had its effect."""
        with self._lock:
            self._unsent += self._outbox.acknowledged(receipt, peer, now_s)

    def unsure_of(self, claims: Iterable[OwnerClaim]) -> list[AskBegan]:
        """Returns what is to be asked of an agent that owns tasks: from what state each of them began there."""
        with self._lock:
            asked = [(str(it.task_id), self._outbox.unsure_of(str(it.task_id), it.epoch.n)) for it in claims]
        return [AskBegan(task_id, streams[:MOST_STREAMS]) for task_id, streams in asked if streams]

    def began(self, news: StreamsBegan, peer: str) -> None:
        """Learns from what state a task began where it is now."""
        with self._lock:
            self._outbox.began(news, peer)

    def take_lost(self) -> list[LostLetters]:
        """Returns what is known to be lost, and forgets it."""
        with self._lock:
            return self._outbox.take_lost()

    def forwarded(self, news: ForwardTo, peer: str, now_s: float) -> None:
        """Learns of a peer where a task has gone."""
        with self._lock:
            self._unsent += self._outbox.forwarded(news, peer, now_s)

    def look(self, now_s: float) -> None:
        """Looks for what was not acknowledged for too long: that is to be sent again."""
        with self._lock:
            self._unsent += self._outbox.due(now_s)

    def take_unsent(self) -> Sequence[ToSend]:
        """Returns what is to be sent now, in order, and forgets that."""
        with self._lock:
            unsent, self._unsent = self._unsent, []
        return unsent

    def waiting(self) -> dict[str, int]:
        """Returns how many packets wait for their acknowledgement, by the task that they are for."""
        with self._lock:
            return self._outbox.waiting()

    # A sender that moves ---------------------------------------------------------------------------------------

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

    def arrive(
        self,
        sender: TaskId,
        posted: Posted | None,
        fresh: bool,
        now_s: float,
        restamped: Callable[[str, float], float],
    ) -> None:
        """A task begins from a snapshot; `fresh`: nothing of it has run since that was taken.

        What it sent from another agent goes on from here under its address here, as no agent takes it otherwise, and
        with stamps of the mission time here; see `of_agent`.
        """
        if posted is not None:
            here = self._outbox.agent
            to = [
                replace(it, packets=tuple(of_agent(packet, here, restamped) for packet in it.packets))
                for it in posted.to
            ]
            posted = replace(posted, to=tuple(to))
        with self._lock:
            self._outbox.arrive(str(sender), posted, fresh)
            if posted is not None:
                self._unsent += self._outbox.due(now_s)


def receiver_of(packet: Packet) -> TaskId:
    """Returns the task that a packet is for.

    Raises:
        LocalProtocolError: its destination is no task's.
    """
    try:
        return TaskId.parse(packet.destination.removeprefix(TO_TASK))
    except MigrationError as error:
        raise LocalProtocolError(f"{packet.source} published {packet.type!r} to no task: {error}") from None
