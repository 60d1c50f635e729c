"""Write a recording as MCAP files, one after the other: `NAME.mcap`, `NAME.002.mcap`, ...

A killed process loses only the packets since its last flush. Needs `mcap`. In one thread.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from mcap.writer import CompressionType, Writer

from pancakes import __version__
from pancakes.recording.message_format import SCHEMAS, data_of, schema_for
from pancakes.recording.records import RecordedPacket, RecordingError
from pancakes.util.files import is_still_at

CHUNK_BYTES: Final = 128 * 1024
"""A chunk ends once its messages are larger than this. Ending one costs as much as ten messages."""
LIBRARY: Final = f"pancakes {__version__}"
METADATA: Final = "pancakes"
FORMAT: Final = 1
"""The format of recordings: a later version of Pancakes with another format has a higher number, and reads this one."""


class RecordingWriter:
    """Write one file of a recording. In one thread.

    Its chunks are compressed to a fifth. Once writing has failed, the file ends without an index, like the file of an
    agent that was killed.

    Args:
        path: where; the file must not exist yet.
        about: the metadata of the recording, such as `agent` and `clock`.

    Attributes:
        path: the file.

    Raises:
        OSError: the file cannot be created.
    """

    def __init__(self, path: Path, about: Mapping[str, str]) -> None:
        self.path = path
        self._file = path.open("xb")
        with suppress(OSError):  # this file system knows no locks
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # `repair` refuses a file that is being written
        self._mcap = Writer(self._file, sys.maxsize, CompressionType.ZSTD)  # only `flush` ends a chunk
        try:
            self._mcap.start(library=LIBRARY)
            self._mcap.add_metadata(METADATA, {**about, "format": str(FORMAT), "version": __version__})
            self._file.flush()  # an agent that is killed now leaves a recording that can be read
        except OSError:
            path.unlink()  # it would not be readable
            with suppress(OSError):  # the first error is the one to report
                self._file.close()
            raise
        self._has_failed = False
        self._flushed_bytes = self._file.tell()
        self._left_bytes: int | None = None
        self._chunk_bytes = 0
        self._packet_channels: dict[tuple[str, str, str], int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}

    def write(self, entry: RecordedPacket) -> None:
        """Add a packet.

        Raises:
            LocalProtocolError: it cannot be recorded; the file is unchanged.
            OSError: the disk is full, or another write error
        """
        packet = entry.packet
        data = data_of(packet)
        channel = self._packet_channels.get((entry.agent, packet.channel, packet.type)) or self._channel(entry)
        # The publish time is unknown, because the stamp is on the mission clock: the log time stands for it.
        self._add_message(channel, entry.time_ns, data, packet.seq & 0xFFFFFFFF)

    def add(self, topic: str, schema_name: str, schema: Mapping[str, object], time_ns: int, data: bytes) -> None:
        """Add a message that is not a packet, such as a pose in the schema of a viewer.

        Raises:
            OSError: the disk is full, ...
        """
        key = (topic, schema_name)
        if key not in self._channels:
            number = self._add_schema(schema_name, schema)
            self._channels[key] = self._mcap.register_channel(topic, "json", number)
        self._add_message(self._channels[key], time_ns, data, 0)

    def note(self, name: str, row: Mapping[str, str]) -> None:
        """Add a metadata record.

        Raises:
            OSError: the disk is full, ...
        """
        self._mcap.add_metadata(name, dict(row))

    def is_there(self) -> bool:
        """Return whether the file still has its name."""
        return is_still_at(self._file.fileno(), self.path)

    def is_truncated(self) -> bool:
        """Return whether another program has truncated the file. Nothing is written to it from then on."""
        if self._left_bytes is None:
            size = os.fstat(self._file.fileno()).st_size
            if size < self._flushed_bytes:
                self._left_bytes = size
        return self._left_bytes is not None

    def size_bytes(self) -> int:
        """Return the size of the file after the last `flush`."""
        return self._file.tell()

    def flush(self) -> None:
        """Pass everything written to the operating system: it survives a kill of this process.

        Raises:
            OSError: the disk is full, ...
        """
        self._chunk_bytes = 0
        if self.is_truncated():
            return  # a hole would follow what is left
        try:
            self._mcap.flush()
            self._flushed_bytes = self._file.tell()
        except OSError:
            self._has_failed = True
            raise

    def sync(self) -> None:
        """Bring flushed data to the disk: it survives a power cut. It may take long.

        Raises:
            OSError: the disk is full, ...
        """
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Write the index and close the file, if it is still open."""
        if self._file.closed:
            return  # the next file could not be created
        try:
            if not self._has_failed and not self.is_truncated():
                self._mcap.finish()
                self._file.flush()
                self.sync()
        finally:
            self._file.close()
            if self._left_bytes is not None and self.path.exists():
                os.truncate(self.path, self._left_bytes)  # what was written since then is behind a hole

    def _add_message(self, channel: int, time_ns: int, data: bytes, sequence: int) -> None:
        self._mcap.add_message(channel, time_ns, data, time_ns, sequence)
        self._chunk_bytes += len(data)
        if self._chunk_bytes > CHUNK_BYTES:
            self.flush()

    def _add_schema(self, name: str, schema: Mapping[str, object]) -> int:
        return self._mcap.register_schema(name, "jsonschema", json.dumps(schema).encode())

    def _channel(self, entry: RecordedPacket) -> int:
        packet = entry.packet
        if packet.type not in self._schemas:
            self._schemas[packet.type] = self._add_schema(SCHEMAS + packet.type, schema_for(packet.type))
        number = self._mcap.register_channel(entry.topic, "json", self._schemas[packet.type])
        self._packet_channels[entry.agent, packet.channel, packet.type] = number
        return number


