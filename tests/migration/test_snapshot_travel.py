"""Records and snapshots as bytes, messages as packets, snapshots in pieces."""

from __future__ import annotations

import random

import msgpack
import msgspec
import pytest
from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.durable import messages
from pancakes.durable.messages import Abort, Piece, Reserve, Solicit, Transfer, addressed, is_for
from pancakes.durable.record import Epoch, Phase, Record, TaskId, Wanted
from pancakes.durable.snapshot import (
    LIMIT_BYTES,
    MOST_BYTES,
    MOST_HALF,
    PIECE_BYTES,
    Assembly,
    Posted,
    PostedTo,
    Snapshot,
    cut,
)
from pancakes.errors import MigrationError, RemoteProtocolError
from pancakes.packet import body_from_plain, known_types, type_name

SCAN = TaskId("agent1", "ScanTarget")
OFFER = Epoch(1, "agent1")
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


def test_a_record_comes_back_as_it_was_written() -> None:
    record = Record(SCAN, Phase.FROZEN, Epoch(0, "agent1"), OFFER, OFFER, "agent2", Wanted.RUNNING, 2, b"snapshot")
    assert Record.decode(record.encode()) == record


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


def test_epochs_are_ordered_by_number_and_then_by_minter() -> None:
    epochs = [Epoch(2, "a"), Epoch(1, "b"), Epoch(1, "a")]
    assert sorted(epochs) == [Epoch(1, "a"), Epoch(1, "b"), Epoch(2, "a")]


def test_every_message_travels_as_a_packet() -> None:
    request = Solicit(SCAN, 1, "encirclement.ScanTarget", "0.1.0", "client", ("pose",), "tasks", 0.65)
    samples = [
        request,
        messages.Bid(SCAN, 1, 2.0, {"active tasks": 2.0}),
        messages.Refuse(SCAN, 1, Refusal("unsupported", "lacks the device type motors")),
        Reserve(SCAN, OFFER, request),
        *cut(Transfer(SCAN, OFFER, b"snapshot")),
        messages.Nak(SCAN, OFFER, Refusal("busy", "no", 1.5)),
        *(
            kind(SCAN, OFFER)
            for kind in (
                messages.Reserved,
                messages.Prepared,
                messages.Commit,
                messages.Activated,
                Abort,
                messages.Unknown,
            )
        ),
    ]
    kinds = [name for name in known_types() if name.startswith("migration.") and name != "migration.ledger"]
    assert sorted(type_name(sample) for sample in samples) == kinds
    for sample in samples:
        plain = msgpack.unpackb(msgspec.msgpack.encode(sample))
        assert body_from_plain(type_name(sample), plain) == sample


def test_a_message_is_believed_by_the_journal_that_it_was_meant_for_alone() -> None:
    message = addressed(Abort(SCAN, OFFER), "uuid-1")
    assert is_for(message, "uuid-1")
    assert not is_for(message, "uuid-2")
    assert not is_for(Abort(SCAN, OFFER), "uuid-1")


@pytest.mark.parametrize("size", [0, 1, PIECE_BYTES, PIECE_BYTES + 1, 5 * PIECE_BYTES])
def test_pieces_come_together_in_any_order_and_more_than_once(size: int) -> None:
    transfer = Transfer(SCAN, OFFER, random.Random(size).randbytes(size))
    pieces = cut(transfer)
    assert max(len(piece.data) for piece in pieces) == min(size, 64 * 1024)
    random.Random(1).shuffle(pieces)
    assembly = Assembly()
    wholes = [assembly.add("agent1", piece) for piece in [*pieces[:-1], *pieces[:-1], pieces[-1]]]
    assert wholes[-1] == transfer
    if len(pieces) > 1:
        assert wholes[:-1] == [None] * (len(wholes) - 1)


def test_a_damaged_snapshot_is_refused() -> None:
    (piece,) = cut(Transfer(SCAN, OFFER, b"snapshot"))
    with pytest.raises(RemoteProtocolError, match="damaged"):
        Assembly().add("agent1", replace(piece, data=b"snapshoT"))


@pytest.mark.parametrize(
    "changes",
    [{"size_bytes": LIMIT_BYTES + 1}, {"size_bytes": -1}, {"index": 3}, {"index": -1}, {"count": 9}, {"data": b"x"}],
    ids=str,
)
def test_an_impossible_piece_is_refused(changes: dict[str, object]) -> None:
    piece = cut(Transfer(SCAN, OFFER, bytes(3 * PIECE_BYTES)))[1]
    with pytest.raises(RemoteProtocolError):
        Assembly().add("agent1", replace(piece, **changes))


