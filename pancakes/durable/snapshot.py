"""A task as data: the format of checkpoints and of tasks that migrate, and the pieces in which it travels. Pure.

A snapshot never contains code. The receiver finds the class by the name of its entry point, builds the task dormant,
and checks each value. Unread packets from channels and pending ticks stay behind on purpose: they belong to the old
host.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import msgspec
from msgspec.structs import replace

from pancakes.durable.messages import Piece, Transfer
from pancakes.durable.record import Epoch, TaskId
from pancakes.errors import MigrationError, RemoteProtocolError
from pancakes.settings import dotted
from pancakes.util import codecs
from pancakes.util.arrays import array_from_extension, saved_array
from pancakes.util.codecs import MALFORMED, sha256, why_malformed

LIMIT_BYTES: Final = 16 * 1024 * 1024
"""The largest snapshot that travels."""
OFFER_BYTES: Final = 4096
"""So much of its settings and its state a task may tell bidders: each of them gets it."""


class PostedTo(msgspec.Struct, frozen=True):
    """What the task has sent to another task.

    Attributes:
        task_id: that task, as `birthplace/name`.
        host: where that task is thought to be.
        epoch_n: how many hand-offs that news knows of.
        next_seq: number of the next packet.
        packets: those that were not acknowledged, as the wire writes them: the last ones before `next_seq`.
        began_n, began_life: as in `post.Receipt`; -1: nothing was acknowledged.
    """

    task_id: str
    host: str
    epoch_n: int
    next_seq: int
    packets: tuple[bytes, ...]
    began_n: int
    began_life: int = 0


class Posted(msgspec.Struct, frozen=True):
    """The stream in which the task sends to other tasks: it takes it along, so that nothing overtakes anything.

    Attributes:
        stream: its name.
        to: what was sent, by receiver.
    """

    stream: str
    to: tuple[PostedTo, ...]


class Snapshot(msgspec.Struct, frozen=True):
    """One task at one moment.

    Settings and state are plain values: what msgpack can write, and numpy arrays.

    Attributes:
        task_id: the task's identity for life; its name on every host is `task_id.name`.
        type: name of its class's entry point, such as `encirclement.ScanTarget`.
        version: version of the distribution that the class comes from.
        service: the service that supervises it.
        requires: the device types that it depends on.
        settings: its settings.
        configured: the settings that its configuration gave it; what differs from these was changed while it ran.
        state: its state.
        periods_s: the period of each of its periodic handlers, as last rescheduled; infinity where it was paused.
        posted: the packets that it has sent to other tasks; None in a checkpoint, and where there are none.
        heard: the duplicate filter: up to which number every packet had its effect, by stream.
        restart: its restart policy, as in `[task.NAME] restart`.
        durability: `lazy` or `each`.
        migrate: its rule for moving, as in `[task.NAME] migrate`; None where it has none.
        guard: how it is guarded; None: it is not.
        rate_hz: the rate that its configuration gave its first timer; None: as its class says.
        created: whether no configuration file names it.
        offers: the fields of its state that bidders are told.
    """

    task_id: TaskId
    type: str
    version: str
    service: str
    requires: tuple[str, ...] = ()
    settings: dict[str, Any] = {}
    configured: dict[str, Any] = {}
    state: dict[str, Any] = {}
    periods_s: dict[str, float] = {}
    posted: Posted | None = None
    heard: dict[str, int] = {}
    restart: dict[str, Any] = {}
    durability: str = "lazy"
    migrate: dict[str, Any] | None = None
    guard: dict[str, Any] | None = None
    rate_hz: float | None = None
    created: bool = False
    offers: tuple[str, ...] = ()

    def offer(self) -> bytes:
        """Returns what bidders are told of it: its settings, and what it offers of its state; see `offer_of`.

        Raises:
            MigrationError: that is more than may be told.
        """
        data = _ENCODE((self.settings, {name: self.state[name] for name in self.offers if name in self.state}))
        if len(data) > OFFER_BYTES:
            raise MigrationError(
                f"the settings of {self.task_id} and what it offers of its state have {len(data)} bytes, and bidders"
                f" are told {OFFER_BYTES} at most"
            )
        return data

    def encode(self) -> bytes:
        """Returns the snapshot as msgpack bytes.

        Raises:
            MigrationError: a value cannot be written, or the whole is over `LIMIT_BYTES`.
        """
        try:
            data = _ENCODE(self)
        except codecs.UNENCODABLE as error:
            why = why_unwritable(self.settings, self.state, error)
            raise MigrationError(f"the task {self.task_id} cannot be written as a snapshot: {why}") from None
        if len(data) > LIMIT_BYTES:
            raise MigrationError(f"the snapshot of {self.task_id} has {len(data)} bytes, {LIMIT_BYTES} may travel")
        return data

    @classmethod
    def decode(cls, data: bytes) -> Snapshot:
        """Reads what `encode` wrote, checking each value's type.

        Raises:
            MigrationError: the bytes are no snapshot, or more than may travel.
        """
        if len(data) > LIMIT_BYTES:
            raise MigrationError(f"a snapshot of {len(data)} bytes was refused, {LIMIT_BYTES} may travel")
        try:
            return _in_words_of_today(_DECODE(data))
        except (*MALFORMED, RemoteProtocolError) as error:
            raise MigrationError(f"these {len(data)} bytes are no snapshot of a task: {why_malformed(error)}") from None


_ENCODE: Callable[[Any], bytes] = codecs.encoder(saved_array)
_DECODE_OFFER: Callable[[bytes], tuple[dict[str, Any], dict[str, Any]]] = codecs.decoder(
    tuple[dict[str, Any], dict[str, Any]], array_from_extension
)
_DECODE: Callable[[bytes], Snapshot] = codecs.decoder(Snapshot, array_from_extension)
_POLICIES: Final = {"permanent": "always", "transient": "on-failure", "temporary": "no"}
"""What snapshots that were kept before called the policies of restarts."""


def _in_words_of_today(snapshot: Snapshot) -> Snapshot:
    policy = snapshot.restart.get("policy")  # which nobody has checked yet
    if not isinstance(policy, str) or policy not in _POLICIES:
        return snapshot
    return replace(snapshot, restart={**snapshot.restart, "policy": _POLICIES[policy]})


def why_unwritable(settings: Mapping[str, Any], state: Mapping[str, Any], error: Exception) -> str:
    """Returns why settings and state cannot be written: which value is at fault, and what is wrong with it.

    Args:
        settings: the settings, as plain values.
        state: the state, as plain values.
        error: what was raised where they were encoded.
    """
    path = codecs.unencodable_in({"settings": settings, "state": state}, _ENCODE)
    return f"{dotted(path)}: {error}" if path else str(error)


def offer_of(data: bytes) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns what bidders are told of a task: its settings, and of its state what it offers.

    Raises:
        MigrationError: the bytes are no offer.
    """
    try:
        return _DECODE_OFFER(data) if data else ({}, {})
    except (*MALFORMED, RemoteProtocolError) as error:
        raise MigrationError(f"what is told of the task cannot be read: {why_malformed(error)}") from None


