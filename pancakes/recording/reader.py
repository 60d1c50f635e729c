"""Reads recordings, whole or cut off."""

from __future__ import annotations

import heapq
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Final

from mcap.exceptions import McapError
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from pancakes.errors import RemoteProtocolError
from pancakes.recording.chunks import MAGIC
from pancakes.recording.entry import Entry, RecordingError, packet_from_data
from pancakes.recording.mission_time import MissionTime
from pancakes.recording.parts import SUFFIX, first_name, part_number, parts_of
from pancakes.recording.schemas import SCHEMAS
from pancakes.recording.writer import METADATA

READ_ERRORS: Final = (McapError, ValueError, KeyError, OverflowError, OSError, struct.error)
"""What reading a file raises that was cut off, torn, or never a recording."""


@dataclass
class Reading:
    """What was found while a file was read; complete once its entries have been taken.

    Attributes:
        path: the file.
        about: what the recorder wrote about the recording.
        cut: why it could not be read to its end; empty where it could.
        strange: sentences on messages that are no packets any more, such as of a type that has changed, and how often
            each holds.
    """

    path: Path
    about: dict[str, str] = field(default_factory=dict)
    cut: str = ""
    strange: dict[str, int] = field(default_factory=dict)


class RecordingReader:
    """A recording: one file, or all of a directory (`*.mcap`), such as the parts of one that was split.

    Args:
        path: the file, to which belong the parts that it was split into, or the directory.

    Attributes:
        readings: what was found so far, by file.

    Raises:
        RecordingError: there is none.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files = files_of(path)
        self.readings = [Reading(file) for file in self.files]

    def entries(self) -> Iterator[Entry]:
        """Gives all packets, in the order in which they were recorded, over all files.

        Raises:
            RecordingError: a file is no recording at all.
        """
        parts = [_entries(reading) for reading in self.readings]
        yield from heapq.merge(*parts, key=lambda entry: entry.time_ns)

    def mission_time(self) -> MissionTime:
        """Returns what turns this recording's time into mission time; reads the beginning of each file.

        Raises:
            RecordingError: a file is no recording at all.
        """
        opened = [Reading(file) for file in self.files]
        return MissionTime.of((reading.about, _entries(reading)) for reading in opened)

    def notes(self) -> Sequence[str]:
        """Returns sentences on all that could not be read so far."""
        notes = [f"{reading.path} is cut off: {reading.cut}" for reading in self.readings if reading.cut]
        return notes + [
            f"{reading.path}: {text}" + (f" ({count} times)" if count > 1 else "")
            for reading in self.readings
            for text, count in reading.strange.items()
        ]


def files_of(path: Path) -> list[Path]:
    """Returns the files of a recording, in their order.

    Raises:
        RecordingError: there is none.
    """
    if path.is_dir():
        files = sorted(path.glob(f"*{SUFFIX}"), key=lambda file: (first_name(file), part_number(file)))
        if not files:
            raise RecordingError(f"{path} holds no recording (*{SUFFIX})")
        return files
    if not path.is_file():
        raise RecordingError(f"there is no recording {path}")
    return parts_of(path)


def _entries(reading: Reading) -> Iterator[Entry]:
    with reading.path.open("rb") as file:
        for schema, channel, message in messages(reading, file):
            if not schema.startswith(SCHEMAS):
                continue  # what a viewer shows
            _, agent, name, kind = channel.topic.split("/")
            try:
                packet = packet_from_data(name, kind, message.data)
            except RemoteProtocolError as error:
                reading.strange[str(error)] = reading.strange.get(str(error), 0) + 1
                continue
            yield Entry(message.log_time, agent, packet)


def messages(reading: Reading, file: BinaryIO) -> Iterator[tuple[str, Channel, Message]]:
    """Gives all messages of a file as far as it is whole, each with the name of its schema and its channel.

    Raises:
        RecordingError: it is no recording at all.
    """
    channels: dict[int, Channel] = {}
    schemas: dict[int, str] = {}
    begun = False
    try:
        for record in StreamReader(file, validate_crcs=True).records:
            begun = True
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Metadata) and record.name == METADATA:
                reading.about.update(record.metadata)
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                yield schemas[channel.schema_id], channel, record
    except READ_ERRORS as error:
        if not begun and not _was_begun(file):
            raise RecordingError(f"{reading.path} is no recording: it does not begin as an MCAP file does") from None
        reading.cut = (str(error) or "its end is missing") if begun else "it holds nothing yet"


def _was_begun(file: BinaryIO) -> bool:
    """Returns whether a recorder may have been killed the moment after it made the file."""
    file.seek(0)
    return MAGIC.startswith(file.read(len(MAGIC)))