@pytest.mark.parametrize("size_bytes", [LIMIT_BYTES + 1, 2**60])
def test_a_snapshot_that_may_not_travel_is_refused_by_what_its_first_piece_says(size_bytes: int) -> None:
    """Although it fits itself: nothing of it is kept."""
    (first, *_) = cut(Transfer(SCAN, OFFER, bytes(2 * PIECE_BYTES)))
    claims = replace(first, size_bytes=size_bytes, count=-(-size_bytes // PIECE_BYTES))
    with pytest.raises(RemoteProtocolError, match=f"a snapshot of {size_bytes} bytes, {LIMIT_BYTES} may travel"):
        Assembly().add("agent1", claims)


def test_pieces_of_two_peers_are_not_put_together() -> None:
    first, second = cut(Transfer(SCAN, OFFER, bytes(2 * PIECE_BYTES)))
    assembly = Assembly()
    assert assembly.add("agent1", first) is None
    assert assembly.add("agent2", second) is None
    assert assembly.add("agent2", first) is not None, "it is whole by what agent2 alone has sent"


def test_a_newer_offer_replaces_an_unfinished_one_and_an_older_is_ignored() -> None:
    old = cut(Transfer(SCAN, OFFER, bytes(2 * PIECE_BYTES)))
    new = cut(Transfer(SCAN, Epoch(2, "agent1"), bytes(2 * PIECE_BYTES)))
    assembly = Assembly()
    assert assembly.add("agent1", old[0]) is None
    assert assembly.add("agent1", new[0]) is None
    assert assembly.add("agent1", old[1]) is None
    whole = assembly.add("agent1", new[1])
    assert whole is not None and whole.offer == Epoch(2, "agent1")


def test_pieces_of_a_peer_that_is_gone_are_dropped() -> None:
    first, second = cut(Transfer(SCAN, OFFER, bytes(2 * PIECE_BYTES)))
    assembly = Assembly()
    assembly.add("agent1", first)
    assembly.drop("agent1")
    assert assembly.add("agent1", second) is None


def test_pieces_of_what_was_decided_are_dropped() -> None:
    first, second = cut(Transfer(SCAN, OFFER, bytes(2 * PIECE_BYTES)))
    assembly = Assembly()
    assembly.add("agent1", first)
    assembly.end("agent2", SCAN)  # which had offered it before
    assert assembly.add("agent1", second) is not None
    assembly.add("agent1", first)
    assembly.end("agent1", SCAN)
    assert assembly.add("agent1", second) is None


def test_a_piece_of_another_whole_does_not_fit() -> None:
    first: Piece = cut(Transfer(SCAN, OFFER, bytes(2 * PIECE_BYTES)))[0]
    other = cut(Transfer(SCAN, OFFER, b"\x01" * 2 * PIECE_BYTES))[1]
    assembly = Assembly()
    assembly.add("agent1", first)
    with pytest.raises(RemoteProtocolError, match="does not fit"):
        assembly.add("agent1", other)


def test_of_each_peer_so_many_snapshots_may_be_on_their_way() -> None:
    assembly = Assembly()
    begun = [cut(Transfer(TaskId("agent1", f"T{number}"), OFFER, bytes(2 * PIECE_BYTES))) for number in range(5)]
    for pieces in begun[:MOST_HALF]:
        assembly.add("agent1", pieces[0])
    with pytest.raises(RemoteProtocolError, match="while 4 of its snapshots are on their way"):
        assembly.add("agent1", begun[MOST_HALF][0])
    assert assembly.add("agent2", begun[MOST_HALF][0]) is None, "another peer has a count of its own"
    assert assembly.add("agent1", begun[0][1]) is not None
    assembly.drop("agent2")
    assert assembly.add("agent1", begun[MOST_HALF][0]) is None


def test_of_each_peer_so_many_bytes_may_be_on_their_way() -> None:
    assembly = Assembly()
    large = [cut(Transfer(TaskId("agent1", f"T{number}"), OFFER, bytes(LIMIT_BYTES)))[0] for number in range(3)]
    for piece in large[:2]:
        assembly.add("agent1", piece)
    with pytest.raises(RemoteProtocolError, match=f"of {MOST_BYTES} bytes"):
        assembly.add("agent1", large[2])
