"""The write-ahead file of a journal: batches of entries one after the other, each sealed as a whole. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import msgspec

from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.digest import sha256
from pancakes.runtime.foundation.malformed import MALFORMED
from pancakes.runtime.journal.seal import JournalEntry, JournalError

WRITE_AHEAD: Final = "journal.wal"
"""The name of the file."""
_MAGIC: Final = b"PNCKWAL1"
_LENGTH_BYTES: Final = 8
_DIGEST_BYTES: Final = 32
_HEAD_BYTES: Final = len(_MAGIC) + _LENGTH_BYTES + _DIGEST_BYTES


class Batch(msgspec.Struct, frozen=True, array_like=True):
    """What was written in one go.

    Attributes:
        journal: the id of the journal that has written it.
        entries: the entries.
    """

    journal: str
    entries: tuple[JournalEntry, ...]


class WrittenAhead(NamedTuple):
    """What a write-ahead file says.

    Attributes:
        batches: the batches, up to the first that cannot be believed.
        damaged: whether whole ones follow that. Else the machine died while the last one was written, which no caller
            was told of.
    """

    batches: Sequence[Batch]
    damaged: bool


_DECODE: Final = codecs.decoder(Batch)


def seal_batch(journal: str, entries: Sequence[JournalEntry]) -> bytes:
    """Returns a batch as it is appended to the file.

    Raises:
        JournalError: there is no memory for it.
    """
    try:
        body = codecs.encode(Batch(journal, tuple(entries)))
    except MemoryError as error:
        raise JournalError(f"{len(entries)} entries of the journal cannot be written: {error}") from None
    return b"".join((_MAGIC, len(body).to_bytes(_LENGTH_BYTES, "big"), sha256(body), body))


def read_ahead(data: bytes) -> WrittenAhead:
    """Reads a write-ahead file."""
    batches, at = [], 0
    while found := _batch_at(data, at):
        batch, at = found
        batches.append(batch)
    return WrittenAhead(batches, any(_batch_at(data, later) is not None for later in _marks(data, at + 1)))


def _batch_at(data: bytes, at: int) -> tuple[Batch, int] | None:
    """Returns the batch that begins at a byte, and where the next one would; None: no whole one begins there."""
    head = data[at : at + _HEAD_BYTES]
    if not head.startswith(_MAGIC) or len(head) < _HEAD_BYTES:
        return None
    length = int.from_bytes(head[len(_MAGIC) : len(_MAGIC) + _LENGTH_BYTES], "big")
    begin = at + _HEAD_BYTES
    body = data[begin : begin + length]
    if len(body) < length or sha256(body) != head[-_DIGEST_BYTES:]:
        return None
    try:
        return _DECODE(body), begin + length
    except MALFORMED:
        return None


def _marks(data: bytes, at: int) -> Iterator[int]:
    """Returns where batches may begin, from a byte on."""
    while (at := data.find(_MAGIC, at)) >= 0:
        yield at
        at += 1
