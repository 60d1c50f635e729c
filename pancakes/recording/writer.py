"""Writes one MCAP file of a recording; a process that is killed costs it what came after the last flush, no more."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Final

from pancakes import __version__
from pancakes.recording.chunks import ChunkedFile
from pancakes.recording.entry import Entry
from pancakes.recording.message import data_of
from pancakes.recording.schemas import SCHEMAS, schema_for

CHUNK_BYTES: Final = 128 * 1024
"""Ending a chunk costs as much as ten messages. `flush` ends one too: whoever is killed costs what came after that."""
LIBRARY: Final = f"pancakes {__version__}"
METADATA: Final = "pancakes"


class RecordingWriter:
    """One file that is being written. In one thread.

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
        with suppress(OSError):  # a file system without locks: who repairs there has to know
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        try:
            self._chunks = ChunkedFile(self._file, LIBRARY, CHUNK_BYTES)
            self._chunks.add_metadata(METADATA, about)
            self._file.flush()  # whoever is killed now leaves a file that is one
        except OSError:
            path.unlink()  # nobody could read it
            with suppress(OSError):  # which is said already
                self._file.close()
            raise
        self._packet_channels: dict[tuple[str, str, str], int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}

    def write(self, entry: Entry) -> None:
        """Adds a packet.

        Raises:
            LocalProtocolError: it cannot be recorded; the file is as it was.
            OSError: the disk is full, ...; it is written where a later call succeeds.
        """
        packet = entry.packet
        data = data_of(packet)
        channel = self._packet_channels.get((entry.agent, packet.channel, packet.type)) or self._channel(entry)
        # Published and recorded at the same moment, as far as is known: the stamp is of the mission's clock.
        self._chunks.add_message(channel, entry.time_ns, data, packet.seq & 0xFFFFFFFF)

    def add(self, topic: str, schema_name: str, schema: Mapping[str, object], time_ns: int, data: bytes) -> None:
        """Adds a message that is no packet, such as a pose in the schema of a viewer.

        Raises:
            OSError: the disk is full, ...
        """
        key = (topic, schema_name)
        if key not in self._channels:
            number = self._chunks.add_schema(schema_name, json.dumps(schema).encode())
            self._channels[key] = self._chunks.add_channel(topic, number)
        self._chunks.add_message(self._channels[key], time_ns, data)

    def size_bytes(self) -> int:
        """Returns how large the file is so far."""
        return self._chunks.size_bytes()

    def flush(self) -> None:
        """Gives all that was written to the operating system: that is not lost where this process is killed.

        Raises:
            OSError: the disk is full, ...
        """
        self._chunks.end_chunk()
        self._file.flush()

    def sync(self) -> None:
        """Brings what was flushed to the disk: that is not lost where the power goes. It may take long.

        Raises:
            OSError: the disk is full, ...
        """
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Writes the index and closes the file, where that is not done yet."""
        if self._file.closed:
            return  # the next one could not be begun
        try:
            self._chunks.finish()
            self._file.flush()
            self.sync()
        finally:
            self._file.close()

    def _channel(self, entry: Entry) -> int:
        packet = entry.packet
        if packet.type not in self._schemas:
            schema = json.dumps(schema_for(packet.type)).encode()
            self._schemas[packet.type] = self._chunks.add_schema(SCHEMAS + packet.type, schema)
        number = self._chunks.add_channel(entry.topic, self._schemas[packet.type])
        self._packet_channels[entry.agent, packet.channel, packet.type] = number
        return number
