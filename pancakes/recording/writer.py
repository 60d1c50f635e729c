"""Writes one MCAP file of a recording, in small chunks, so that a crash costs no more than the last of them."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from mcap.writer import CompressionType, IndexType, Writer

from pancakes import __version__
from pancakes.recording.entry import SCHEMAS, Entry, EntryEncoder, schema_for

CHUNK_BYTES: Final = 16 * 1024
"""With mcap's own chunks of 1 MiB a recorder that was killed after 3 s left nothing."""
PROFILE: Final = ""
LIBRARY: Final = f"pancakes {__version__}"
METADATA: Final = "pancakes"


class RecordingWriter:
    """One file that is being written. In one thread.

    Args:
        path: where; must not be there yet.
        about: what is to be known about the recording, such as `agent` and `clock`.

    Attributes:
        path: where.
        messages: how many packets are in it.

    Raises:
        OSError: the file cannot be made.
    """

    def __init__(self, path: Path, about: Mapping[str, str]) -> None:
        self.path = path
        self.messages = 0
        self._file = path.open("xb")
        # Compression costs more processor time than it saves disk.
        self._writer = Writer(
            self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.NONE, index_types=IndexType.ALL
        )
        self._writer.start(profile=PROFILE, library=LIBRARY)
        self._writer.add_metadata(METADATA, dict(about))
        self._encoder = EntryEncoder()
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}

    def write(self, entry: Entry) -> None:
        """Adds a packet.

        Raises:
            LocalProtocolError: it holds what no packet may hold; the file is as it was.
            OSError: the disk is full, ...
        """
        data = self._encoder.data(entry.packet)
        channel = self._channel(entry.topic, entry.packet.type)
        # Published and recorded at the same moment, as far as is known: the stamp is of the mission's clock.
        self._writer.add_message(channel, entry.time_ns, data, entry.time_ns, entry.packet.seq & 0xFFFFFFFF)
        self.messages += 1

    def add(self, topic: str, schema_name: str, schema: Mapping[str, object], time_ns: int, data: bytes) -> None:
        """Adds a message that is no packet, such as a pose in the schema of a viewer.

        Raises:
            OSError: the disk is full, ...
        """
        key = (topic, schema_name)
        if key not in self._channels:
            number = self._writer.register_schema(schema_name, "jsonschema", json.dumps(schema).encode())
            self._channels[key] = self._writer.register_channel(topic, "json", number)
        self._writer.add_message(self._channels[key], time_ns, data, time_ns)
        self.messages += 1

    def size_bytes(self) -> int:
        """Returns how large the file is so far."""
        return self._file.tell()

    def flush(self) -> None:
        """Brings all that was written to the disk; what comes before survives a crash.

        Raises:
            OSError: the disk is full, ...
        """
        self._writer.flush()
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Writes the index and closes the file."""
        try:
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
        finally:
            self._file.close()

    def _channel(self, topic: str, type_name: str) -> int:
        name = SCHEMAS + type_name
        number = self._channels.get((topic, name))
        if number is None:
            if type_name not in self._schemas:
                schema = json.dumps(schema_for(type_name)).encode()
                self._schemas[type_name] = self._writer.register_schema(name, "jsonschema", schema)
            number = self._writer.register_channel(topic, "json", self._schemas[type_name])
            self._channels[topic, name] = number
        return number
