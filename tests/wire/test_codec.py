"""What travels, what does not, and what is refused when it comes in."""

from __future__ import annotations

import contextlib
import enum
import itertools
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import msgpack
import numpy
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from seeded import for_each

from pancakes.devices import Infrared, Pose
from pancakes.errors import LocalProtocolError, RemoteProtocolError
from pancakes.mesh.codec import (
    MAX_ARRAY_LENGTH,
    MAX_DEPTH,
    MAX_MAP_LENGTH,
    MAX_MESSAGE_BYTES,
    PacketRun,
    RowEncoder,
    encodable,
    encode_link_message,
    encode_packet,
    frame,
    head_of,
    messages_from_payload,
    of_agent,
    packet_from_row,
    packets_of,
    rows_from_payload,
    run_of,
)
from pancakes.mesh.messages import HELLO_NUMBER, AgentSeen, Gossip, Hello, Identity, Ping
from pancakes.packet import Fence, Packet, packet_type


class Colour(enum.Enum):
    RED = "red"


@dataclass(frozen=True)
class Inner:
    colour: Colour
    places: tuple[tuple[float, float], ...] = ()


@packet_type("codec test outer")
@dataclass(frozen=True)
class Outer:
    inner: Inner
    by_name: dict[str, Inner] = field(default_factory=dict)
    image: Any = None


def packet(body, kind="no such type", **more):
    return Packet("system", kind, "a/b/c", "d", 1.5, 7, body, **more)


def there_and_back(it):
    """Over a link; by itself, as a letter or a recording has it, it must become the same."""
    (row,) = rows_from_payload(frame([encode_packet(it)])[4:])
    head = head_of(it)
    (run,) = messages_from_payload(frame([run_of(head, [RowEncoder(head).encode(it)])])[4:])
    assert isinstance(run, PacketRun)
    packets, unfit = packets_of(run)
    for it in unfit:
        raise RemoteProtocolError(it.reason)
    (came,) = packets
    assert repr(came) == repr(packet_from_row(row))
    return came


def payload(*rows):
    return msgpack.packb(list(rows))


def body(it):
    return payload([*ROW[:7], it, None])


def read(data):
    return [packet_from_row(row) for row in rows_from_payload(data)]


EPOCH = msgpack.Timestamp(0, 0)
ROW = ["system", "t", "a/b/c", "d", 1.5, 7, None, {}, None]


def test_all_of_a_packet_travels():
    it = packet(Pose(1.0, -2.0, 0.5), "pose", cause=("x/y/z", 3), fence=Fence("a/GoHome", (2, "b")))
    assert there_and_back(it) == it


def test_the_source_of_a_packet_that_waits_moves_to_another_agent_whose_mission_time_it_bears():
    def restamped(agent, stamp_s):
        return {"a": stamp_s + 10.0, "b": stamp_s}[agent]

    sent = Packet("chat", "words", "a/client/T", "task:a/Sink", 1.5, 7, {"n": [1, 2]}, ("a/client/S", 3), None)
    moved = of_agent(encode_packet(sent), "b", restamped)
    assert moved == encode_packet(replace(sent, source="b/client/T", stamp_s=11.5))
    assert of_agent(moved, "b", restamped) == moved
    for no_packet in (b"", b"\xc1", b"\x91\x01", b"\x93\x01\x02\x03"):
        assert of_agent(no_packet, "b", restamped) == no_packet


def test_nested_dataclasses_enums_and_tuples_become_what_they_were():
    inner = Inner(Colour.RED, ((1.0, 2.0), (3.0, 4.0)))
    it = packet(Outer(inner, {"one": inner}), "codec test outer")
    assert there_and_back(it) == it


def test_a_body_of_an_unknown_type_stays_a_mapping():
    assert there_and_back(packet(Inner(Colour.RED))).body == {"colour": "red", "places": []}


def test_arrays_travel_and_come_read_only():
    def check(case):
        dtype, shape = case
        array = (numpy.arange(numpy.prod(shape, dtype=int)) % 2).reshape(shape).astype(dtype)
        came = there_and_back(packet({"array": array})).body["array"]
        assert came.dtype == array.dtype and came.shape == array.shape
        assert numpy.array_equal(came, array)
        assert not came.flags.writeable

    for_each(
        itertools.product(
            ["bool", "uint8", "int64", "float16", "float32", "float64", ">f4", "complex128"],
            [(), (0,), (5,), (2, 3), (2, 1, 4)],
        ),
        check,
    )


def test_arrays_within_dataclasses_and_slices_of_arrays_travel():
    image = numpy.arange(24).reshape(4, 6)[::2, 1::2]
    came = there_and_back(packet(Outer(Inner(Colour.RED), image=image), "codec test outer"))
    assert numpy.array_equal(came.body.image, image)


def test_numbers_of_numpy_become_numbers():
    body = [numpy.float32(0.5), numpy.int64(3), numpy.bool_(True), numpy.float64(1.5)]
    assert there_and_back(packet(body)).body == [0.5, 3, True, 1.5]


