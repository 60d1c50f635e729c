"""A task as data: the format of checkpoints and of tasks that migrate, and the pieces in which it travels. Pure.

A snapshot never contains code. The receiver finds the class by the name of its entry point, builds the task dormant,
and checks each value. Unread packets from channels and pending ticks stay behind on purpose: they belong to the old
host.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import msgspec
from msgspec.structs import replace

from pancakes.durable.messages import Piece, Solicit
from pancakes.durable.record import TaskId
from pancakes.durable.register import Stamp
from pancakes.errors import MigrationError, RemoteProtocolError
from pancakes.mesh.codec import of_agent
from pancakes.migration import CostChoice, GuardRule, MigrationRule, is_of_core
from pancakes.settings import dotted
from pancakes.supervision.restart import RestartSpec
from pancakes.util import codecs
from pancakes.util.arrays import array_from_extension, saved_array
from pancakes.util.codecs import MALFORMED, sha256, why_malformed

LIMIT_BYTES: Final = 16 * 1024 * 1024
"""The largest snapshot that travels."""
OFFER_BYTES: Final = 4096
"""The most bytes of its settings and its state that a task tells bidders: each of them gets it."""


class PostedTo(msgspec.Struct, frozen=True):
    """What the task has sent to another task.

    Attributes:
        task_id: that task, as `birthplace/name`.
        host: where that task is thought to be.
        epoch_n: how many migrations that news knows of.
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

    def of_agent(self, agent: str, restamped: Callable[[str, float], float]) -> Posted:
        """Return it as sent from an agent to which the task has migrated; see `pancakes.mesh.codec.of_agent`."""
        to = [replace(it, packets=tuple(of_agent(one, agent, restamped) for one in it.packets)) for it in self.to]
        return replace(self, to=tuple(to))


class KeptAnswer(msgspec.Struct, frozen=True):
    """An answer that is not handed over yet.

    Attributes:
        body: the answer, as plain values.
        code, text: why there is none; empty: there is one.
    """

    body: Any = None
    code: str = ""
    text: str = ""


class AskedRequest(msgspec.Struct, frozen=True):
    """A request that the task has made, and whose answer it has not taken.

    Attributes:
        source, seq: which packet it went in.
        to: the task that was asked.
        type: the packet type of the request.
        timeout_s: after how long it is called off, in mission seconds.
        left_s: how much of that is left.
        then: the name of the method that takes the answer; empty: a coroutine awaits it, which does not migrate.
        feedback: the name of the method that takes the feedback; empty: none does.
        heard: the number of the last feedback that has come.
        answer: what has come; None: nothing yet.
    """

    source: str
    seq: int
    to: str
    type: str
    timeout_s: float
    left_s: float
    then: str = ""
    feedback: str = ""
    heard: int = 0
    answer: KeptAnswer | None = None

    @property
    def key(self) -> tuple[str, int]:
        """Its source and number."""
        return self.source, self.seq


class OpenRequest(msgspec.Struct, frozen=True):
    """A request that the task was asked and has not answered.

    Attributes:
        source, seq: which packet it came in.
        reply_to: where the answer goes.
        type: the packet type of the request.
        body: the request, as plain values.
        left_s: after how long no answer is wanted any more, in mission seconds.
        later: whether the task answers it by a `Pending`; else its method begins again.
        told: how often feedback was given.
        cancelled: whether no answer is wanted any more, and the task has not been told yet.
        answer: what could not be sent yet; None: nothing.
    """

    source: str
    seq: int
    reply_to: str
    type: str
    body: Any
    left_s: float
    later: bool = False
    told: int = 0
    cancelled: bool = False
    answer: KeptAnswer | None = None

    @property
    def key(self) -> tuple[str, int]:
        """Its source and number."""
        return self.source, self.seq


