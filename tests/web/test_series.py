"""Numbers become series that a page can plot; their memory is bounded."""

from __future__ import annotations

import hashlib
import json
import math
from array import array
from importlib import resources
from typing import Any

import msgspec
import numpy as np
import pytest
from web.page_rig import Fleet, ask, page
from web.samples import agent, describe, packet, task, world

from pancakes.client.rates import RateMeter
from pancakes.devices import Battery, Infrared
from pancakes.tools.web.fleet_model import FleetModel
from pancakes.tools.web.page_server import MOST_NAMES, PageServer
from pancakes.tools.web.series import MOST_ITEMS, SeriesStore, numbers_in, thinned, unit
from pancakes.tools.web.timeline import ClockLine


class Wheel(msgspec.Struct):
    speed_mps: float
    name: str = ""


class Drive(msgspec.Struct):
    wheels: tuple[Wheel, ...]
    on: bool
    count: int
    mode: str
    grid: Any
    extra: dict[str, Any]


EMPTY = (array("d"), array("d"))


def names(store: SeriesStore) -> list[str]:
    return [name for name, _, _ in store.find("", 1000)[0]]


def test_numbers_of_a_packet_have_names():
    wheels = (Wheel(1.0, "left"), Wheel(math.nan))
    body = Drive(wheels, True, 3, "fast", np.array([[1.0, 2.0]]), {"a": {"b": 4}, "text": "x", "big": 10**400})

    assert dict(numbers_in(body)) == {
        "wheels.left.speed_mps": 1.0,
        "wheels[1].speed_mps": None,
        "on": 1.0,
        "count": 3.0,
        "grid[0][0]": 1.0,
        "grid[0][1]": 2.0,
        "extra.a.b": 4.0,
        "extra.big": None,
    }


def test_large_arrays_are_not_plotted():
    assert list(numbers_in({"image": np.zeros((480, 640)), "long": [0.0] * (MOST_ITEMS + 1), "n": 1})) == [("n", 1.0)]


def test_series_have_units():
    assert [unit(name) for name in ("a processor_percent", "a/x/y battery voltage_v", "a t ranges_m[3]")] == [
        "%",
        "V",
        "m",
    ]


def test_packets_are_taken_four_times_a_second():
    store = SeriesStore()
    for number in range(100):
        store.take(packet("a/device/battery", "system", "battery", Battery(0.1 * number, 0.5)), 0.05 * number)

    points = store.after("a/device/battery battery voltage_v", -math.inf)
    assert points is not None
    assert 18 <= len(points[0]) <= 20
    assert store.after("a/device/battery battery voltage_v", 4.0)[0][0] > 4.0  # type: ignore[index]
    assert store.after("a/device/battery battery nothing", 0.0) is None


def test_series_are_bounded_in_time_number_and_points():
    store = SeriesStore(span_s=100.0, most_points=20_000, most_series=100)
    for second in range(2000):
        for number in range(130):
            store.add(f"a figure_{number}", float(second), float(second))

    assert len(names(store)) == 100 and store.left_out == 30
    for number in range(100):
        times, _ = store.after(f"a figure_{number}", -math.inf) or EMPTY
        assert times[0] >= 2000 - 100 - 61 and times[-1] == 1999.0


def test_many_series_keep_a_shorter_time():
    store = SeriesStore(span_s=600.0, most_points=10_000)
    for step in range(1000):
        for number in range(20):
            store.add(f"a figure_{number}", 0.25 * step, float(step))

    kept = [len((store.after(f"a figure_{number}", -math.inf) or EMPTY)[0]) for number in range(20)]
    assert max(kept) < 700 and min(kept) >= 500, "500 each, and what is not dropped yet"


def test_gap_is_kept_as_one_point():
    store = SeriesStore()
    for t, value in enumerate([1.0, None, None, 2.0]):
        store.add("a late_ms", float(t), value)
    store.add("a late_ms", 1.5, 9.0)  # from before

    times, values = store.after("a late_ms", -math.inf) or EMPTY
    assert list(times) == [0.0, 1.0, 3.0] and math.isnan(values[1])


def test_thinned_series_keep_their_peaks():
    values = [0.0] * 10_000
    values[1234], values[8765] = 7.0, -7.0
    times, kept = thinned([float(t) for t in range(10_000)], values, 500)

    assert len(times) <= 500 and times == sorted(times)
    assert kept[times.index(1234.0)] == 7.0 and kept[times.index(8765.0)] == -7.0


def test_series_are_found_by_words():
    store = SeriesStore()
    for name in ("agent1 late_ms", "agent1/client/Scan rate_hz", "agent2 late_ms"):
        store.add(name, 0.0, 1.0)

    rows, count = store.find("LATE agent1", 10)
    assert rows == [("agent1 late_ms", "ms", 1.0)] and count == 1
    assert store.find("", 2)[1] == 3 and len(store.find("", 2)[0]) == 2


