"""The files of one recording, which is split where a file grows large."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from pancakes.tools.recording.recorded_packet import RecordedPacket, RecordingError
from pancakes.tools.recording.writer import RecordingWriter

MIB: Final = 1 << 20
SYNC_BYTES: Final = 8 * MIB
"""The most that is given to the operating system before it is brought to the disk."""
SUFFIX: Final = ".mcap"


class RecordingParts:
    """Writes a recording into one file after the other: `NAME.mcap`, `NAME.002.mcap`, ...

    Args:
        path: the first file. Where it is there already, a number is added to the name: nothing is overwritten.
        about: see `RecordingWriter`.
        split_mib: a new file begins where one has grown this large.
        limit_mib: how large all of them may become; 0 for no limit.
        drop_oldest: whether the oldest file goes at the limit; otherwise the recording ends.
        free_mib: so much of the disk stays free.
        goes_on: whether a recording that has ended goes on: its files are left alone, and the next one begins.

    Attributes:
        first: the path of the first file.
        moved: a sentence on each file that another program has moved, removed or truncated while it was written.

    Raises:
        RecordingError: nothing can be written there, or too little is free on the disk.
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
        """Adds a packet; see `RecordingWriter.write`."""
        self._writer.write(entry)

    def add(self, topic: str, schema_name: str, schema: Mapping[str, object], time_ns: int, data: bytes) -> None:
        """Adds a message that is no packet; see `RecordingWriter.add`."""
        self._writer.add(topic, schema_name, schema, time_ns, data)

    def note(self, name: str, row: Mapping[str, str]) -> None:
        """Adds a metadata record; see `RecordingWriter.note`."""
        self._writer.note(name, row)

    def flush(self) -> str:
        """Gives everything to the operating system, and begins a new file where it is time to.

        Returns:
            Why the recording must end; empty where it may go on.

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
        """Goes on in a new file, of which something else is to be known; returns that file.

        Raises:
            OSError: the disk is full, ...
        """
        self._about = about
        self._writer.flush()
        self._split()
        return self._writer.path

    def sync(self) -> str:
        """Brings what was flushed to the disk, and looks how much room is left there. It may take long.

        Returns:
            Why the recording must end; empty where it may go on.

        Raises:
            OSError: the disk is full, ...
        """
        self._writer.sync()
        self._synced_bytes = self._writer.size_bytes()
        return self._lacking()

    def close(self) -> None:
        """Closes the last file.

        Raises:
            OSError: the disk is full, ...
        """
        self._writer.close()

    def _lacking(self) -> str:
        """Says what the disk lacks; empty: nothing."""
        disk = os.statvfs(self.first.parent)
        free_bytes = disk.f_bavail * disk.f_frsize
        if free_bytes >= self._free_bytes:
            return ""
        return (
            f"less than {self._free_bytes / MIB:g} MiB are free on the disk of {self.first.parent}"
            f" ({free_bytes / MIB:.0f} MiB; free_mib of [record] says how much is to stay free)"
        )

    def _size_bytes(self) -> int:
        return sum(size for _, size in self._done) + self._writer.size_bytes()

    def _split(self) -> None:
        path, is_there = self._writer.path, self._writer.is_there()
        number = part_number(path) + 1
        why = "" if is_there else "was moved or removed by another program"
        if is_there and self._writer.is_truncated():
            why = "was truncated by another program, and the last second of what was said is lost with it"
        self._writer.close()
        if is_there:
            self._done.append((path, path.stat().st_size))
        self.first.parent.mkdir(parents=True, exist_ok=True)  # it may have been moved as well
        self._writer = RecordingWriter(part_path(self.first, number), self._about)
        if why:
            self.moved.append(f"{path} {why}: the recording goes on in {self._writer.path}")


def part_path(first: Path, number: int) -> Path:
    """Returns the path of a part of a recording, from 1."""
    return first if number == 1 else first.with_name(f"{first.name.removesuffix(SUFFIX)}.{number:03d}{SUFFIX}")


def part_number(path: Path) -> int:
    """Returns which part a file is, from 1."""
    found = re.search(r"\.(\d{3,})\.mcap$", path.name)
    return int(found[1]) if found else 1


def first_name(path: Path) -> str:
    """Returns the name of the first file of the recording that a file is a part of."""
    return re.sub(r"\.\d{3,}\.mcap$", SUFFIX, path.name)


def parts_of(first: Path) -> list[Path]:
    """Returns the parts of a recording that are there, in their order, given the path of the first."""
    stem = re.escape(first.name.removesuffix(SUFFIX))
    pattern = re.compile(rf"{stem}\.\d{{3,}}\.mcap")
    later = [path for path in first.parent.glob(f"*{SUFFIX}") if pattern.fullmatch(path.name)]
    return [path for path in (first, *sorted(later, key=part_number)) if path.is_file()]


def _unused(path: Path) -> Path:
    """Returns a path beside this one at which nothing is, nor a later part of a recording whose first is gone.

    Raises:
        OSError: it is no path, or nothing may be looked up there.
    """
    stem = path.name.removesuffix(SUFFIX)
    number = 1
    candidate = path.with_name(stem + SUFFIX)
    while os.path.lexists(candidate) or parts_of(candidate):
        number += 1
        candidate = path.with_name(f"{stem}-{number}{SUFFIX}")
    return candidate