class CarriedRequests(msgspec.Struct, frozen=True):
    """The open requests of a task.

    Attributes:
        asked: those that it has made.
        open: those that it was asked.
    """

    asked: tuple[AskedRequest, ...] = ()
    open: tuple[OpenRequest, ...] = ()


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
        periods_s: the period of each of its periodic handlers, as last rescheduled; infinity if it was paused.
        posted: the packets that it has sent to other tasks; None in a checkpoint, or if there are none.
        heard: the duplicate filter: up to which number every packet had its effect, by stream.
        restart: its restart policy, as in `[task.NAME] restart`.
        durability: `lazy` or `each`.
        migrate: its rule for moving, as in `[task.NAME] migrate`; None: it has none.
        guard: how it is guarded; None: it is not.
        rate_hz: the rate that its configuration gave its first timer; None: as its class says.
        created: whether no configuration file names it.
        offers: the fields of its state that bidders are told.
        requests: its open requests; None: it has none.
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
    requests: CarriedRequests | None = None

    def offer(self) -> bytes:
        """Return what bidders are told of it: its settings, and what it offers of its state; see `offer_of`.

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

    def solicit(self, ask: int, cost: CostChoice, rule: MigrationRule | None, tells: bool = True) -> Solicit:
        """Return what agents are asked that may take the task.

        Args:
            ask: number of this asking.
            cost: name of the cost function to use, or the weight of each of several.
            rule: when the task migrates by itself; None: it does not.
            tells: whether a cost function that is none of the core's is told of the task.

        Raises:
            MigrationError: what it offers is more than may be told.
        """
        return Solicit(
            self.task_id,
            ask,
            self.type,
            self.version,
            self.service,
            self.requires,
            cost,
            rule.least_level if rule is not None else None,
            self.offer() if tells and not is_of_core(cost) else b"",
            least_reserve_s=rule.least_reserve_s if rule is not None else None,
        )

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
"""What snapshots from before version 0.1.0 called the policies of restarts."""


def _in_words_of_today(snapshot: Snapshot) -> Snapshot:
    if snapshot.guard is not None and "guard" in snapshot.guard:  # what it called the number of copies
        rule = dict(snapshot.guard)
        snapshot = replace(snapshot, guard={"copies": rule.pop("guard"), **rule})
    policy = snapshot.restart.get("policy")  # which nobody has checked yet
    if not isinstance(policy, str) or policy not in _POLICIES:
        return snapshot
    return replace(snapshot, restart={**snapshot.restart, "policy": _POLICIES[policy]})


def why_unwritable(settings: Mapping[str, Any], state: Mapping[str, Any], error: Exception) -> str:
    """Returns why settings and state cannot be written: which value is at fault, and what is wrong with it.

    Args:
        settings: the settings, as plain values.
        state: the state, as plain values.
        error: what was raised when they were encoded.
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
"""At most this many snapshots of one peer are on their way at a time, ..."""
MOST_BYTES: Final = 2 * LIMIT_BYTES
"""... and this many bytes of them."""


def cut(task_id: TaskId, stamp: Stamp, whole: bytes) -> list[Piece]:
    """Return the pieces of a state that a write has, in order; at least one."""
    starts = range(0, max(len(whole), 1), PIECE_BYTES)
    fingerprint = digest(whole)
    return [
        Piece(
            task_id,
            stamp,
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

    def add(self, peer: str, piece: Piece) -> bytes | None:
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
        if parts is None or parts.peer != peer or piece.stamp > parts.stamp:
            self._make_room(peer, piece)
            parts = self._parts[piece.task_id] = _Parts(peer, piece)
        elif piece.stamp < parts.stamp:
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
        return whole

    def _make_room(self, peer: str, first: Piece) -> None:
        """Forget what came first of a peer's that is not whole: it sends one after the other, so the rest is lost."""
        others = [task_id for task_id, parts in self._parts.items() if parts.peer == peer and task_id != first.task_id]
        size = sum(self._parts[task_id].size_bytes for task_id in others) + first.size_bytes
        while others and (len(others) >= MOST_HALF or size > MOST_BYTES):
            size -= self._parts.pop(others.pop(0)).size_bytes

    def has(self, task_id: TaskId) -> bool:
        """Return whether something has come in of a task."""
        return task_id in self._parts

    def drop(self, peer: str) -> None:
        """Forgets what has come in so far from a peer whose link broke."""
        self._parts = {task_id: parts for task_id, parts in self._parts.items() if parts.peer != peer}


class _Parts:
    """What has come in of one offer."""

    def __init__(self, peer: str, first: Piece) -> None:
        self.peer = peer
        self.stamp: Stamp = first.stamp
        self.size_bytes = first.size_bytes
        self.digest = first.digest
        self.data: dict[int, bytes] = {}


class Rules(NamedTuple):
    """How a task moves and is guarded.

    Attributes:
        move: when it moves by itself; None: it does not.
        guard: how it is guarded; None: it is not.
    """

    move: MigrationRule | None
    guard: GuardRule | None


def rules_of(encoded: bytes, task_id: TaskId) -> tuple[Snapshot, Rules]:
    """Reads a snapshot that another agent has kept, and what it says of its task.

    Raises:
        MigrationError: it cannot be read, or is of another task.
    """
    snapshot = Snapshot.decode(encoded)
    if snapshot.task_id != task_id:
        raise MigrationError(f"the snapshot is of {snapshot.task_id}, not of {task_id}")
    try:
        move = codecs.convert(snapshot.migrate, MigrationRule) if snapshot.migrate is not None else None
        guard = codecs.convert(snapshot.guard, GuardRule) if snapshot.guard is not None else None
        if snapshot.restart:
            codecs.convert(snapshot.restart, RestartSpec)
    except msgspec.ValidationError as error:
        raise MigrationError(f"the snapshot of {task_id} is malformed: {error}") from None
    return snapshot, Rules(move, guard)