def digest(data: bytes) -> bytes:
    """Returns the content hash (SHA-256) by which an encoded snapshot is checked on arrival."""
    return sha256(data)


PIECE_BYTES: Final = 64 * 1024
"""How much of a snapshot travels in one packet."""
MOST_HALF: Final = 4
"""So many snapshots of one peer may be on their way at a time."""
MOST_BYTES: Final = 2 * LIMIT_BYTES
"""So many bytes these may have."""


def cut(transfer: Transfer) -> list[Piece]:
    """Returns the pieces of a snapshot, in order; at least one, also of an empty snapshot."""
    whole = transfer.snapshot
    starts = range(0, max(len(whole), 1), PIECE_BYTES)
    fingerprint = digest(whole)
    return [
        Piece(
            transfer.task_id,
            transfer.offer,
            index,
            len(starts),
            len(whole),
            fingerprint,
            whole[start : start + PIECE_BYTES],
        )
        for index, start in enumerate(starts)
    ]


class Assembly:
    """Puts the snapshots that arrive together again: for each task, the newest one from one peer.

    Pieces may come in any order and more than once. No more memory is taken than what has really come in,
    and limits are checked before a piece is kept.
    """

    def __init__(self) -> None:
        self._parts: dict[TaskId, _Parts] = {}

    def add(self, peer: str, piece: Piece) -> Transfer | None:
        """Takes a piece in.

        Returns:
            The whole, once its last piece has come; None before.

        Raises:
            RemoteProtocolError: the piece is impossible, or the whole does not have the hash that was named.
                What was gathered of that offer is dropped; the offer should be declined with this reason.
        """
        if not 0 <= piece.size_bytes <= LIMIT_BYTES:
            raise RemoteProtocolError(
                f"{peer} offers {piece.task_id} with a snapshot of {piece.size_bytes} bytes, {LIMIT_BYTES} may travel"
            )
        parts = self._parts.get(piece.task_id)
        if parts is None or parts.peer != peer or piece.offer > parts.offer:
            self._check_room(peer, piece)
            parts = self._parts[piece.task_id] = _Parts(peer, piece)
        elif piece.offer < parts.offer:
            return None
        count = -(-max(piece.size_bytes, 1) // PIECE_BYTES)
        length = min(PIECE_BYTES, piece.size_bytes - piece.index * PIECE_BYTES)
        fits = (piece.size_bytes, piece.digest) == (parts.size_bytes, parts.digest)
        if not fits or piece.count != count or not 0 <= piece.index < count or len(piece.data) != length:
            del self._parts[piece.task_id]
            raise RemoteProtocolError(
                f"piece {piece.index} of the snapshot of {piece.task_id} from {peer} does not fit the others"
            )
        parts.data[piece.index] = piece.data
        if len(parts.data) < count:
            return None
        del self._parts[piece.task_id]
        whole = b"".join(parts.data[index] for index in range(count))
        if digest(whole) != piece.digest:
            raise RemoteProtocolError(f"the snapshot of {piece.task_id} from {peer} was damaged on its way")
        return Transfer(piece.task_id, piece.offer, whole)

    def _check_room(self, peer: str, first: Piece) -> None:
        """Raises `RemoteProtocolError` where too many snapshots of a peer are on their way, or too large ones."""
        others = [parts for task_id, parts in self._parts.items() if parts.peer == peer and task_id != first.task_id]
        if len(others) >= MOST_HALF or sum(parts.size_bytes for parts in others) + first.size_bytes > MOST_BYTES:
            raise RemoteProtocolError(
                f"{peer} sends {first.task_id} while {len(others)} of its snapshots are on their way: at most"
                f" {MOST_HALF} may be, of {MOST_BYTES} bytes"
            )

    def has(self, task_id: TaskId) -> bool:
        """Returns whether something has come in of a task."""
        return task_id in self._parts

    def drop(self, peer: str) -> None:
        """Forgets what has come in so far from a peer whose link broke."""
        self._parts = {task_id: parts for task_id, parts in self._parts.items() if parts.peer != peer}

    def end(self, peer: str, task_id: TaskId) -> None:
        """Forgets what has come in so far of a task whose hand-over from a peer is decided."""
        parts = self._parts.get(task_id)
        if parts is not None and parts.peer == peer:
            del self._parts[task_id]


class _Parts:
    """What has come in of one offer."""

    def __init__(self, peer: str, first: Piece) -> None:
        self.peer = peer
        self.offer: Epoch = first.offer
        self.size_bytes = first.size_bytes
        self.digest = first.digest
        self.data: dict[int, bytes] = {}
