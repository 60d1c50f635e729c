"""Writes one MCAP file of a recording; a killed process loses only the packets since its last flush."""

from __future__ import annotations

import fcntl
import json
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from mcap.writer import CompressionType, Writer

from pancakes import __version__
from pancakes.runtime.foundation.same_file import is_still_at
from pancakes.tools.recording.message import data_of
from pancakes.tools.recording.recorded_packet import RecordedPacket
from pancakes.tools.recording.schemas import SCHEMAS, schema_for

CHUNK_BYTES: Final = 128 * 1024
"""A chunk ends once its messages are larger. Ending one costs as much as ten messages."""
LIBRARY: Final = f"pancakes {__version__}"
METADATA: Final = "pancakes"
FORMAT: Final = 1
"""Of recordings: a later version of Pancakes that writes them otherwise has a higher one, and reads this."""


class RecordingWriter:
    """One file that is being written. In one thread.

    Its chunks are compressed to a fifth. Once writing has failed, the file ends without an index, like the file of an
    agent that was killed.

    Args:
        path: where; must not be there yet.
        about: what is to be known about the recording, such as `agent` and `clock`.

    Attributes:
        path: where.

    Raises:
        OSError: the file cannot be made.
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
            path.unlink()  # it cannot be read
            with suppress(OSError):  # the first error says it already
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
        """Adds a packet.

        Raises:
            LocalProtocolError: it cannot be recorded; the file is as it was.
            OSError: the disk is full, ...
        """
        packet = entry.packet
        data = data_of(packet)
        channel = self._packet_channels.get((entry.agent, packet.channel, packet.type)) or self._channel(entry)
        # Published and recorded at the same moment, as far as is known: the stamp is of the mission's clock.
        self._add_message(channel, entry.time_ns, data, packet.seq & 0xFFFFFFFF)

    def add(self, topic: str, schema_name: str, schema: Mapping[str, object], time_ns: int, data: bytes) -> None:
        """Adds a message that is no packet, such as a pose in the schema of a viewer.

        Raises:
            OSError: the disk is full, ...
        """
        key = (topic, schema_name)
        if key not in self._channels:
            number = self._add_schema(schema_name, schema)
            self._channels[key] = self._mcap.register_channel(topic, "json", number)
        self._add_message(self._channels[key], time_ns, data, 0)

    def note(self, name: str, row: Mapping[str, str]) -> None:
        """Adds a metadata record.

        Raises:
            OSError: the disk is full, ...
        """
        self._mcap.add_metadata(name, dict(row))

    def is_there(self) -> bool:
        """Returns whether what is written still is the file of its name."""
        return is_still_at(self._file.fileno(), self.path)

    def is_truncated(self) -> bool:
        """Returns whether another program has made the file shorter. Nothing is written to it from then on."""
        if self._left_bytes is None:
            size = os.fstat(self._file.fileno()).st_size
            if size < self._flushed_bytes:
                self._left_bytes = size
        return self._left_bytes is not None

    def size_bytes(self) -> int:
        """Returns how large the file was after the last `flush`."""
        return self._file.tell()

    def flush(self) -> None:
        """Gives all that was written to the operating system: that is not lost where this process is killed.

        Raises:
            OSError: the disk is full, ...
        """
        self._chunk_bytes = 0
        if self.is_truncated():
            return  # behind what is left, there would be a hole
        try:
            self._mcap.flush()
            self._flushed_bytes = self._file.tell()
        except OSError:
            self._has_failed = True
            raise

    def sync(self) -> None:
        """Brings what was flushed to the disk: that is not lost where the power goes. It may take long.

        Raises:
            OSError: the disk is full, ...
        """
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Writes the index and closes the file, where that is not done yet."""
        if self._file.closed:
            return  # the next file could not be begun
        try:
            if not self._has_failed and not self.is_truncated():
                self._mcap.finish()
                self._file.flush()
                self.sync()
        finally:
            self._file.close()
            if self._left_bytes is not None and self.path.exists():
                os.truncate(self.path, self._left_bytes)  # what was noted since then lay behind a hole

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
