"""Records and snapshots as bytes, messages as packets, snapshots in pieces."""

from __future__ import annotations

import random

import msgpack
import msgspec
import pytest
from msgspec.structs import replace

from pancakes.durable.messages import Piece
from pancakes.durable.record import Record, TaskId
from pancakes.durable.register import Epoch, Identity
from pancakes.durable.snapshot import (
    LIMIT_BYTES,
    MOST_HALF,
    PIECE_BYTES,
    Assembly,
    Posted,
    PostedTo,
    Snapshot,
    cut,
)
from pancakes.errors import MigrationError, RemoteProtocolError

SCAN = TaskId("agent1", "ScanTarget")
OWNER = Identity("agent1")
OFFER = (Epoch(1, OWNER), 4)
SNAPSHOT = Snapshot(
    SCAN,
    "encirclement.ScanTarget",
    "0.1.0",
    "client",
    requires=("pose", "motors"),
    settings={"radius_m": 0.55},
    state={"centre_m": [0.0, 0.1], "revolutions": 1.5},
    periods_s={"report": 0.5},
    posted=Posted("agent1/uuid.1/3", (PostedTo("agent3/Scout", "agent3", 2, 9, (b"packet",), 2),)),
    heard={"agent3/client/Scout": 6},
    restart={"policy": "always"},
    migrate={"when": "battery", "below": 0.65},
)


def test_a_snapshot_comes_back_as_it_was_written() -> None:
    assert Snapshot.decode(SNAPSHOT.encode()) == SNAPSHOT


@pytest.mark.parametrize(
    ("kept", "read"),
    [
        ("permanent", "always"),
        ("transient", "on-failure"),
        ("temporary", "no"),
        ("no", "no"),
        ("daily", "daily"),
        ([], []),
    ],
)
def test_the_former_words_for_restarts_are_read(kept: object, read: object) -> None:
    snapshot = msgspec.structs.replace(SNAPSHOT, restart={"policy": kept, "at_most": 3})
    assert Snapshot.decode(snapshot.encode()).restart == {"policy": read, "at_most": 3}


def test_snapshot_with_the_former_key_of_a_guard_is_read() -> None:
    snapshot = msgspec.structs.replace(SNAPSHOT, guard={"guard": 5, "lease_s": 2.0})
    assert Snapshot.decode(snapshot.encode()).guard == {"copies": 5, "lease_s": 2.0}


@pytest.mark.parametrize("data", [b"", b"\xc1", msgpack.packb([1]), msgpack.packb({"task_id": ["agent1", 3]})])
def test_what_is_no_record_or_snapshot_is_refused_with_a_sentence(data: bytes) -> None:
    with pytest.raises(MigrationError, match="no record"):
        Record.decode(data)
    with pytest.raises(MigrationError, match="no snapshot"):
        Snapshot.decode(data)


def test_a_snapshot_that_is_too_large_or_not_plain_is_refused() -> None:
    with pytest.raises(MigrationError, match="16777216 may travel"):
        msgspec.structs.replace(SNAPSHOT, state={"map": bytes(LIMIT_BYTES)}).encode()
    with pytest.raises(MigrationError, match="16777216 may travel"):
        Snapshot.decode(bytes(LIMIT_BYTES + 1))
    with pytest.raises(
        MigrationError, match=r"agent1/ScanTarget cannot be written as a snapshot: state.odd\[1\].x: it"
    ):
        msgspec.structs.replace(SNAPSHOT, state={"odd": [1, {"x": object()}]}).encode()


@pytest.mark.parametrize("text", ["ScanTarget", "agent1/", "/ScanTarget", "agent1/client/ScanTarget", ""])
def test_a_task_id_reads_birthplace_and_name(text: str) -> None:
    assert TaskId.parse(str(SCAN)) == SCAN
    with pytest.raises(MigrationError, match="birthplace/name"):
        TaskId.parse(text)


@pytest.mark.parametrize("size", [0, 1, PIECE_BYTES, PIECE_BYTES + 1, 5 * PIECE_BYTES])
def test_pieces_come_together_in_any_order_and_more_than_once(size: int) -> None:
    state = random.Random(size).randbytes(size)
    pieces = cut(SCAN, OFFER, state)
    assert max(len(piece.data) for piece in pieces) == min(size, 64 * 1024)
    random.Random(1).shuffle(pieces)
    assembly = Assembly()
    wholes = [assembly.add("agent1", piece) for piece in [*pieces[:-1], *pieces[:-1], pieces[-1]]]
    assert wholes[-1] == state
    if len(pieces) > 1:
        assert wholes[:-1] == [None] * (len(wholes) - 1)


