"""Read the records of an MCAP file, also of one that was cut off or damaged."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, Final

from mcap.exceptions import McapError
from mcap.records import Chunk, McapRecord, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk

from pancakes.recording.records import RecordingError
from pancakes.util.files import check_plain
from pancakes.util.runtime_dir import is_locked

MOST_BYTES: Final = 128 << 20
"""The largest record of a file, and the largest unpacked chunk: packets have at most 16 MiB."""
READ_ERRORS: Final = (McapError, ValueError, KeyError, OverflowError, OSError, struct.error)
"""The errors of reading a file that was cut off, is torn, or was never a recording."""


@dataclass
class Damage:
    """Unreadable parts between readable records.

    Attributes:
        chunks: the number of chunks.
        size_bytes: their size.
    """

    chunks: int = 0
    size_bytes: int = 0


def records_of(file: BinaryIO, damage: Damage) -> Iterator[McapRecord]:
    """Yield the records of a file, also those in chunks. A damaged chunk is left out and counted.

    Raises:
        READ_ERRORS: the file ends here, complete or not.
    """
    for record in StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=MOST_BYTES).records:
        if not isinstance(record, Chunk):
            yield record
            continue
        try:
            inside = breakup_chunk(_unpacked(record), validate_crc=True)
        except Exception:  # a decompressor may raise anything; the next chunk can still be read
            damage.chunks += 1
            damage.size_bytes += len(record.data)
        else:
            yield from inside


def _unpacked(chunk: Chunk) -> Chunk:
    """Return a chunk without compression. Its stated size is not trusted: a few bytes may expand to gigabytes.

    Raises:
        ValueError: it is larger than any chunk that a recorder writes.
        Exception: a decompressor may raise anything.
    """
    if chunk.uncompressed_size > MOST_BYTES:
        raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
    if chunk.compression == "zstd":
        import zstandard

        unpacker = zstandard.ZstdDecompressor(max_window_size=MOST_BYTES).stream_reader(chunk.data)
        data = unpacker.read(chunk.uncompressed_size + 1)
    elif chunk.compression == "lz4":
        import lz4.frame  # type: ignore[import-untyped]

        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=chunk.uncompressed_size + 1)
    else:
        return chunk
    if len(data) != chunk.uncompressed_size:
        raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes has others")
    return replace(chunk, compression="", data=data)


def metadata_of(file: BinaryIO) -> Iterator[Metadata]:
    """Yield the metadata records of a file up to its damaged part; other records are skipped."""
    with suppress(*READ_ERRORS):
        for record in StreamReader(file, emit_chunks=True, record_size_limit=MOST_BYTES).records:
            if isinstance(record, Metadata):
                yield record


def opened(path: Path) -> BinaryIO:
    """Open a file of a recording.

    Raises:
        RecordingError: it cannot be read.
    """
    try:
        check_plain(path)
        return path.open("rb")
    except OSError as error:
        raise RecordingError(f"the recording {path} cannot be read: {error.strerror or error}") from None


def is_being_written(file: BinaryIO) -> bool:
    """Return whether a recorder has this file open: it locks the file while it runs."""
    with suppress(OSError):  # this file system knows no locks
        return is_locked(file)
    return False
