"""Reads recordings, whole or cut off."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.records import Channel, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC
from msgspec.structs import replace

from pancakes import __version__
from pancakes.errors import RemoteProtocolError
from pancakes.runtime.foundation.printable import printable
from pancakes.tools.recording.alignment import CLOCKS, Alignment, ClockLife, Shift
from pancakes.tools.recording.description import TaskDescription
from pancakes.tools.recording.mcap_records import (
    READ_ERRORS,
    Damage,
    is_being_written,
    metadata_of,
    opened,
    records_of,
)
from pancakes.tools.recording.message import packet_from_data
from pancakes.tools.recording.mission_time import MissionTime
from pancakes.tools.recording.parts import SUFFIX, first_name, part_number, parts_of
from pancakes.tools.recording.recorded_packet import RecordedPacket, RecordingError
from pancakes.tools.recording.schemas import SCHEMAS
from pancakes.tools.recording.writer import FORMAT, METADATA


@dataclass
class FileReading:
    """What was found while a file was read; complete once its entries have been taken.

    Attributes:
        path: the file.
        about: what the recorder wrote about the recording.
        cut: why it could not be read to its end; empty where it could.
        damage: what could not be read before that.
        strange: sentences on messages that are no packets any more, such as of a type that has changed, and how often
            each has.
    """

    path: Path
    about: dict[str, str] = field(default_factory=dict)
    cut: str = ""
    damage: Damage = field(default_factory=Damage)
    strange: dict[str, int] = field(default_factory=dict)

    @property
    def whole(self) -> bool:
        """Whether all of it could be read."""
        return not self.cut and not self.damage.chunks


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
        self.readings = [FileReading(file) for file in self.files]
        self._aligned: Alignment | None = None

    def entries(self) -> Iterator[RecordedPacket]:
        """Gives all packets, in the order in which they were recorded, over all files.

        Their times are those of one clock, where the agents knew how their clocks stand to each other.

        Raises:
            RecordingError: a file is no recording at all.
        """
        shifts = self._alignment().shifts
        parts = [_entries(reading, shifts) for reading in self.readings]
        yield from heapq.merge(*parts, key=lambda entry: entry.time_ns)

    def mission_time(self) -> MissionTime:
        """Returns what turns this recording's time into mission time; reads the beginning of each file.

        Raises:
            RecordingError: a file is no recording at all.
        """
        again = [FileReading(file) for file in self.files]
        shifts = self._alignment().shifts
        return MissionTime.of((reading.about, _entries(reading, shifts)) for reading in again)

    def _alignment(self) -> Alignment:
        if self._aligned is None:
            self._aligned = Alignment(_lives(self.files))
        return self._aligned

    def notes(self) -> Sequence[str]:
        """Returns sentences on all that could not be read so far."""
        notes = [f"{reading.path} is cut off: {reading.cut}" for reading in self.readings if reading.cut]
        notes += [
            f"{reading.path} is damaged: {reading.damage.chunks} of its chunks cannot be read"
            for reading in self.readings
            if reading.damage.chunks
        ]
        virtual = [reading.path for reading in self.readings if reading.about.get("clock") == "mission time"]
        live = [reading for reading in self.readings if reading.about.get("clock") == "time of day"]
        if virtual and live:
            notes.append(f"{virtual[0]} is in virtual time and {live[0].path} is not: their times do not go together")
        aligned = self._alignment()
        notes += aligned.remarks
        for reading in live:
            life = ClockLife.of(reading.about)
            if life is not None and not life.is_dated and life.key not in aligned.shifts:
                notes.append(f"{reading.path} has no dates: the clock of {life.agent} was not set, and begins in 1970")
        return notes + [
            f"{reading.path}: {text}" + (f" ({count} times)" if count > 1 else "")
            for reading in self.readings
            for text, count in reading.strange.items()
        ]


def files_of(path: Path) -> list[Path]:
    """Returns the files of a recording, in their order.

    Raises:
        RecordingError: there is none, or nothing may be looked up there.
    """
    try:
        is_folder = path.is_dir()
        # Of a file, the first part may be gone: `at_limit = "drop_oldest"` drops it.
        files = [file for file in path.glob(f"*{SUFFIX}") if file.is_file()] if is_folder else parts_of(path)
    except OSError as error:
        raise RecordingError(f"the recording {path} cannot be read: {error.strerror or error}") from None
    if not files:
        raise RecordingError(f"{path} has no recording (*{SUFFIX})" if is_folder else f"there is no recording {path}")
    return sorted(files, key=lambda file: (first_name(file), part_number(file)))


def _lives(files: Sequence[Path]) -> list[ClockLife]:
    """Returns what recordings tell of the clocks of their agents; the times of older recordings stay as they are."""
    lives: dict[str, ClockLife] = {}
    if len(files) < 2:  # there is nothing to align
        return []
    for path in files:
        own = None
        with opened(path) as file:
            for record in metadata_of(file):
                if record.name == METADATA and (made := ClockLife.of(record.metadata)) is not None:
                    own = lives.setdefault(made.key, made)
                elif record.name == CLOCKS and own is not None:
                    own.take(record.metadata)
    return list(lives.values())


def _entries(reading: FileReading, shifts: Mapping[str, Shift]) -> Iterator[RecordedPacket]:
    shift: Shift | None = None
    is_known = False
    for entry in _recorded(reading):
        if not is_known:  # what the recording says of itself stands before its first packet
            is_known, life = True, ClockLife.of(reading.about)
            shift = shifts.get(life.key) if life is not None else None
        yield entry if shift is None else _moved(entry, shift)


def _moved(entry: RecordedPacket, shift: Shift) -> RecordedPacket:
    """Returns a packet with its times as another clock counts them."""
    packet, body = entry.packet, entry.packet.body
    if isinstance(body, TaskDescription):
        began = body.began
        if began is not None and isinstance(began.get("time_ns"), int):
            began = {**began, "time_ns": shift(began["time_ns"])}
        packet = replace(packet, body=replace(body, time_ns=shift(body.time_ns), began=began))
    return replace(entry, time_ns=shift(entry.time_ns), packet=packet)


def _recorded(reading: FileReading) -> Iterator[RecordedPacket]:
    with opened(reading.path) as file:
        for schema, channel, message in messages(reading, file):
            if not schema.startswith(SCHEMAS):
                continue  # what a viewer shows
            try:
                _, agent, name, kind = channel.topic.split("/")
            except ValueError:
                text = f"its topic {channel.topic!r} does not read /AGENT/CHANNEL/TYPE"
                reading.strange[text] = reading.strange.get(text, 0) + 1
                continue
            try:
                packet = packet_from_data(name, kind, message.data)
            except RemoteProtocolError as error:
                reading.strange[str(error)] = reading.strange.get(str(error), 0) + 1
                continue
            yield RecordedPacket(message.log_time, agent, packet)


def _check_format(reading: FileReading) -> None:
    """Raises `RecordingError` if a later version of Pancakes has written the recording in another way."""
    told = reading.about.get("format", "1")
    if told.isdecimal() and int(told[:9]) > FORMAT:
        version = reading.about.get("version", "")
        raise RecordingError(
            f"{reading.path} is of the format {told[:9]}, which Pancakes {printable(version)} has written, and this is"
            f" Pancakes {__version__}, which reads formats up to {FORMAT}: read it with that version"
        )


def messages(reading: FileReading, file: BinaryIO) -> Iterator[tuple[str, Channel, Message]]:
    """Gives all messages of a file as far as it is whole, each with the name of its schema and its channel.

    Raises:
        RecordingError: it is no recording at all.
    """
    channels: dict[int, Channel] = {}
    schemas: dict[int, str] = {}
    begun = False
    try:
        for record in records_of(file, reading.damage):
            begun = True
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Metadata) and record.name == METADATA:
                reading.about.update(record.metadata)
                _check_format(reading)
            elif isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None and reading.damage.chunks:
                    continue  # what it was is told in a chunk that is damaged
                if channel is None:
                    raise KeyError(f"it does not say what its channel {record.channel_id} is")
                yield schemas[channel.schema_id], channel, record
    except READ_ERRORS as error:
        if not begun and not _was_begun(file):
            raise RecordingError(f"{reading.path} is no recording: it does not begin as an MCAP file does") from None
        if is_being_written(file):
            reading.cut = "it is being recorded"
        else:
            reading.cut = (str(error) or "its end is missing") if begun else "it has nothing yet"


def _was_begun(file: BinaryIO) -> bool:
    """Returns whether a recorder may have been killed the moment after it made the file."""
    file.seek(0)
    return MCAP0_MAGIC.startswith(file.read(len(MCAP0_MAGIC)))
