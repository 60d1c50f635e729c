"""The timeline: each piece begins with all values; old pieces are dropped."""

import json
from typing import Any

import pytest
from web.samples import packet, record, world

from pancakes.devices import Infrared
from pancakes.tools.web.feed import Feed
from pancakes.tools.web.timeline import CHUNK_S, FrameHistory


def piece(history: FrameHistory, t: float) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(history.at(t))
    return found


def test_piece_has_all_values_and_then_changes():
    history = FrameHistory()
    for number in range(150):
        history.add(0.1 * number, {"t": number, "all": history.due(0.1 * number)})

    first, second = piece(history, 3.0), piece(history, 12.0)
    assert first["key"]["all"] and not any(frame["all"] for frame in first["frames"])
    assert (first["begin"], first["open"]) == (0.0, False)
    assert (second["begin"], second["open"]) == (pytest.approx(CHUNK_S), True)
    assert first["end"] == second["begin"]


def test_history_is_limited_in_time_and_memory():
    by_time, by_size = FrameHistory(span_s=30.0), FrameHistory(most_bytes=2000)
    for number in range(100):
        by_time.add(float(number), {})
        by_size.add(float(number), "x" * 100)

    assert 99.0 - 30.0 - CHUNK_S <= by_time.begin_s() <= 99.0 - 30.0
    assert 99.0 - by_size.begin_s() < 25.0


def test_piece_before_the_beginning_is_the_first():
    history = FrameHistory()
    assert history.at(0.0) == b"null"
    history.add(5.0, {"t": 5})
    assert piece(history, -3.0)["key"] == {"t": 5}


class Clock:
    t = 0.0

    def __call__(self) -> float:
        return self.t


def test_slow_page_gets_newest_values_and_all_events():
    clock = Clock()
    feed = Feed(clock)
    data, seen = feed.frame(None)
    assert json.loads(data)["all"]
    for number in range(50):
        feed.model.hear("world", world(float(number), a=(0.1 * number, 0.0)), 0.0)
        feed.model.tell(record("a", "step", float(number)), 0.0)

    frame = json.loads(feed.frame(seen)[0])
    assert frame["set"]["body/a"][0] == 4.9
    assert len(frame["events"]) == 50
    assert "trails" not in frame


def test_page_away_too_long_gets_the_count_of_lost_events():
    feed = Feed(Clock())
    _, seen = feed.frame(None)
    for number in range(2500):
        feed.model.tell(record("a", "step", float(number)), 0.0)

    frame = json.loads(feed.frame(seen)[0])
    assert (len(frame["events"]), frame["lost_events"]) == (2000, 500)


def test_recorded_frames_are_returned():
    clock = Clock()
    feed = Feed(clock)
    for number in range(40):
        clock.t = 0.1 * number
        feed.model.hear("world", world(clock.t, a=(float(number), 0.0)), clock.t)
        feed.record()

    chunk = json.loads(feed.chunk(2.0))
    places = {frame["t"]: frame["set"]["body/a"][0] for frame in chunk["frames"]}
    assert places[2.0] == 20.0
    assert chunk["key"]["set"]["body/a"][0] == 0.0


def test_ended_feed_has_a_fixed_present():
    clock = Clock()
    feed = Feed(clock)
    clock.t = 7.0
    feed.end("the mission is over: PASS")
    clock.t = 9.0

    frame = json.loads(feed.frame(None)[0])
    assert (frame["t"], frame["over"]) == (7.0, "the mission is over: PASS")


def test_frame_of_fifty_robots_is_small():
    feed = Feed(Clock())
    names = [f"robot{number:02d}" for number in range(50)]
    seen = None
    for step in range(3):
        feed.model.hear("world", world(0.1 * step, **dict.fromkeys(names, (0.01 * step, 2.345))), 0.0)
        for name in names:
            sweep = Infrared(tuple(0.7 * k for k in range(9)), tuple(0.1 + 0.01 * (k + step) for k in range(9)), 0.2)
            feed.model.hear(name, packet(f"{name}/device/ir", "system", "ir", sweep), 0.0)
        data, seen = feed.frame(seen)

    assert json.loads(data)["set"].keys() >= {"body/robot49", "rays/robot49/ir"}
    assert "ring/robot49/ir" not in json.loads(data)["set"]  # what stays is not sent again
    assert len(data) < 10_000
