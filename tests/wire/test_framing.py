"""Frames are found however the network cuts the stream."""

from __future__ import annotations

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pancakes.errors import LocalProtocolError, RemoteProtocolError
from pancakes.mesh.codec import MAX_MESSAGE_BYTES, MAX_PAYLOAD_BYTES, FrameReader, frame


def messages_in(payloads):
    return [message for payload in payloads for message in msgpack.unpackb(payload)]


@given(st.lists(st.binary(max_size=400), min_size=1, max_size=40), st.lists(st.integers(1, 500)))
def test_any_cut_of_the_stream_gives_the_same_messages(bodies, cuts):
    stream = frame([msgpack.packb(body) for body in bodies])
    reader, payloads = FrameReader(), []
    for cut in [*cuts, len(stream)]:
        payloads += reader.feed(stream[:cut])
        stream = stream[cut:]
    assert messages_in(payloads) == bodies


def test_byte_by_byte():
    stream = frame([msgpack.packb("one")]) + frame([msgpack.packb("two"), msgpack.packb(bytes(1000))])
    reader, payloads = FrameReader(), []
    for number in range(len(stream)):
        payloads += reader.feed(stream[number : number + 1])
    assert messages_in(payloads) == ["one", "two", bytes(1000)]


@pytest.mark.parametrize("count", [1, 15, 16, 65_535, 65_536])
def test_many_messages_share_frames(count):
    stream = frame([b"\x05"] * count)
    assert messages_in(FrameReader().feed(stream)) == [5] * count
    assert len(FrameReader().feed(stream)) == (1 if count < 65_536 else 2)


def test_messages_that_together_are_too_long_are_given_frames_of_their_own():
    large = msgpack.packb(bytes(MAX_MESSAGE_BYTES - 5))
    assert len(large) == MAX_MESSAGE_BYTES
    payloads = FrameReader().feed(frame([large, b"\x05", large, b"\x05"]))
    assert len(payloads) == 4
    assert all(len(payload) <= MAX_PAYLOAD_BYTES for payload in payloads)
    with pytest.raises(LocalProtocolError, match="does not fit a frame"):
        frame([large + b"\x05"])


@pytest.mark.parametrize("length", [0, MAX_PAYLOAD_BYTES + 1, 2**32 - 1])
def test_a_forbidden_length_is_refused_at_its_fourth_byte(length):
    header = length.to_bytes(4, "big")
    reader = FrameReader()
    assert reader.feed(header[:3]) == []
    with pytest.raises(RemoteProtocolError, match=str(length)):
        reader.feed(header[3:])


def test_the_longest_frame_is_taken():
    payload = bytes(MAX_PAYLOAD_BYTES)
    assert FrameReader().feed(len(payload).to_bytes(4, "big") + payload) == [payload]
