"""Writes an MCAP file chunk by chunk, quicker than mcap's own writer where it counts: for each message and chunk.

mcap's `Writer` makes an object and ten small writes of a message, which is most of what a recording costs its agent.
Here a message is one `struct` and its data, and a chunk one `struct` before its messages (a chunk of 100 messages takes
40 µs of processor time instead of 70); all other records, of which there are few, are mcap's.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from typing import BinaryIO, Final

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC: Final = b"\x89MCAP0\r\n"
_MESSAGE: Final = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, times of recording and publishing; the data follows."""
_MESSAGE_LENGTH: Final = _MESSAGE.size - 9
_CHUNK: Final = struct.Struct("<BQQQQIIQ")
"""Opcode, length, times of the first and the last message, size and checksum of what is in it, the length of the name
of its compression, which is none, and the size again; the messages follow."""
_CHUNK_LENGTH: Final = _CHUNK.size - 9
_INDEX: Final = struct.Struct("<BQHI")
_FOOTER: Final = struct.Struct("<BQQQ")
_FOOTER_LENGTH: Final = 20


class ChunkedFile:
    """An MCAP file that is being written, without compression: that costs more processor time than it saves disk.

    Args:
        file: where it goes to.
        library: who writes it.
        chunk_bytes: a chunk ends once it is larger than this.

    Raises:
        OSError: the disk is full, ...
    """

    def __init__(self, file: BinaryIO, library: str, chunk_bytes: int) -> None:
        self._file = file
        self._chunk_bytes = chunk_bytes
        self._chunk = bytearray()
        self._index: dict[int, list[int]] = {}
        self._counts: dict[int, int] = {}
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunk_indexes: list[ChunkIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._file.write(MAGIC + _record(Header("", library)))

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Adds what is to be known about the file."""
        data = _record(Metadata(name=name, metadata=dict(values)))
        self._metadata_indexes.append(MetadataIndex(offset=self._file.tell(), length=len(data), name=name))
        self._file.write(data)

    def add_schema(self, name: str, data: bytes) -> int:
        """Adds a JSON Schema; returns its number."""
        schema = Schema(id=len(self._schemas) + 1, data=data, encoding="jsonschema", name=name)
        self._schemas.append(schema)
        self._chunk += _record(schema)
        return schema.id

    def add_channel(self, topic: str, schema: int) -> int:
        """Adds a topic with messages in JSON; returns its number."""
        number = len(self._channels) + 1
        channel = Channel(id=number, topic=topic, message_encoding="json", schema_id=schema, metadata={})
        self._channels.append(channel)
        self._counts[number] = 0
        self._chunk += _record(channel)
        return number

    def add_message(self, channel: int, time_ns: int, data: bytes, sequence: int = 0) -> None:
        """Adds a message, published and recorded at the same time. Where writing fails, a later call writes it."""
        chunk = self._chunk
        index = self._index.get(channel)
        if index is None:
            index = self._index[channel] = []
        index += (time_ns, len(chunk))
        chunk += _MESSAGE.pack(Opcode.MESSAGE, _MESSAGE_LENGTH + len(data), channel, sequence, time_ns, time_ns)
        chunk += data
        if len(chunk) > self._chunk_bytes:
            self.end_chunk()

    def size_bytes(self) -> int:
        """Returns how large the file is so far."""
        return self._file.tell() + len(self._chunk)

    def end_chunk(self) -> None:
        """Writes what has been added into the file, which keeps a buffer of its own."""
        if not self._index:
            return  # a chunk without messages has no place in time
        size_bytes = len(self._chunk)
        begin_ns = min(min(index[::2]) for index in self._index.values())
        end_ns = max(max(index[::2]) for index in self._index.values())
        start, length = self._file.tell(), _CHUNK.size + size_bytes
        crc = zlib.crc32(self._chunk)
        head = _CHUNK.pack(Opcode.CHUNK, _CHUNK_LENGTH + size_bytes, begin_ns, end_ns, size_bytes, crc, 0, size_bytes)
        parts: list[bytes | bytearray] = [head, self._chunk]
        offsets, at = {}, start + length
        for channel, index in self._index.items():
            size = 8 * len(index)
            part = _INDEX.pack(Opcode.MESSAGE_INDEX, 6 + size, channel, size) + struct.pack(f"<{len(index)}Q", *index)
            offsets[channel] = at
            at += len(part)
            parts.append(part)
            self._counts[channel] += len(index) // 2
        # Only once it is written it counts: where the disk is full the file ends with the chunk before.
        self._file.write(b"".join(parts))
        self._chunk_indexes.append(
            ChunkIndex(
                message_start_time=begin_ns,
                message_end_time=end_ns,
                chunk_start_offset=start,
                chunk_length=length,
                message_index_offsets=offsets,
                message_index_length=at - start - length,
                compression="",
                compressed_size=size_bytes,
                uncompressed_size=size_bytes,
            )
        )
        self._chunk.clear()
        self._index.clear()

    def finish(self) -> None:
        """Writes the index at the end, with which readers find their way in the file."""
        self.end_chunk()
        self._file.write(_record(DataEnd(0)))
        start = self._file.tell()
        groups: list[tuple[Opcode, list[McapRecord]]] = [
            (Opcode.SCHEMA, [*self._schemas]),
            (Opcode.CHANNEL, [*self._channels]),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, [*self._chunk_indexes]),
            (Opcode.METADATA_INDEX, [*self._metadata_indexes]),
        ]
        summary, offsets = b"", b""
        for opcode, records in groups:
            data = b"".join(_record(record) for record in records)
            if data:
                offsets += _record(
                    SummaryOffset(group_opcode=opcode, group_start=start + len(summary), group_length=len(data))
                )
            summary += data
        offsets_start = start + len(summary)
        footer = _FOOTER.pack(Opcode.FOOTER, _FOOTER_LENGTH, start, offsets_start)
        crc = zlib.crc32(summary + offsets + footer)
        end = _record(Footer(summary_start=start, summary_offset_start=offsets_start, summary_crc=crc))
        self._file.write(summary + offsets + end + MAGIC)

    def _statistics(self) -> Statistics:
        chunks = self._chunk_indexes
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts={number: count for number, count in self._counts.items() if count},
            chunk_count=len(chunks),
            message_count=sum(self._counts.values()),
            metadata_count=len(self._metadata_indexes),
            message_start_time=min((chunk.message_start_time for chunk in chunks), default=0),
            message_end_time=max((chunk.message_end_time for chunk in chunks), default=0),
            schema_count=len(self._schemas),
        )


def _record(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
