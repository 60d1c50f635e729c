"""Packets as they travel over a link: one head for all packets of a run."""

from __future__ import annotations

import contextlib
import random
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import msgpack
import msgspec
import numpy
import pytest
from hypothesis import given
from hypothesis import strategies as st
from seeded import for_each

from pancakes.devices import Infrared, Pose
from pancakes.durable.messages import Accept, Accepted
from pancakes.durable.record import TaskId
from pancakes.durable.register import Epoch, Identity, Register
from pancakes.errors import LocalProtocolError, RemoteProtocolError
from pancakes.mesh.codec import (
    LONGEST_REASON,
    MAX_MESSAGE_BYTES,
    PacketRun,
    RowEncoder,
    Unfit,
    encodable,
    foreign_version,
    frame,
    head_of,
    is_closed,
    messages_from_payload,
    packets_of,
    run_of,
)
from pancakes.mesh.messages import HELLO_NUMBER, Ping
from pancakes.packet import Fence, Packet, known_types, packet_type
from pancakes.util.plugins import Plugins

if TYPE_CHECKING:
    from typing import SupportsIndex

HEAD = ["system", "no such type", "a/b/c", "d", None]
ROW: list[Any] = [1.5, 7, None, {}]


def packet(body, kind="no such type", seq=7, **more):
    return Packet("system", kind, "a/b/c", "d", 1.5, seq, body, **more)


def payload_of(*packets):
    head = head_of(packets[0])
    return frame([run_of(head, [RowEncoder(head).encode(it) for it in packets])])[4:]


def read(payload):
    """Returns the messages of a link, and for each run its packets and those whose bodies do not fit."""
    return [_all_of(packets_of(it)) if isinstance(it, PacketRun) else it for it in messages_from_payload(payload)]


def _all_of(found):
    return [*found[0], *found[1]]


def raw(*rows, head=HEAD):
    return msgpack.packb([[0, *head, list(rows)]])


@packet_type("runs test open")
@dataclass(frozen=True)
class Open:
    anything: Any


@packet_type("runs test strict")
@dataclass(frozen=True)
class Strict:
    number: int

    def __post_init__(self):
        if self.number == 13:
            raise RuntimeError("unlucky")


@packet_type("runs test talks")
@dataclass(frozen=True)
class Talks:
    number: str = ""

    def __post_init__(self):
        if self.number:
            raise ValueError(f"{self.number!r} is not what it takes")


@packet_type("runs test odd")
@dataclass
class Odd:
    number: int = 1
    fixed: int = field(init=False, default=5)


@packet_type("runs test inner")
@dataclass(frozen=True)
class Tree:
    leaves: tuple[float, ...] = ()
    branches: tuple[Tree, ...] = ()


@pytest.mark.parametrize("count", [1, 15, 16, 300])
def test_a_run_of_any_length_keeps_all_and_its_order(count):
    packets = [packet(Pose(float(seq), 0.0, 0.0), "pose", seq, cause=("x/y", seq)) for seq in range(count)]
    assert read(payload_of(*packets)) == [packets]


def test_runs_and_messages_of_the_link_keep_their_order():
    head = head_of(packet(1))
    run = run_of(head, [RowEncoder(head).encode(packet(1))])
    ping = msgspec.msgpack.encode(Ping(3))
    assert read(frame([run, ping, run])[4:]) == [[packet(1)], Ping(3), [packet(1)]]


OWNER = Epoch(2, Identity("a", "ja"))
ACCEPT = Accept(
    TaskId("a", "One"),
    "count.Count",
    "client",
    Register(OWNER, 3, ((Identity("a", "ja"), Identity("b", "jb")),), promised=OWNER),
    beat=7,
    lease_s=2.0,
    state=b"state",
)
"""A body with named tuples in it."""


def test_what_is_encoded_at_once_is_what_plain_values_would_be():
    """For every registered type whose instances can be made of nothing, and some that cannot."""
    Plugins().load_packets()
    registered = [cls for cls in known_types().values() if cls.__module__.startswith("pancakes.")]
    samples = [cls() for cls in registered if not _required(cls)]
    assert len(samples) > 5
    samples += [Pose(1.0, 2.0, 3.0), Open({"a": [1, (2.0, None)]}), Odd(2), Strict(4)]
    samples += [Tree((1.0, 2.0), (Tree((3.0,)),)), Open(numpy.float64(2.0)), Open([True, b"x", {"y": ()}])]
    samples += [ACCEPT, msgspec.structs.replace(ACCEPT, state=None)]
    for sample in samples:
        for _ in range(2):  # what is known of a class is known from its second packet on
            plain = msgpack.unpackb(msgspec.msgpack.encode(encodable(sample)))
            assert plain == _by_hand(sample), sample
        encoder = RowEncoder(b"")
        for _ in range(2):
            assert msgspec.msgpack.decode(encoder.encode(packet(sample)))[3] == plain, "and so it is in less time"


