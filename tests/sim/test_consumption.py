"""What empties a battery, told apart: the radio that listens, and the file that records it all."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest

from pancakes.control import Stop
from pancakes.sim.battery import BatteryModel, BatterySettings
from pancakes.testing import Fleet


def battery(**settings: Any) -> BatteryModel:
    return BatteryModel(BatterySettings(**{"capacity_j": 100.0, "idle_w": 0.0, **settings}), full_v=8.4, empty_v=6.6)


def test_a_radio_takes_power_while_it_listens():
    pack = battery(listen_w=0.5)
    pack.passed(10.0, 0.0)
    pack.listening = False
    pack.passed(100.0, 0.0)
    assert pack.level == pytest.approx(0.95)


def test_what_was_spent_is_told_apart_and_adds_up():
    pack = battery(idle_w=0.1, motion_j_per_m=4.0, listen_w=0.2, packet_j=0.5)
    pack.passed(10.0, rolled_m=2.0)
    pack.sampled("sonar")
    pack.packets_sent(4)
    spent = pack.spent
    assert (spent.idle_j, spent.motion_j, spent.sensing_j) == pytest.approx((1.0, 8.0, 0.03))
    assert (spent.listening_j, spent.sending_j) == pytest.approx((2.0, 2.0))
    assert pack.level == pytest.approx(1.0 - 13.03 / 100.0)


def test_an_empty_battery_gives_nothing_more():
    pack = battery(idle_w=1.0, motion_j_per_m=4.0)
    pack.passed(99.0, 0.0)
    pack.passed(0.0, rolled_m=5.0)
    assert pack.empty
    assert (pack.spent.idle_j, pack.spent.motion_j) == pytest.approx((99.0, 1.0))


WORLD = """
    [task.World]
    type = "sim.world"
    [task.World.settings]
    bus = "tcp://bus:7499"
    [task.World.settings.robots.robot]
    x_m = 0.0
    y_m = 0.0
    battery = { capacity_j = 1000.0, idle_w = 0.1, listen_w = 0.5, sample_j = { ir = 0.02 }, packet_j = 0.0 }
    [task.World.settings.sensors.post]
    x_m = 1.0
    y_m = 1.0
    [task.Consumption]
    type = "sim.consumption"
    settings = { path = "PATH" }
"""
ROBOT = """
    [device.ir]
    driver = "sim.ir"
    rate_hz = 10
    settings = { world = "tcp://bus:7499" }
    [device.battery]
    driver = "sim.battery"
    rate_hz = 5
    settings = { world = "tcp://bus:7499" }
"""


def test_the_record_shows_what_a_rate_and_a_sleep_save(tmp_path: Path):
    path = tmp_path / "consumption.csv"
    with Fleet() as fleet:
        fleet.start("world", WORLD.replace("PATH", str(path)))
        robot = fleet.start("robot", ROBOT)
        fleet.run_for(30.0)
        assert robot.ask(Stop("network", for_s=20.0)).ok
        fleet.run_for(31.0)
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert {row["name"] for row in rows} == {"robot"}, "the post has no battery"
    assert list(rows[0]) == ["t_s", "name", "idle_j", "motion_j", "sensing_j", "listening_j", "sending_j"]

    def at(time_s: float, kind: str) -> float:
        return float(next(row[kind] for row in rows if float(row["t_s"]) >= time_s))

    assert at(20.0, "idle_j") - at(10.0, "idle_j") == pytest.approx(1.0, abs=0.02)
    assert at(20.0, "sensing_j") - at(10.0, "sensing_j") == pytest.approx(2.0, abs=0.1)
    assert at(20.0, "listening_j") - at(10.0, "listening_j") == pytest.approx(5.0, abs=0.1)
    assert at(48.0, "listening_j") - at(33.0, "listening_j") == 0.0, "the network slept"
    assert at(60.0, "listening_j") - at(53.0, "listening_j") == pytest.approx(3.5, abs=0.1)
