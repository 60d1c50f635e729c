"""Bytes that are nested thousands deep get a sentence from each reader of bytes from outside, and never a traceback."""

from __future__ import annotations

import fcntl
from hashlib import sha256
from pathlib import Path
from typing import Any

import msgspec
import pytest

from pancakes.control import Stop
from pancakes.durable.after_migration import Sequel
from pancakes.durable.record import Record
from pancakes.durable.snapshot import Snapshot
from pancakes.errors import MigrationError, PancakesError, RemoteProtocolError
from pancakes.journal.journal import DamagedEntryError, JournalEntry, seal, unseal
from pancakes.mesh.codec import frame, messages_from_payload
from pancakes.packet import type_name
from pancakes.recording.message_format import packet_from_data
from pancakes.sim.hardware_bus import Attach, Refused, ReplyReader, RequestReader
from pancakes.tools.cli.verbs.publish import BadBodyError, body_of
from pancakes.tools.demo.mission_record import read_events
from pancakes.util.runtime_dir import entries, runtime_dir

DEPTH = 50_000
LIST = b"\x91" * DEPTH + b"\xc0"
MAP = b"\x82\xa1x" + LIST + b"\xa1y\xc0"
"""A field that nobody knows, whose value nobody reads."""
STATE = b"\x82\xa7task_id\x92\xa1a\xa1b\xa8register\x97\x92\x00\x91\xa1a\x00\x90\x00\x91\xa1a\xa7running" + LIST
"""A record whose state is nested."""
JSON = b"[" * DEPTH + b"]" * DEPTH


@pytest.mark.parametrize(("thing", "data"), [(Record, STATE), (Snapshot, MAP), (Sequel, MAP)])
def test_of_a_journal_and_of_a_migration(thing: Any, data: bytes):
    with pytest.raises(MigrationError, match=r"these \d+ bytes .*: it is nested too deep"):
        thing.decode(data)


def test_in_the_file_of_a_journal():
    sealed = seal("journal", JournalEntry("task", "T", b""))
    digests = [sha256(sealed[end:]).digest() for end in range(len(sealed))]
    begin = next(end for end, digest in enumerate(digests) if sealed[:end].endswith(digest))
    magic = sealed[: begin - len(digests[0])]
    more = bytes([sealed[begin] + 1]) + sealed[begin + 1 :] + LIST
    with pytest.raises(DamagedEntryError, match="it is nested too deep"):
        unseal("", magic + sha256(more).digest() + more)


@pytest.mark.parametrize(
    ("reader", "message"), [(RequestReader, Attach("a", "b", "motors", "")), (ReplyReader, Refused("a", "no"))]
)
def test_from_a_simulated_world_and_to_it(reader: Any, message: Any):
    encoded = msgspec.msgpack.encode(message)
    with pytest.raises(RemoteProtocolError, match="simulated world: it is nested too deep"):
        reader().feed(frame([bytes([encoded[0] + 1]) + encoded[1:] + LIST]))


def test_in_a_frame_of_a_link():
    with pytest.raises(RemoteProtocolError, match="a frame is malformed: it is nested too deep"):
        messages_from_payload(b"\x91\x97\x00\xa1a\xa1b\xa1c\xa1d\xc0" + LIST)


def test_in_a_recording():
    with pytest.raises(RemoteProtocolError, match="a recorded packet of the type 'x' is malformed"):
        packet_from_data("log", "x", b'{"body": ' + JSON + b"}")


def test_on_the_command_line():
    with pytest.raises(BadBodyError, match="the body is not JSON: it is nested too deep"):
        body_of(type_name(Stop("x")), JSON.decode())


def test_in_the_events_of_a_demo(tmp_path: Path):
    (tmp_path / "events.jsonl").write_bytes(JSON + b"\n")
    with pytest.raises(PancakesError, match=r"events.jsonl: line 1 is not an event: it is nested too deep"):
        read_events(tmp_path)


def test_in_the_runtime_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(tmp_path / "runtime"))
    entries()
    runtime_dir().mkdir(mode=0o700, exist_ok=True)
    path = runtime_dir() / "deep.7.json"
    path.write_bytes(b'{"x": ' + JSON[:20_000] + JSON[-20_000:] + b"}")
    with path.open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert entries() == []