def _required(cls):
    told = msgspec.inspect.type_info(cls)
    assert isinstance(told, (msgspec.inspect.DataclassType, msgspec.inspect.StructType))
    return any(info.required for info in told.fields)


def _by_hand(value):
    if hasattr(value, "__dataclass_fields__"):
        return {name: _by_hand(getattr(value, name)) for name in value.__dataclass_fields__}
    if isinstance(value, msgspec.Struct):
        return {name: _by_hand(getattr(value, name)) for name in value.__struct_fields__}
    if isinstance(value, dict):
        return {key: _by_hand(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_by_hand(item) for item in value]
    return value.item() if hasattr(value, "item") else getattr(value, "value", value)


class NamedOpen(NamedTuple):
    """A named tuple that may hold anything."""

    anything: Any


class Fails(str):
    """Fails where it is made a string."""

    def __str__(self) -> str:
        raise KeyError("fails")


NO_NUMBER: Any = object()
A_SET: Any = {1}


@pytest.mark.parametrize(
    "body",
    [{1, 2}, [{"a": {1: 2}}], [0] * 65_537, Open({1}), Open([object()]), Open(Fails("x")), Pose(A_SET, 0, NO_NUMBER)],
)
def test_what_does_not_travel_is_found_at_any_depth(body):
    for _ in range(2):
        with pytest.raises(LocalProtocolError, match="packet 7 of the type 'runs test open' from a/b/c cannot be sent"):
            RowEncoder(b"").encode(packet(body, "runs test open"))


def test_a_body_that_holds_itself_or_lacks_a_field_does_not_travel():
    @dataclass
    class Unfinished:
        number: int = field(init=False)

    endless: Any = []
    endless.append(endless)
    for body in (Pose(endless, 0.0, 0.0), Unfinished()):
        with pytest.raises(LocalProtocolError, match="packet 7 of the type 'pose' from a/b/c cannot be sent"):
            RowEncoder(b"").encode(packet(body, "pose"))


def test_packets_of_one_encoder_may_differ_in_all_but_their_head():
    bodies = [Open(1), {"anything": 2}, Open(3), Open([4]), Open(None), Open("5"), Open(6)]
    its = [packet(body, "runs test open", seq) for seq, body in enumerate(bodies)]
    head = head_of(its[0])
    encoder = RowEncoder(head)
    rows = [encoder.encode(it) for it in its]
    assert rows == [RowEncoder(head).encode(it) for it in its]
    (run,) = messages_from_payload(frame([run_of(head, rows)])[4:])
    assert isinstance(run, PacketRun)
    packets, _ = packets_of(run)
    assert [(it.seq, it.body.anything) for it in packets] == list(enumerate((1, 2, 3, [4], None, "5", 6)))


def test_the_fence_is_in_the_head():
    fences = [None, Fence("a/T", (1, "a")), Fence("a/T", (2, "a"))]
    its = [packet(1, fence=fence) for fence in fences]
    assert len({head_of(it) for it in its}) == 3
    assert [read(payload_of(it)) for it in its] == [[[it]] for it in its]


def test_named_tuples_arrive_as_what_they_were_and_one_that_does_not_fit_costs_its_packet() -> None:
    its = [packet(ACCEPT, "task.accept", seq) for seq in range(2)]
    rows = [RowEncoder(b"").encode(it) for it in its]
    plain = msgpack.unpackb(rows[0])
    plain[3]["register"][0] = [2]
    rows.insert(1, msgpack.packb(plain))
    (run,) = messages_from_payload(frame([run_of(head_of(its[0]), rows)])[4:])
    assert isinstance(run, PacketRun)
    packets, unfit = packets_of(run)
    assert [it.body for it in packets] == [ACCEPT, ACCEPT]
    assert [type(it.body.register) for it in packets] == [Register, Register]
    assert len(unfit) == 1 and "register" in unfit[0].reason


def test_closed_classes():
    def check(case):
        cls, closed = case
        assert is_closed(cls) is closed

    for_each(
        [
            (Pose, True),
            (Infrared, True),
            (Fence, True),
            (Strict, True),
            (Accepted, True),
            (Open, False),
            (Tree, False),
            (Odd, False),
            (NamedOpen, False),
        ],
        check,
    )


def test_a_number_of_numpys_travels_as_a_number_also_in_a_closed_class():
    whole: Any = numpy.int32(2)
    its = packet(Pose(numpy.float64(1.5), whole, 0.0), "pose")
    assert read(payload_of(its)) == [[packet(Pose(1.5, 2.0, 0.0), "pose")]]


def test_what_does_not_fit_its_closed_class_is_found_where_it_arrives():
    nothing: Any = None
    bad = packet(Pose(nothing, 0.0, 0.0), "pose", 1)
    ((good, unfit),) = read(payload_of(bad, packet(Pose(1.0, 0.0, 0.0), "pose", 2)))
    assert good.seq == 2 and unfit.packet.seq == 1 and "x_m" in unfit.reason


def test_a_class_whose_annotations_say_nothing_travels_as_well():
    @dataclass(frozen=True)
    class Local:
        number: SupportsIndex

    assert msgpack.unpackb(RowEncoder(b"").encode(packet(Local(3))))[3] == {"number": 3}


def test_a_body_is_what_it_was_when_it_was_encoded():
    @dataclass
    class Tally:
        number: int  # nothing asks for frozen classes

    body = Tally(1)
    encoder = RowEncoder(head_of(packet(body, "runs test tally")))
    rows = []
    for number in (1, 2):
        body.number = number
        rows.append(encoder.encode(packet(body, "runs test tally")))
    assert [msgpack.unpackb(row)[3] for row in rows] == [{"number": 1}, {"number": 2}]


def test_a_packet_that_fits_no_frame_is_refused():
    head = head_of(packet(b""))
    spare = MAX_MESSAGE_BYTES - 3 - len(head) - len(RowEncoder(head).encode(packet(bytes(70_000)))) + 70_000
    largest = packet(bytes(spare))
    assert read(payload_of(largest)) == [[largest]]
    tells = rf"it takes {MAX_MESSAGE_BYTES - 2} bytes, and a frame has room for {MAX_MESSAGE_BYTES - 3}"
    with pytest.raises(LocalProtocolError, match=tells):
        RowEncoder(head).encode(packet(bytes(spare + 1)))


def test_words_may_be_as_long_as_is_said():
    longest = "x" * 256
    packet = Packet(longest, longest, longest, longest, 0.0, 1, None, (longest, 2))
    assert read(payload_of(packet)) == [[packet]]


@pytest.mark.parametrize("words", [("", "t", "s"), ("c", "", "s"), ("c", "t", ""), ("c", "t", "s" * 257)])
def test_a_head_that_would_be_refused_is_refused_at_home(words):
    with pytest.raises(LocalProtocolError, match="1 to 256"):
        head_of(Packet(words[0], words[1], words[2], "", 0.0, 1, None))


def test_bad_runs_break_the_protocol():
    def check(data):
        with pytest.raises(RemoteProtocolError):
            read(data)

    for_each(
        [
            b"",
            b"\xc1",
            b"\x90",
            b"\x91\x90",
            b"\x91\x91\xc0",
            b"\x91\xc0",
            b"\xdd\xff\xff\xff\xff",
            b"\x91" * 3000 + b"\xc0",
            raw(ROW) + b"\xc0",
            raw(),
            raw(ROW[:3]),
            raw([*ROW, None]),
            raw(ROW, head=HEAD[:4]),
            raw(ROW, head=["", *HEAD[1:]]),
            raw(ROW, head=[*HEAD[:3], "x" * 257, None]),
            raw(ROW, head=[*HEAD[:4], ["a", 1]]),
            raw(ROW, head=[*HEAD[:4], ["a", [1]]]),
            raw(["now", *ROW[1:]]),
            raw([-1.0, *ROW[1:]]),
            raw([float("nan"), *ROW[1:]]),
            raw([1.5, -1, None, {}]),
            raw([1.5, 1, ["a"], {}]),
            raw([1.5, 1, None]),
        ],
        check,
    )


def test_bad_body_breaks_no_protocol():
    def check(data):
        ((bad,),) = read(data)
        assert isinstance(bad, Unfit) and bad.packet.body is None

    for_each(
        [
            raw([1.5, 1, None, {1: 2}]),
            raw([1.5, 1, None, {b"k": 2}]),
            raw([1.5, 1, None, [0] * 65_537]),
            raw([1.5, 1, None, {str(number): 0 for number in range(4097)}]),
            raw([1.5, 1, None, msgpack.ExtType(2, b"abc")]),
            raw([1.5, 1, None, [msgpack.Timestamp(0, 0)]]),
            raw([1.5, 1, None, {"anything": msgpack.Timestamp(0, 0)}], head=["c", "runs test open", "s", "", None]),
            raw([1.5, 1, None, {"number": "1"}], head=["c", "runs test strict", "s", "", None]),
            raw([1.5, 1, None, {"number": 13}], head=["c", "runs test strict", "s", "", None]),
        ],
        check,
    )


def test_a_bad_body_costs_its_packet_alone_and_is_told_with_its_type_its_field_and_its_source():
    good = [1.5, 1, None, {"x_m": 1.0, "y_m": 0.0, "theta_rad": 0.0}]
    bad = [1.5, 2, None, {"x_m": "far", "y_m": 0.0, "theta_rad": 0.0}]
    first, last, unfit = read(raw(good, bad, good, head=["c", "pose", "s/x", "", None]))[0]
    assert first == last == Packet("c", "pose", "s/x", "", 1.5, 1, Pose(1.0, 0.0, 0.0))
    assert re.search(r"type 'pose' .*x_m.* \(from s/x\)", unfit.reason) and unfit.packet.seq == 2


def _nested(depth: int) -> list[Any]:
    inner: list[Any] = []
    for _ in range(depth):
        inner = [inner]
    return inner


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        ("pose", {"x_m": {1: 2}}),
        ("pose", {"x_m": msgpack.ExtType(5, b"")}),
        ("runs test open", {"anything": {1: 2}}),
        ("no such type", [_nested(40)]),
        ("runs test talks", {"number": "very " * 20_000}),  # a fault that is told with what came
    ],
)
def test_whatever_is_wrong_with_a_body_is_told_in_a_sentence_that_names_it_and_is_not_long(kind, body):
    ((unfit,),) = read(raw([1.5, 1, None, body], head=["c", kind, "s/x", "", None]))
    assert f"type {kind!r}" in unfit.reason and "s/x" in unfit.reason
    assert len(unfit.reason) <= LONGEST_REASON + 100