class Number(enum.IntEnum):
    ONE = 1


class Place(NamedTuple):
    x_m: float
    y_m: float


class Fails(str):
    """Fails where it is made a string."""

    def __str__(self) -> str:
        raise KeyError("fails")


def test_named_tuples_enums_of_ints_and_the_like_become_plain():
    body = [Place(1.0, 2.0), Number.ONE, bytearray(b"b"), OrderedDict(a=1)]
    assert there_and_back(packet(body)).body == [[1.0, 2.0], 1, b"b", {"a": 1}]


def test_packet_that_cannot_travel_is_named():
    def check(case):
        body, problem = case
        with pytest.raises(LocalProtocolError, match=problem) as caught:
            encode_packet(packet(body))
        assert "packet 7 of the type 'no such type' from a/b/c cannot be sent" in str(caught.value)

    for_each(
        [
            ({"a": {1, 2}}, r"its body\.a is of the type set"),
            ([1, object()], r"its body\[1\] is of the type object"),
            ({1: 2}, "the key 1"),
            ({"a": {b"k": 2}}, r"its body\.a has the key b'k'"),
            (2**64, "ints"),
            ("\ud800", "surrogates"),
            (msgpack.ExtType(5, b""), "of the type ExtType"),
            (numpy.array(["text"]), "only numbers and booleans"),
            (numpy.array([None]), "only numbers and booleans"),
            (numpy.zeros(2, dtype=[("a", "f4")]), "only numbers and booleans"),
            ([0] * (MAX_ARRAY_LENGTH + 1), "list of 65537"),
            ({str(number): 0 for number in range(MAX_MAP_LENGTH + 1)}, "map of 4097"),
            (bytes(MAX_MESSAGE_BYTES), "a frame has room"),
            ([Fails("x")], r"KeyError: 'fails' at test_codec.py:\d+ in __str__"),
        ],
        check,
    )


def test_encoding_goes_on_after_an_error():
    before = encode_packet(packet(1))
    with pytest.raises(LocalProtocolError):
        encode_packet(packet([1, 2, 2**64]))
    assert encode_packet(packet(1)) == before


def nested(depth):
    body: Any = 0
    for _ in range(depth):
        body = [body]
    return body


def test_what_the_encoder_lets_pass_the_decoder_takes_to_the_last_level():
    deepest = nested(MAX_DEPTH - 2)  # the frame and the packet are two levels
    assert there_and_back(packet(deepest)).body == deepest
    with pytest.raises(LocalProtocolError, match="nested deeper"):
        encode_packet(packet(nested(MAX_DEPTH - 1)))
    with pytest.raises(RemoteProtocolError, match="nested deeper"):
        read(body(nested(MAX_DEPTH - 1)))


def test_the_longest_packet_that_is_let_pass_is_taken():
    spare = MAX_MESSAGE_BYTES - len(encode_packet(packet(bytes(MAX_MESSAGE_BYTES - 100))))
    largest = packet(bytes(MAX_MESSAGE_BYTES - 100 + spare))
    (row,) = rows_from_payload(frame([encode_packet(largest)])[4:])
    assert packet_from_row(row) == largest
    with pytest.raises(LocalProtocolError):
        encode_packet(packet(largest.body + b"x"))


def test_bad_frames_break_the_protocol():
    def check(case):
        data, problem = case
        with pytest.raises(RemoteProtocolError, match=problem):
            read(data)

    for_each(
        [
            (b"\xc1", "msgpack"),
            (b"\x92\x01", "msgpack"),
            (b"\x90", "not an array of messages"),
            (b"\x80", "not an array of messages"),
            (b"\x91\x90", "neither a packet"),
            (b"\x91\x91\xc0", "neither a packet"),
            (b"\x91\xc0", "neither a packet"),
            (b"\xdd\xff\xff\xff\xff", "msgpack"),
            (b"\xdf\xff\xff\xff\xff", "msgpack"),
            (b"\xc9\xff\xff\xff\xff\x01", "msgpack"),
            (b"\x91" * 3000 + b"\xc0", "msgpack"),
            (payload(ROW) + b"\xc0", "msgpack"),
            (body({1: 2}), "msgpack"),
            (body([0] * (MAX_ARRAY_LENGTH + 1)), "max_array_len"),
            (body({str(number): 0 for number in range(MAX_MAP_LENGTH + 1)}), "max_map_len"),
            (body({b"k": 2}), "key that is not a string"),
            (body(msgpack.ExtType(2, b"abc")), "not ours: 2"),
            (body(EPOCH), "not ours: -1"),
            (body([EPOCH]), "not ours: -1"),
            (body(msgpack.ExtType(1, b"abc")), "malformed array"),
            (body(msgpack.ExtType(1, msgpack.packb(["<f8", [3], bytes(16)]))), "shape"),
            (body(msgpack.ExtType(1, msgpack.packb(["<f8", [-1], bytes(8)]))), "malformed array"),
            (body(msgpack.ExtType(1, msgpack.packb(["|O8", [1], bytes(8)]))), "numbers (and|or) booleans"),
            (body(msgpack.ExtType(1, msgpack.packb(["f8,f8", [1], bytes(16)]))), "numbers (and|or) booleans"),
            (body(msgpack.ExtType(1, msgpack.packb(["<f8", [1] * 33, bytes(8)]))), "malformed array"),
        ],
        check,
    )


