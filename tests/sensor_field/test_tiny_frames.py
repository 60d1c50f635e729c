"""The wire format of the tiny nodes: eight bytes, found again in whatever a line brings."""

from __future__ import annotations

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pancakes_sensor_field.frame import LENGTH, MOTION, PERIOD, SYNC, TEMPERATURE, Decoder, Frame, encode

frames = st.builds(Frame, st.integers(1, 254), st.integers(0, 255), st.integers(0, 255), st.integers(-32768, 32767))
quiet_garbage = st.binary(max_size=20).map(lambda data: data.replace(bytes((SYNC,)), b"\0"))


def crc_as_a_node_in_c_would(data: bytes) -> int:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1
            crc &= 0xFFFF
    return crc


def test_a_frame_is_the_eight_bytes_of_the_document() -> None:
    assert crc_as_a_node_in_c_would(b"123456789") == 0x29B1, "the check value of CRC-16/CCITT-FALSE"
    crc = crc_as_a_node_in_c_would(bytes.fromhex("0701030866"))
    assert encode(Frame(7, TEMPERATURE, 3, 2150)).hex() == f"a5{7:02x}{1:02x}{3:02x}0866{crc:04x}"
    assert encode(Frame(254, MOTION, 255, -1))[4:6] == b"\xff\xff"


@pytest.mark.parametrize(
    "frame", [Frame(0, 1, 1, 0), Frame(255, 1, 1, 0), Frame(1, 256, 1, 0), Frame(1, 1, -1, 0), Frame(1, 1, 1, 32768)]
)
def test_what_does_not_fit_is_refused(frame: Frame) -> None:
    with pytest.raises(ValueError, match="does not fit into 8 bytes"):
        encode(frame)


@given(st.lists(frames, max_size=20), st.data())
def test_frames_come_out_as_they_went_in_however_the_line_cuts_them(sent: list[Frame], data: st.DataObject) -> None:
    line = b"".join(map(encode, sent))
    decoder, found = Decoder(), []
    while line:
        cut = data.draw(st.integers(1, len(line)))
        found += decoder.feed(line[:cut])
        line = line[cut:]
    assert found == sent
    assert (decoder.frames, decoder.crc_errors, decoder.skipped_bytes) == (len(sent), 0, 0)


@given(st.lists(st.tuples(quiet_garbage, frames), max_size=10))
def test_garbage_between_frames_is_skipped_and_counted(pairs: list[tuple[bytes, Frame]]) -> None:
    decoder = Decoder()
    assert decoder.feed(b"".join(garbage + encode(frame) for garbage, frame in pairs)) == [frame for _, frame in pairs]
    assert decoder.skipped_bytes == sum(len(garbage) for garbage, _ in pairs)


@given(frames, st.integers(1, 8 * LENGTH - 1), frames)
def test_one_wrong_bit_never_makes_another_frame_and_the_next_one_is_heard(
    spoilt: Frame, bit: int, good: Frame
) -> None:
    data = bytearray(encode(spoilt))
    data[bit // 8] ^= 1 << bit % 8
    decoder = Decoder()
    found = decoder.feed(bytes(data) + encode(good))
    assert found == [good]
    assert decoder.skipped_bytes == LENGTH and (decoder.crc_errors > 0 or bit < 8)


@given(frames, st.integers(1, LENGTH - 1), frames)
def test_a_frame_that_breaks_off_costs_no_other(broken: Frame, cut: int, good: Frame) -> None:
    line = encode(broken)[:cut] + encode(good)
    # Where the sync byte of the next frame happens to be the byte that is missing, nobody can tell the two apart.
    assume(not any(is_frame(line[start : start + LENGTH]) for start in range(cut)))
    decoder = Decoder()
    assert decoder.feed(line[:cut]) == []
    assert decoder.feed(line[cut:]) + decoder.feed(bytes(LENGTH)) == [good]


def is_frame(data: bytes) -> bool:
    return data[0] == SYNC and crc_as_a_node_in_c_would(data[1:6]) == int.from_bytes(data[6:8], "big")


def test_a_frame_whose_missing_byte_is_the_next_sync_byte_is_taken_for_whole_and_the_one_after_is_heard() -> None:
    broken = Frame(33, 98, 185, -32768)
    assert encode(broken)[-1] == SYNC
    good = Frame(1, 0, 0, 0)
    assert Decoder().feed(encode(broken)[:-1] + 2 * encode(good)) == [broken, good]


@given(st.binary(max_size=200))
def test_nothing_that_comes_can_harm_it(data: bytes) -> None:
    decoder = Decoder()
    found = decoder.feed(data)
    decoder.end()
    assert len(found) * LENGTH + decoder.skipped_bytes == len(data)
    assert decoder.feed(encode(Frame(1, PERIOD, 0, 100))) == [Frame(1, PERIOD, 0, 100)]
