"""Makes a recording whole again that was cut off by a crash: all that reached the disk, with an index."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from mcap.records import Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import CompressionType, IndexType, Writer

from pancakes.tools.recording.alignment import CLOCKS
from pancakes.tools.recording.mcap_records import READ_ERRORS, Damage, is_being_written, opened, records_of
from pancakes.tools.recording.recorded_packet import RecordingError
from pancakes.tools.recording.recording_reader import FileReading, messages
from pancakes.tools.recording.writer import CHUNK_BYTES, LIBRARY, METADATA


@dataclass(frozen=True, slots=True)
class Repaired:
    """The result of a repair.

    Attributes:
        path: the file.
        whole: whether there was nothing to mend, and it was left alone.
        messages: how many messages are in it.
        bytes_lost: how much of it could not be used.
    """

    path: Path
    whole: bool
    messages: int
    bytes_lost: int


def repair(path: Path, into: Path | None = None) -> Repaired:
    """Writes all that can be read of a file into a new one.

    Args:
        path: the file.
        into: the new file; None: it takes the place of the old one, once it is complete.

    Raises:
        RecordingError: it is no recording, it is still being recorded, or the new file cannot be written.
    """
    reading = FileReading(path)
    with opened(path) as file:
        if into is None and is_being_written(file):
            # Its recorder would write on into a file that has no name any more.
            raise RecordingError(f"{path} is being recorded: end that first (pancakes record stop), or name --out")
        count = sum(1 for _ in messages(reading, file))
    if reading.whole:
        return Repaired(path, True, count, 0)
    made = into or path.with_name(path.name + ".repaired")
    begun = False
    try:
        with path.open("rb") as file, made.open("xb") as out:
            begun = True
            used = _copy(file, out, reading.about)
            size = file.seek(0, 2)
        if into is None:
            made.replace(path)
    except OSError as error:
        if begun:
            made.unlink(missing_ok=True)  # half a file takes room, and would be in the way of the next repair
        raise RecordingError(f"{path} cannot be repaired into {made}: {error.strerror or error}") from None
    return Repaired(into or path, False, count, size - used)


def _copy(file: BinaryIO, out: BinaryIO, about: Mapping[str, str]) -> int:
    """Copies what is whole; returns how many bytes of the old file that took."""
    damage = Damage()
    writer = Writer(out, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD, index_types=IndexType.ALL)
    writer.start(profile="", library=LIBRARY)
    writer.add_metadata(METADATA, dict(about))
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    used = 0
    try:
        for record in _readable(file, damage):
            if isinstance(record, Schema):
                if record.id not in schemas:
                    schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel):
                if record.id not in channels:
                    channels[record.id] = writer.register_channel(
                        record.topic, record.message_encoding, schemas[record.schema_id], dict(record.metadata)
                    )
            elif isinstance(record, Metadata) and record.name == CLOCKS:
                writer.add_metadata(CLOCKS, dict(record.metadata))
            elif isinstance(record, Message):
                if record.channel_id not in channels and damage.chunks:
                    continue
                channel = channels[record.channel_id]
                writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
            used = file.tell() - damage.size_bytes
    except KeyError:  # its channel or schema is missing: it is torn
        pass
    writer.finish()
    out.flush()
    os.fsync(out.fileno())  # it may take the place of the only other copy
    return used


def _readable(file: BinaryIO, damage: Damage) -> Iterator[McapRecord]:
    """Gives what can be read. Apart from the writing, whose errors do not say that the file ends here."""
    try:
        yield from records_of(file, damage)
    except READ_ERRORS:
        return