def test_malformed_packet_breaks_the_protocol():
    def check(change):
        row = [change.get(index, value) for index, value in enumerate(ROW)]
        with pytest.raises(RemoteProtocolError, match="packet is malformed"):
            packet_from_row(row)

    for_each(
        [
            {0: ""},
            {1: 5},
            {2: None},
            {3: 1},
            {4: "now"},
            {4: -1.0},
            {4: float("nan")},
            {5: -1},
            {6: ["a"]},
            {8: ["a", 1]},
        ],
        check,
    )


def test_a_packet_has_nine_parts():
    for row in (ROW[:8], [*ROW, None]):
        with pytest.raises(RemoteProtocolError, match="malformed"):
            packet_from_row(row)


def test_a_body_that_does_not_fit_its_type_is_the_peers_fault():
    with pytest.raises(RemoteProtocolError, match=r"'ir'.*ranges_m.*from a/b/c"):
        there_and_back(packet({"bearings_rad": [0.0], "max_range_m": 1.0, "ranges_m": "near"}, "ir"))
    assert there_and_back(packet(Infrared((0.0,), (1.0,), 2.0), "ir")).body == Infrared((0.0,), (1.0,), 2.0)


_BODIES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False) | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=30,
)


@given(_BODIES)
def test_any_plain_body_travels(body):
    assert there_and_back(packet(body)).body == body


@given(st.binary(min_size=1, max_size=200))
def test_any_bytes_are_read_or_refused(data):
    with contextlib.suppress(RemoteProtocolError):
        read(data)


@pytest.mark.parametrize(
    "message",
    [
        Hello(1, "default", "a", "agent", "uuid", 3, ("tcp://127.0.0.1:1",)),
        Ping(4),
        Gossip((AgentSeen("a", "tcp://a:1"), AgentSeen("b", "tcp://b:1", 2.5))),
    ],
)
def test_messages_of_the_link_travel(message):
    assert messages_from_payload(frame([encode_link_message(message)])[4:]) == [message]


def test_malformed_link_message_breaks_the_protocol():
    def check(row):
        with pytest.raises(RemoteProtocolError, match="a frame is malformed"):
            messages_from_payload(payload(row))

    for_each(
        [[99], [True], [4], [4, -1], [4, "1"], [6, "nap", None], [7, ["x" * 300]], [HELLO_NUMBER, 1, "f", "a/b"]], check
    )


@pytest.mark.parametrize("name", ["", "a/b", "*", "two words", "x" * 65])
def test_a_name_that_would_break_addresses_is_refused_at_home(name):
    with pytest.raises(LocalProtocolError, match="cannot introduce itself"):
        Identity(name, "uuid").hello()


class Shade(enum.StrEnum):
    RED = "red"


class Rank(enum.Enum):
    ONE = 1


class Word(str):
    """A string of a class of its own."""


def test_the_keys_of_a_map_are_strings_and_what_stands_for_one():
    assert encodable({Word("a"): 1, Shade.RED: 2}) == {"a": 1, "red": 2}
    assert {type(key) for key in encodable({Word("a"): 1, Shade.RED: 2})} == {str}


@pytest.mark.parametrize("key", [1, None, (1, 2), Rank.ONE, b"a"])
def test_any_other_key_is_an_error_that_names_it(key):
    with pytest.raises(LocalProtocolError, match="its body has the key .*, and keys must be strings"):
        encodable({key: 1})


def test_a_body_that_is_too_deep_is_named_by_the_beginning_of_the_way_there():
    body: Any = None
    for _ in range(40):
        body = {"long_name": body}
    where = ("its body" + ".long_name" * 40)[:80]
    with pytest.raises(LocalProtocolError) as error:
        encodable(body)
    assert str(error.value) == f"{where} is nested deeper than 32"


def test_a_map_may_stand_as_deep_as_a_list():
    def nested(depth, wrap):
        body = 1
        for _ in range(depth):
            body = wrap(body)
        return body

    for wrap in (
        lambda inner: [inner],
        lambda inner: {"a": inner},
        lambda inner: (inner,),
        lambda inner: {"a": [inner]},
    ):
        per_level = 2 if wrap(1) == {"a": [1]} else 1
        encodable(nested(30 // per_level, wrap))
        with pytest.raises(LocalProtocolError, match="nested deeper"):
            encodable(nested(32 // per_level, wrap))