MIB: Final = 1 << 20
SYNC_BYTES: Final = 8 * MIB
"""At most this much is passed to the operating system before it is brought to the disk."""
SUFFIX: Final = ".mcap"


class RecordingParts:
    """Write a recording into one file after the other: `NAME.mcap`, `NAME.002.mcap`, ...

    Args:
        path: the first file. If it exists, a number is added to the name: nothing is overwritten.
        about: see `RecordingWriter`.
        split_mib: a new file begins when one has this size.
        limit_mib: the largest size of all files together; 0: no limit.
        drop_oldest: whether the oldest file is removed at the limit; otherwise the recording ends.
        free_mib: how much of the disk must stay free.
        goes_on: whether to continue an ended recording: its files stay, and the next one begins.

    Attributes:
        first: the path of the first file.
        moved: a sentence on each file that another program has moved, removed or truncated while it was written.

    Raises:
        RecordingError: the file cannot be written, or too little is free on the disk.
    """

    def __init__(
        self,
        path: Path,
        about: Mapping[str, str],
        split_mib: float,
        limit_mib: float,
        drop_oldest: bool,
        free_mib: float,
        goes_on: bool = False,
    ) -> None:
        before = parts_of(path) if goes_on else []
        self._about = about
        self._split_bytes = split_mib * MIB
        self._limit_bytes = limit_mib * MIB
        self._drop_oldest = drop_oldest
        self._free_bytes = free_mib * MIB
        self._synced_bytes = 0
        self.moved: list[str] = []
        self.first = path
        try:
            if not goes_on:
                self.first = _unused(path)
            file = part_path(self.first, part_number(before[-1]) + 1 if before else 1)
            self._done = [(path, path.stat().st_size) for path in before]
            path.parent.mkdir(parents=True, exist_ok=True)
            lacking = self._lacking()
            if not lacking:
                self._writer = RecordingWriter(file, about)
        except OSError as error:
            raise RecordingError(f"the recording {self.first} cannot be written: {error.strerror or error}") from None
        if lacking:
            raise RecordingError(f"the recording {self.first} does not begin: {lacking}")

    def write(self, entry: RecordedPacket) -> None:
        """Add a packet; see `RecordingWriter.write`."""
        self._writer.write(entry)

    def add(self, topic: str, schema_name: str, schema: Mapping[str, object], time_ns: int, data: bytes) -> None:
        """Add a message that is not a packet; see `RecordingWriter.add`."""
        self._writer.add(topic, schema_name, schema, time_ns, data)

    def note(self, name: str, row: Mapping[str, str]) -> None:
        """Add a metadata record; see `RecordingWriter.note`."""
        self._writer.note(name, row)

    def flush(self) -> str:
        """Pass everything to the operating system, and begin a new file if it is time.

        Returns:
            Why the recording must end; empty if it may go on.

        Raises:
            OSError: the disk is full, ...
        """
        self._writer.flush()
        is_large = self._writer.size_bytes() >= self._split_bytes
        if is_large or not self._writer.is_there() or self._writer.is_truncated():
            self._split()
        if is_large or self._writer.size_bytes() - self._synced_bytes >= SYNC_BYTES:
            lacking = self.sync()
            if lacking:
                return lacking
        if self._limit_bytes and self._size_bytes() > self._limit_bytes:
            if not self._drop_oldest:
                return f"it has reached its limit of {self._limit_bytes / MIB:g} MiB"
            while self._done and self._size_bytes() > self._limit_bytes:
                self._done.pop(0)[0].unlink(missing_ok=True)
        return ""

    def begin_again(self, about: Mapping[str, str]) -> Path:
        """Continue in a new file with other metadata; return the file.

        Raises:
            OSError: the disk is full, ...
        """
        self._about = about
        self._writer.flush()
        self._split()
        return self._writer.path

    def sync(self) -> str:
        """Bring flushed data to the disk, and check how much room is left there. It may take long.

        Returns:
            Why the recording must end; empty if it may go on.

        Raises:
            OSError: the disk is full, ...
        """
        self._writer.sync()
        self._synced_bytes = self._writer.size_bytes()
        return self._lacking()

    def close(self) -> None:
        """Close the last file.

        Raises:
            OSError: the disk is full, ...
        """
        self._writer.close()

    def _lacking(self) -> str:
        """Return what the disk lacks; empty: nothing."""
        disk = os.statvfs(self.first.parent)
        free_bytes = disk.f_bavail * disk.f_frsize
        if free_bytes >= self._free_bytes:
            return ""
        return (
            f"less than {self._free_bytes / MIB:g} MiB are free on the disk of {self.first.parent}"
            f" ({free_bytes / MIB:.0f} MiB; free_mib of [record] sets how much must stay free)"
        )

    def _size_bytes(self) -> int:
        return sum(size for _, size in self._done) + self._writer.size_bytes()

    def _split(self) -> None:
        path, is_there = self._writer.path, self._writer.is_there()
        number = part_number(path) + 1
        why = "" if is_there else "was moved or removed by another program"
        if is_there and self._writer.is_truncated():
            why = "was truncated by another program, and its last second is lost"
        self._writer.close()
        if is_there:
            self._done.append((path, path.stat().st_size))
        self.first.parent.mkdir(parents=True, exist_ok=True)  # the folder may have been moved too
        self._writer = RecordingWriter(part_path(self.first, number), self._about)
        if why:
            self.moved.append(f"{path} {why}: the recording goes on in {self._writer.path}")


