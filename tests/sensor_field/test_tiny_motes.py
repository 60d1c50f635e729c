"""What a tiny node says, and when."""

from __future__ import annotations

from pancakes_sensor_field.frame import MOTION, PERIOD, SIREN, TEMPERATURE, Decoder, Frame, encode
from pancakes_sensor_field.mote import Mote, spoilt


def said(data: bytes) -> list[tuple[int, int]]:
    """Returns kind and value of the frames in what it sends."""
    return [(frame.kind, frame.value) for frame in Decoder().feed(data)]


def test_it_says_at_its_start_who_it_is_and_then_reports_once_a_period() -> None:
    mote = Mote(7, period_s=10.0)
    assert Decoder().feed(mote.start(100.0)) == [Frame(7, PERIOD, 0, 100)], "number 0 means that it has just begun"
    assert mote.sense(-3.456, False) == b""
    assert mote.tick(109.9) == b""
    assert said(mote.tick(110.0)) == [(TEMPERATURE, -346), (MOTION, 0)]
    assert mote.tick(119.9) == b"" and said(mote.tick(120.5))


def test_motion_is_said_at_once_and_once() -> None:
    mote = Mote(7)
    mote.start(0.0)
    assert said(mote.sense(20.0, True)) == [(MOTION, 1)]
    assert mote.sense(20.1, True) == b""
    assert said(mote.sense(20.1, False)) == [(MOTION, 0)]


def test_without_a_reading_it_has_nothing_to_report() -> None:
    mote = Mote(7)
    mote.start(0.0)
    assert mote.tick(10.0) == b""


def test_a_new_period_is_confirmed_and_counts_from_now() -> None:
    mote = Mote(7, period_s=60.0)
    mote.start(0.0)
    mote.sense(20.0, False)
    wish = encode(Frame(7, PERIOD, 0, 20))
    assert said(mote.received(wish[:3], 5.0)) == [] and said(mote.received(wish[3:], 5.0)) == [(PERIOD, 20)]
    assert mote.tick(6.9) == b"" and said(mote.tick(7.0)) and said(mote.tick(9.0))


def test_what_is_for_another_or_makes_no_sense_changes_nothing() -> None:
    mote = Mote(7, period_s=60.0)
    mote.start(0.0)
    for frame in (
        Frame(8, PERIOD, 0, 20),
        Frame(7, TEMPERATURE, 0, 20),
        Frame(7, PERIOD, 0, 0),
        Frame(7, PERIOD, 0, -5),
    ):
        assert mote.received(encode(frame), 1.0) == b""
    assert mote.next_s == 60.0


def test_numbers_go_from_255_to_1_as_0_means_a_start() -> None:
    mote = Mote(7)
    mote.start(0.0)
    numbers = [Decoder().feed(mote.sense(20.0, turn % 2 == 0))[0].number for turn in range(257)]
    assert numbers[:2] == [1, 2] and numbers[253:] == [254, 255, 1, 2]


def test_temperatures_beyond_what_fits_are_cut_off() -> None:
    mote = Mote(7, period_s=1.0)
    mote.start(0.0)
    mote.sense(1000.0, False)
    assert said(mote.tick(1.0))[0] == (TEMPERATURE, 32767)


def test_a_spoilt_frame_has_a_wrong_crc() -> None:
    mote = Mote(7)
    decoder = Decoder()
    assert decoder.feed(spoilt(mote.start(0.0))) == [] and decoder.crc_errors == 1


def test_its_siren_sounds_for_as_long_as_it_is_told_and_then_falls_silent_by_itself() -> None:
    mote = Mote(7, period_s=60.0)
    mote.start(0.0)
    assert said(mote.received(encode(Frame(7, SIREN, 0, 5)), 1.0)) == [(SIREN, 5)] and mote.sounds
    assert mote.next_s == 1.5 and mote.tick(1.4) == b"" and mote.sounds
    assert said(mote.received(encode(Frame(7, SIREN, 0, 5)), 1.4)) == [(SIREN, 5)]
    assert mote.tick(1.8) == b"" and mote.sounds
    assert said(mote.tick(1.9)) == [(SIREN, 0)] and not mote.sounds and mote.next_s == 60.0
    mote.received(encode(Frame(7, SIREN, 0, 50)), 2.0)
    assert said(mote.received(encode(Frame(7, SIREN, 0, 0)), 2.1)) == [(SIREN, 0)] and not mote.sounds
    mote.received(encode(Frame(7, SIREN, 0, 50)), 2.0)
    mote.start(3.0)
    assert not mote.sounds, "its power was gone"
