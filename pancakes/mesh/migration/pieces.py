"""Snapshots cut into pieces that fit a frame, and put together again."""

from __future__ import annotations

from typing import Final

from pancakes.errors import RemoteProtocolError
from pancakes.mesh.migration.epoch import Epoch
from pancakes.mesh.migration.messages import Piece, Transfer
from pancakes.mesh.migration.record import TaskId
from pancakes.mesh.migration.snapshot import LIMIT_BYTES, digest

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