def test_a_type_that_holds_itself_is_not_followed_for_ever():
    tree: dict[str, Any] = {"leaves": [], "branches": []}
    for _ in range(20):
        tree = {"leaves": [], "branches": [tree]}
    ((unfit,),) = read(raw([1.5, 1, None, tree], head=["c", "runs test inner", "s", "", None]))
    assert "nested deeper" in unfit.reason


def test_a_length_without_bytes_takes_no_memory():
    head = msgpack.packb(HEAD)[1:]
    for lie in (b"\xdd\x7f\xff\xff\xff", b"\xdf\x7f\xff\xff\xff", b"\xc6\x7f\xff\xff\xff", b"\xc9\x7f\xff\xff\xff\x01"):
        for data in (b"\x91\x97\x00" + head + lie, b"\x91\x97\x00" + head + b"\x91\x94\xca\0\0\0\0\x01\xc0" + lie):
            with pytest.raises(RemoteProtocolError):
                read(data)


@given(st.binary(min_size=1, max_size=200))
def test_any_bytes_are_read_or_refused(data):
    with contextlib.suppress(RemoteProtocolError):
        read(data)


@pytest.mark.parametrize("kind", ["no such type", "pose", "runs test open"])
def test_frames_with_a_broken_bit_are_read_or_refused(kind):
    bodies = {"pose": Pose(1.0, 2.0, 3.0), "runs test open": Open({"image": numpy.arange(6.0)})}
    its = packet(bodies.get(kind, {"a": [1, "b"]}), kind, cause=("x/y", 3), fence=Fence("a/b", (1, "a")))
    good = payload_of(its, its)
    source = random.Random(1)
    for _ in range(2000):
        broken = bytearray(good)
        broken[source.randrange(len(broken))] ^= 1 << source.randrange(8)
        with contextlib.suppress(RemoteProtocolError):
            read(bytes(broken))


def test_version_of_a_hello_in_another_form():
    def check(case):
        rows, version = case
        assert foreign_version(msgpack.packb(rows), 2) == version

    for_each(
        [
            ([[HELLO_NUMBER, 7, {"all": "new"}]], 7),
            ([[HELLO_NUMBER]], "unknown"),
            ([[HELLO_NUMBER, "seven"]], "unknown"),
            ([[HELLO_NUMBER, 2, "f"]], None),
            ([[3, 7]], None),
            ([[1, 7], 5], 7),
            ([5, [1, 7]], None),
            ([], None),
        ],
        check,
    )