def test_a_damaged_snapshot_is_refused() -> None:
    (piece,) = cut(SCAN, OFFER, b"snapshot")
    with pytest.raises(RemoteProtocolError, match="damaged"):
        Assembly().add("agent1", replace(piece, data=b"snapshoT"))


@pytest.mark.parametrize(
    "changes",
    [{"size_bytes": LIMIT_BYTES + 1}, {"size_bytes": -1}, {"index": 3}, {"index": -1}, {"count": 9}, {"data": b"x"}],
    ids=str,
)
def test_an_impossible_piece_is_refused(changes: dict[str, object]) -> None:
    piece = cut(SCAN, OFFER, bytes(3 * PIECE_BYTES))[1]
    with pytest.raises(RemoteProtocolError):
        Assembly().add("agent1", replace(piece, **changes))


@pytest.mark.parametrize("size_bytes", [LIMIT_BYTES + 1, 2**60])
def test_a_snapshot_that_may_not_travel_is_refused_by_what_its_first_piece_says(size_bytes: int) -> None:
    """Although it fits itself: nothing of it is kept."""
    (first, *_) = cut(SCAN, OFFER, bytes(2 * PIECE_BYTES))
    claims = replace(first, size_bytes=size_bytes, count=-(-size_bytes // PIECE_BYTES))
    with pytest.raises(RemoteProtocolError, match=f"a snapshot of {size_bytes} bytes, {LIMIT_BYTES} may travel"):
        Assembly().add("agent1", claims)


def test_pieces_of_two_peers_are_not_put_together() -> None:
    first, second = cut(SCAN, OFFER, bytes(2 * PIECE_BYTES))
    assembly = Assembly()
    assert assembly.add("agent1", first) is None
    assert assembly.add("agent2", second) is None
    assert assembly.add("agent2", first) is not None, "it is whole by what agent2 alone has sent"


def test_a_newer_offer_replaces_an_unfinished_one_and_an_older_is_ignored() -> None:
    old = cut(SCAN, OFFER, bytes(2 * PIECE_BYTES))
    new = cut(SCAN, (OFFER[0], 5), b"\x01" * 2 * PIECE_BYTES)
    assembly = Assembly()
    assert assembly.add("agent1", old[0]) is None
    assert assembly.add("agent1", new[0]) is None
    assert assembly.add("agent1", old[1]) is None
    assert assembly.add("agent1", new[1]) == b"\x01" * 2 * PIECE_BYTES


def test_pieces_of_a_peer_that_is_gone_are_dropped() -> None:
    first, second = cut(SCAN, OFFER, bytes(2 * PIECE_BYTES))
    assembly = Assembly()
    assembly.add("agent1", first)
    assembly.drop("agent1")
    assert assembly.add("agent1", second) is None


def test_a_piece_of_another_whole_does_not_fit() -> None:
    first: Piece = cut(SCAN, OFFER, bytes(2 * PIECE_BYTES))[0]
    other = cut(SCAN, OFFER, b"\x01" * 2 * PIECE_BYTES)[1]
    assembly = Assembly()
    assembly.add("agent1", first)
    with pytest.raises(RemoteProtocolError, match="does not fit"):
        assembly.add("agent1", other)


def test_what_a_peer_began_first_gives_way_if_too_many_are_on_their_way() -> None:
    assembly = Assembly()
    begun = [cut(TaskId("agent1", f"T{number}"), OFFER, bytes(2 * PIECE_BYTES)) for number in range(MOST_HALF + 1)]
    for pieces in begun:
        assembly.add("agent1", pieces[0])
    assert assembly.add("agent2", begun[0][0]) is None, "another peer has a count of its own"
    assert assembly.add("agent1", begun[1][1]) is not None
    assert assembly.add("agent1", begun[0][1]) is None, "its first piece was forgotten"


def test_what_a_peer_began_first_gives_way_if_too_many_bytes_are_on_their_way() -> None:
    assembly = Assembly()
    large = [cut(TaskId("agent1", f"T{number}"), OFFER, bytes(LIMIT_BYTES))[0] for number in range(3)]
    for piece in large:
        assembly.add("agent1", piece)
    assert [assembly.has(piece.task_id) for piece in large] == [False, True, True]
