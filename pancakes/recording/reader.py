"""Read, summarise and repair recordings, also those that were cut off or damaged. Needs `mcap`.

`RecordingReader` merges the files of a recording on one clock. `repair` writes all that reached the disk into a new
file with an index. A damaged chunk is left out and counted.
"""

from __future__ import annotations

import heapq
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Final

from mcap.records import Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC, CompressionType, IndexType, Writer
from msgspec.structs import replace

from pancakes import __version__
from pancakes.errors import RemoteProtocolError
from pancakes.packet import agent_of
from pancakes.recording.clock_alignment import CLOCKS, Alignment, ClockLife, MissionTime, Shift
from pancakes.recording.mcap_records import (
    READ_ERRORS,
    Damage,
    is_being_written,
    metadata_of,
    opened,
    records_of,
)
from pancakes.recording.mcap_writer import (
    CHUNK_BYTES,
    FORMAT,
    LIBRARY,
    METADATA,
    SUFFIX,
    first_name,
    part_number,
    parts_of,
)
from pancakes.recording.message_format import SCHEMAS, packet_from_data
from pancakes.recording.records import NANOSECONDS, RecordedPacket, RecordingError, TaskDescription
from pancakes.util.text import printable


@dataclass
class FileReading:
    """What was found in a file; complete once all its entries were read.

    Attributes:
        path: the file.
        about: what the recorder wrote about the recording.
        cut: why its end could not be read; empty if it could.
        damage: what could not be read before its end.
        strange: sentences on messages that are not packets any more, such as those of a changed type, and how often
            each occurred.
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
        path: the file, including the parts that it was split into, or the directory.

    Attributes:
        readings: the findings so far, by file.

    Raises:
        RecordingError: it does not exist.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files = files_of(path)
        self.readings = [FileReading(file) for file in self.files]
        self._aligned: Alignment | None = None

    def entries(self) -> Iterator[RecordedPacket]:
        """Yield all packets in the order in which they were recorded, over all files.

        Their times are on one clock, if the agents knew how their clocks compare.

        Raises:
            RecordingError: a file is not a recording.
        """
        shifts = self._alignment().shifts
        parts = [_entries(reading, shifts) for reading in self.readings]
        yield from heapq.merge(*parts, key=lambda entry: entry.time_ns)

    def mission_time(self) -> MissionTime:
        """Return the conversion of this recording's time to mission time. It reads the beginning of each file.

        Raises:
            RecordingError: a file is not a recording.
        """
        again = [FileReading(file) for file in self.files]
        shifts = self._alignment().shifts
        return MissionTime.of((reading.about, _entries(reading, shifts)) for reading in again)

    def _alignment(self) -> Alignment:
        if self._aligned is None:
            self._aligned = Alignment(_lives(self.files))
        return self._aligned

    def notes(self) -> Sequence[str]:
        """Return sentences about what could not be read so far."""
        notes = [f"{reading.path} is cut off: {reading.cut}" for reading in self.readings if reading.cut]
        notes += [
            f"{reading.path} is damaged: {reading.damage.chunks} of its chunks cannot be read"
            for reading in self.readings
            if reading.damage.chunks
        ]
        virtual = [reading.path for reading in self.readings if reading.about.get("clock") == "mission time"]
        live = [reading for reading in self.readings if reading.about.get("clock") == "time of day"]
        if virtual and live:
            notes.append(f"{virtual[0]} is in virtual time and {live[0].path} is not: their times cannot be compared")
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
    """Return the files of a recording, in their order.

    Raises:
        RecordingError: it does not exist, or its folder cannot be read.
    """
    try:
        is_folder = path.is_dir()
        # The first part of a recording may be gone: `at_limit = "drop_oldest"` drops it.
        files = [file for file in path.glob(f"*{SUFFIX}") if file.is_file()] if is_folder else parts_of(path)
    except OSError as error:
        raise RecordingError(f"the recording {path} cannot be read: {error.strerror or error}") from None
    if not files:
        raise RecordingError(f"{path} has no recording (*{SUFFIX})" if is_folder else f"there is no recording {path}")
    return sorted(files, key=lambda file: (first_name(file), part_number(file)))


def _lives(files: Sequence[Path]) -> list[ClockLife]:
    """Return the clock facts of recordings; the times of older recordings are not changed."""
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
        if not is_known:  # the metadata comes before the first packet
            is_known, life = True, ClockLife.of(reading.about)
            shift = shifts.get(life.key) if life is not None else None
        yield entry if shift is None else _moved(entry, shift)


def _moved(entry: RecordedPacket, shift: Shift) -> RecordedPacket:
    """Return a packet with its times on another clock."""
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
                text = f"its topic {channel.topic!r} is not of the form /AGENT/CHANNEL/TYPE"
                reading.strange[text] = reading.strange.get(text, 0) + 1
                continue
            try:
                packet = packet_from_data(name, kind, message.data)
            except RemoteProtocolError as error:
                reading.strange[str(error)] = reading.strange.get(str(error), 0) + 1
                continue
            yield RecordedPacket(message.log_time, agent, packet)


def _check_format(reading: FileReading) -> None:
    """Raise `RecordingError` if a later version of Pancakes has written the recording in another way."""
    given = reading.about.get("format", "1")
    if given.isdecimal() and int(given[:9]) > FORMAT:
        version = reading.about.get("version", "")
        raise RecordingError(
            f"{reading.path} is of the format {given[:9]}, which Pancakes {printable(version)} has written, and this is"
            f" Pancakes {__version__}, which reads formats up to {FORMAT}: read it with that version"
        )


def messages(reading: FileReading, file: BinaryIO) -> Iterator[tuple[str, Channel, Message]]:
    """Yield all readable messages of a file, each with the name of its schema and its channel.

    Raises:
        RecordingError: it is not a recording.
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
                    continue  # its channel is defined in a damaged chunk
                if channel is None:
                    raise KeyError(f"it does not define its channel {record.channel_id}")
                yield schemas[channel.schema_id], channel, record
    except READ_ERRORS as error:
        if not begun and not _was_begun(file):
            raise RecordingError(f"{reading.path} is not a recording: it does not begin like an MCAP file") from None
        if is_being_written(file):
            reading.cut = "it is being recorded"
        else:
            reading.cut = (str(error) or "its end is missing") if begun else "it is empty"