def test_only_wanted_packets_are_followed():
    store = SeriesStore()
    assert store.wanted(0.0) == {}
    store.want(["a late_ms"], 0.0)
    assert store.wanted(0.0) == {}, "a figure needs no packet"
    store.want(["a/device/gps gps x_m"], 0.0)
    assert store.wanted(0.0) is None, "nobody knows its channel"
    store.take(packet("a/device/gps", "places", "gps", {"x_m": 1.0}), 0.0)
    assert store.wanted(1.0) == {"places": ("gps",)}
    assert store.wanted(11.0) == {}
    store.want_all(20.0)
    assert store.wanted(20.0) is None and store.wanted(31.0) == {}


def test_model_keeps_figures_and_followed_packets():
    model, rates = FleetModel(), RateMeter()
    for second in range(3):
        scan = task("a", "Scan", rate_hz=10.0, ticks=10 * second, lateness_sum_s=0.01 * second)
        row = agent("a", scan, peers={"b": 0.002}, mission_s=float(second), battery_level=0.5)
        describe(model, row, t=float(second), rates=rates)
    model.hear("a", packet("a/device/ir", "system", "ir", Infrared((0.0,), (0.25,), 0.3)), 2.0)
    model.hear("w", world(2.0, a=(1.0, 2.0)), 2.0)

    found = {name: value for name, _, value in model.series.find("", 100)[0]}
    assert found["a/client/Scan rate_hz"] == 10.0 and found["a/client/Scan late_ms"] == 1.0
    assert found["a~b round_trip_ms"] == 2.0 and found["a battery_percent"] == 50.0
    assert found["a/device/ir ir ranges_m[0]"] == 0.25
    assert found["world/client/World world_state bodies.a.x_m"] == 1.0


def test_agent_that_is_silent_leaves_a_gap():
    model, rates = FleetModel(), RateMeter()
    for second in range(3):
        scan = task("a", "Scan", rate_hz=10.0, ticks=10 * second, lateness_sum_s=0.01 * second)
        describe(model, agent("a", scan, mission_s=float(second)), t=float(second), rates=rates)
    describe(model, t=5.0, rates=rates)
    rows = [{"agent": "a", "role": "agent", "state": "no answer"}]
    model.describe(rows, [], 6.0)

    _, values = model.series.after("a late_ms", -math.inf) or EMPTY
    assert math.isnan(values[-1])


def test_clock_line_has_a_knot_where_the_speed_changes():
    line = ClockLine()
    for step in range(300):
        t = 0.1 * step
        line.add(t, t if t < 10 else 10.0 if t < 20 else 10.0 + 5.0 * (t - 20.0))

    assert [t for t, _ in line.knots] == pytest.approx([0.0, 10.0, 20.0], abs=0.5)
    assert line.changes == 3


def test_page_gets_series_and_only_what_is_new(server: PageServer, fleet: Fleet):
    series = fleet.feed.model.series
    for t in range(5):
        series.add("a late_ms", float(t), 0.1 * t)
    series.add("a late_ms", 5.0, None)
    with page(server) as connection:
        found = ask(connection, "find", words="late")["result"]
        assert found == {"rows": [["a late_ms", "ms", None]], "count": 1, "left_out": 0}
        whole = ask(connection, "series", names=["a late_ms", "b late_ms"], since=[-1.0, 0.0])["result"]
        assert whole == {"a late_ms": ["ms", [0, 1, 2, 3, 4, 5], [0, 0.1, 0.2, 0.3, 0.4, None]]}
        assert ask(connection, "series", names=["a late_ms"], since=[3.0])["result"]["a late_ms"][1] == [4, 5]


def test_malformed_questions_about_series_are_refused(server: PageServer):
    with page(server) as connection:
        for asked in (
            {"names": "x", "since": []},
            {"names": ["a"], "since": []},
            {"names": ["a"], "since": ["x"]},
            {"names": ["a"] * (MOST_NAMES + 1), "since": [0.0] * (MOST_NAMES + 1)},
            {"names": ["a" * 301], "since": [0.0]},
        ):
            answer = ask(connection, "series", **asked)
            assert not answer["ok"] and answer["reason"], asked
        assert not ask(connection, "find", words=7)["ok"]


def test_frame_has_the_line_of_mission_time_once(fleet: Fleet):
    fleet.feed.model.hear("world", world(3.0), 1.0)
    fleet.feed.record()
    data, seen = fleet.feed.frame(None)
    assert json.loads(data)["knots"] == [[1.0, 3.0]]
    assert "knots" not in json.loads(fleet.feed.frame(seen)[0])


def test_plots_are_drawn_by_a_pinned_library():
    """What is served is what its authors published, with their licence."""
    folder = resources.files("pancakes.tools.web").joinpath("static", "vendor")
    readme = folder.joinpath("README.txt").read_text()
    for name in ("uPlot.iife.min.js", "uPlot.min.css"):
        assert f"{hashlib.sha256(folder.joinpath(name).read_bytes()).hexdigest()}  {name}" in readme
    assert b"v1.6.32" in folder.joinpath("uPlot.iife.min.js").read_bytes()[:80] and "1.6.32" in readme
    assert folder.joinpath("uPlot-LICENSE.txt").read_text().startswith("The MIT License")