def part_path(first: Path, number: int) -> Path:
    """Return the path of a part of a recording, from 1."""
    return first if number == 1 else first.with_name(f"{first.name.removesuffix(SUFFIX)}.{number:03d}{SUFFIX}")


def part_number(path: Path) -> int:
    """Return which part a file is, from 1."""
    found = re.search(r"\.(\d{3,})\.mcap$", path.name)
    return int(found[1]) if found else 1


def first_name(path: Path) -> str:
    """Return the name of the first file of a recording, given any of its parts."""
    return re.sub(r"\.\d{3,}\.mcap$", SUFFIX, path.name)


def parts_of(first: Path) -> list[Path]:
    """Return the existing parts of a recording, in order, given the path of the first."""
    stem = re.escape(first.name.removesuffix(SUFFIX))
    pattern = re.compile(rf"{stem}\.\d{{3,}}\.mcap")
    later = [path for path in first.parent.glob(f"*{SUFFIX}") if pattern.fullmatch(path.name)]
    return [path for path in (first, *sorted(later, key=part_number)) if path.is_file()]


def _unused(path: Path) -> Path:
    """Return an unused path like this one, also without later parts of a recording whose first part is gone.

    Raises:
        OSError: it is not a path, or its folder cannot be read.
    """
    stem = path.name.removesuffix(SUFFIX)
    number = 1
    candidate = path.with_name(stem + SUFFIX)
    while os.path.lexists(candidate) or parts_of(candidate):
        number += 1
        candidate = path.with_name(f"{stem}-{number}{SUFFIX}")
    return candidate