def _was_begun(file: BinaryIO) -> bool:
    """Return whether a recorder may have been killed the moment after it made the file."""
    file.seek(0)
    return MCAP0_MAGIC.startswith(file.read(len(MCAP0_MAGIC)))


@dataclass(frozen=True, slots=True)
class Repaired:
    """The result of a repair.

    Attributes:
        path: the file.
        whole: whether there was nothing to repair, and it was not changed.
        messages: the number of messages in it.
        bytes_lost: how many bytes of it could not be used.
    """

    path: Path
    whole: bool
    messages: int
    bytes_lost: int


def repair(path: Path, into: Path | None = None) -> Repaired:
    """Write all that can be read of a file into a new one.

    Args:
        path: the file.
        into: the new file; None: it replaces the old one once it is complete.

    Raises:
        RecordingError: it is not a recording, it is still being recorded, or the new file cannot be written.
    """
    reading = FileReading(path)
    with opened(path) as file:
        if into is None and is_being_written(file):
            # Its recorder would continue to write into a file without a name.
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
            made.unlink(missing_ok=True)  # half a file takes room, and would block the next repair
        raise RecordingError(f"{path} cannot be repaired into {made}: {error.strerror or error}") from None
    return Repaired(into or path, False, count, size - used)


def _copy(file: BinaryIO, out: BinaryIO, about: Mapping[str, str]) -> int:
    """Copy the readable records; return how many bytes of the old file they took."""
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
    except KeyError:  # its channel or schema is missing
        pass
    writer.finish()
    out.flush()
    os.fsync(out.fileno())  # it may take the place of the only other copy
    return used


def _readable(file: BinaryIO, damage: Damage) -> Iterator[McapRecord]:
    """Yield the readable records. Separate from writing, whose errors do not mean that the file ends here."""
    try:
        yield from records_of(file, damage)
    except READ_ERRORS:
        return


LEAST_SPAN_S: Final = 1.0
"""A rate is given only for packets over at least this time."""


@dataclass
class TopicCount:
    """The count of one packet type on one channel of one agent."""

    agent: str
    channel: str
    type: str
    packets: int = 0
    first_ns: int = 0
    last_ns: int = 0

    def row(self) -> dict[str, Any]:
        """Return the count as plain values."""
        span_s = (self.last_ns - self.first_ns) / NANOSECONDS
        # Packets that came only within a moment have no rate.
        rate_hz = (self.packets - 1) / span_s if self.packets > 1 and span_s >= LEAST_SPAN_S else None
        return {
            "agent": self.agent,
            "channel": self.channel,
            "type": self.type,
            "packets": self.packets,
            "rate_hz": round(rate_hz, 3) if rate_hz is not None else None,
        }


@dataclass
class TaskPresence:
    """The stay of a task on one agent.

    Attributes:
        task_id: the permanent identity of the task.
        agent: where it was.
        epoch: the number of the epoch under which its agent owned it.
        published: the number of packets that it published there.
    """

    task_id: str
    agent: str
    epoch: int
    first_ns: int
    last_ns: int
    published: int


@dataclass
class Summary:
    """The summary of a recording.

    Attributes:
        packets: the number of packets.
        first_ns: when the first was recorded.
        last_ns: when the last was recorded.
        topics: by agent, channel and type.
        stays: where each task that has an identity was, in the order of time.
    """

    packets: int = 0
    first_ns: int = 0
    last_ns: int = 0
    topics: dict[tuple[str, str, str], TopicCount] = field(default_factory=dict)
    stays: list[TaskPresence] = field(default_factory=list)

    @classmethod
    def of(cls, entries: Iterable[RecordedPacket]) -> Summary:
        """Summarise packets, which must come in the order of time."""
        summary = cls()
        for entry in entries:
            summary._add(entry)
        return summary

    def _add(self, entry: RecordedPacket) -> None:
        packet = entry.packet
        if not self.packets:
            self.first_ns = entry.time_ns
        self.packets += 1
        self.last_ns = entry.time_ns
        key = (entry.agent, packet.channel, packet.type)
        topic = self.topics.get(key)
        if topic is None:
            topic = self.topics[key] = TopicCount(*key, first_ns=entry.time_ns)
        topic.packets += 1
        topic.last_ns = entry.time_ns
        if packet.fence is not None and agent_of(packet.source) == entry.agent:
            self._add_to_stay(entry, packet.fence.task_id, packet.fence.epoch[0])

    def _add_to_stay(self, entry: RecordedPacket, task_id: str, epoch: int) -> None:
        for stay in reversed(self.stays):
            if (stay.task_id, stay.agent, stay.epoch) == (task_id, entry.agent, epoch):
                stay.last_ns = entry.time_ns
                stay.published += 1
                return
        self.stays.append(TaskPresence(task_id, entry.agent, epoch, entry.time_ns, entry.time_ns, 1))
