"""The gateway's side of a line: readings by name, what is missing, and answers while a node listens."""

from __future__ import annotations

from pancakes_sensor_field.frame import MOTION, PERIOD, TEMPERATURE, Decoder, Frame, encode
from pancakes_sensor_field.mote import Mote
from pancakes_sensor_field.station import Reading, Station


def frame(number: int, kind: int = TEMPERATURE, value: int = 2000, node: int = 7) -> bytes:
    return encode(Frame(node, kind, number, value))


def numbers(station: Station, *line: int) -> list[int]:
    """Returns which of the frames with these numbers were taken."""
    return [number for number in line if station.received(frame(number)).readings]


def test_frames_become_readings_by_the_names_of_the_nodes() -> None:
    station = Station({"shed": 7, "gate": 9})
    heard = station.received(frame(1, value=-150) + frame(1, MOTION, 1, node=9) + frame(2, MOTION, 0, node=9))
    assert heard.readings == [
        Reading("shed", TEMPERATURE, -1.5),
        Reading("gate", MOTION, 1.0),
        Reading("gate", MOTION, 0.0),
    ]
    assert heard.answer == b"" and heard.strangers == []


def test_who_was_not_named_is_told_once_and_not_heard() -> None:
    station = Station({"shed": 7})
    heard = [station.received(frame(number, node=8)) for number in (1, 2)]
    assert [it.readings for it in heard] == [[], []] and [it.strangers for it in heard] == [[8], []]
    assert station.unknown == 2


def test_a_kind_that_is_not_known_is_counted() -> None:
    station = Station({"shed": 7})
    assert station.received(frame(1, kind=99)).readings == [] and station.unknown == 1


def test_missing_frames_are_counted_also_over_the_turn() -> None:
    station = Station({"shed": 7})
    assert numbers(station, 250, 254, 2) == [250, 254, 2]
    assert station.missed == 3 + 2, "251, 252, 253; 255 and 1: there is no 0 but at a start"


def test_what_comes_twice_or_too_late_is_taken_once() -> None:
    station = Station({"shed": 7})
    assert numbers(station, 1, 1, 3, 2, 4) == [1, 3, 4]
    assert station.repeated == 2 and station.missed == 1


def test_a_node_that_starts_anew_is_heard_whatever_its_number_was() -> None:
    station = Station({"shed": 7})
    assert numbers(station, 200) == [200]
    station.received(frame(0, PERIOD, 100))
    assert numbers(station, 1, 2) == [1, 2]
    assert (station.missed, station.repeated) == (0, 0)


def test_a_node_that_starts_anew_unheard_is_believed_after_a_few_frames() -> None:
    station = Station({"shed": 7}, period_s=2.0)
    station.received(frame(49, PERIOD, 20))
    assert numbers(station, 50, 1, 2, 3, 4) == [50, 3, 4], "its frame 0 was lost"
    assert station.received(frame(5)).answer, "nobody knows which period it has now"
    assert (station.repeated, station.missed) == (2, 0)
    assert numbers(station, 4, 3, 6) == [6], "single ones that are late are late"


def test_a_node_is_told_its_period_until_it_says_that_it_has_it() -> None:
    station = Station({"shed": 7}, period_s=2.0)
    wish = [Frame(7, PERIOD, 1, 20)]
    assert Decoder().feed(station.received(frame(1)).answer) == wish
    assert Decoder().feed(station.received(frame(2)).answer) == [Frame(7, PERIOD, 2, 20)], "the first was not heard"
    assert station.received(frame(3, PERIOD, 20)).answer == b""
    assert station.received(frame(4)).answer == b""


def test_a_node_that_starts_anew_is_told_again() -> None:
    station = Station({"shed": 7}, period_s=2.0)
    station.received(frame(1, PERIOD, 20))
    assert station.received(frame(2)).answer == b""
    assert station.received(frame(0, PERIOD, 100)).answer


def test_periods_can_be_set_for_one_or_for_all() -> None:
    station = Station({"shed": 7, "gate": 9})
    assert station.want_period(1.5, "gate") and not station.want_period(1.5, "barn")
    assert station.received(frame(1)).answer == b""
    assert Decoder().feed(station.received(frame(1, node=9)).answer) == [Frame(9, PERIOD, 1, 15)]
    assert station.want_period(3.0)
    assert station.received(frame(2)).answer and station.received(frame(2, node=9)).answer


def test_station_and_node_come_to_terms() -> None:
    station, mote = Station({"shed": 7}, period_s=1.0), Mote(7, period_s=60.0)
    heard = station.received(mote.start(0.0))
    assert station.received(mote.received(heard.answer, 0.0)).answer == b""
    mote.sense(20.0, False)
    assert station.received(mote.tick(1.0)).readings == [
        Reading("shed", TEMPERATURE, 20.0),
        Reading("shed", MOTION, 0.0),
    ]
    assert (station.missed, station.repeated, station.crc_errors) == (0, 0, 0)


def test_an_end_of_the_line_leaves_no_half_frame_behind() -> None:
    station = Station({"shed": 7})
    station.received(frame(1)[:5])
    station.ended()
    assert station.received(frame(2)[5:]).readings == [] and station.received(frame(3)).readings
    assert station.skipped_bytes == 8
