"""What a robot consumes, and which docks do not charge it."""

from __future__ import annotations

import math
from typing import Any

import pytest

from pancakes.devices import Battery, Reserve
from pancakes.energy.reserve import ChargeWatch, Consumption, ReserveMeter, nearest
from pancakes.settings import SettingsError, make_settings


def drives(consumption: Consumption, seconds: int, per_s: float, speed_mps: float, level: float = 1.0) -> float:
    """Let a robot drive; return the level of its battery."""
    for now_s in range(seconds + 1):
        consumption.take(float(now_s), Battery(8.0, level - per_s * now_s), (speed_mps * now_s, 0.0))
    return level - per_s * seconds


def test_consumption_by_time_is_the_slope_of_the_last_readings() -> None:
    consumption = Consumption(20.0, 0.01)
    drives(consumption, 9, 0.001, 0.0)
    assert consumption.per_s is None
    drives(consumption, 30, 0.001, 0.0)
    assert consumption.per_s == pytest.approx(0.001)


def test_consumption_by_distance_is_a_guess_until_two_metres_are_driven() -> None:
    consumption = Consumption(20.0, 0.01)
    drives(consumption, 19, 0.002, 0.1)
    assert consumption.per_m == 0.01
    drives(consumption, 30, 0.002, 0.1)
    assert consumption.per_m == pytest.approx(0.02)


def test_a_robot_that_stands_or_whose_pose_jumps_has_not_driven() -> None:
    consumption = Consumption(20.0, 0.01)
    drives(consumption, 30, 0.002, 0.005)
    drives(consumption, 30, 0.002, 50.0)
    assert (consumption.driven_m, consumption.lost) == (0.0, 0.0)


def test_while_it_is_charged_nothing_is_measured() -> None:
    consumption = Consumption(20.0, 0.01)
    drives(consumption, 30, 0.001, 0.0)
    for now_s in range(31, 60):
        consumption.take(float(now_s), Battery(8.0, 0.5 + 0.01 * (now_s - 31), charging=True), (0.0, 0.0))
    assert consumption.per_s == pytest.approx(0.001)


def test_a_dock_that_says_it_charges_and_does_not_is_named_until_it_is_good_again() -> None:
    watch = ChargeWatch(10.0, 0.005, 60.0)
    for now_s in range(11):
        watch.take(float(now_s), 0.4, "dock1/device/dock")
    assert watch.failed == ("dock1/device/dock",)
    assert watch.trouble == "dock1 says that it charges, and the battery does not rise: check the dock"
    watch.take(80.0, 0.4, "")
    assert (watch.failed, watch.trouble) == ((), "")


def test_a_battery_that_rises_at_no_dock_is_named_itself() -> None:
    watch = ChargeWatch(10.0, 0.005, 60.0)
    for now_s in range(30):
        watch.take(float(now_s), 0.4, "dock1/device/dock" if now_s < 12 else "dock2/device/dock")
    assert watch.trouble.endswith("dock1 and dock2, which said that they charge: check the battery")
    watch.take(30.0, 0.41, "dock2/device/dock")
    assert watch.trouble == ""


def test_a_dock_that_lies_stays_named_while_another_charges() -> None:
    watch = ChargeWatch(10.0, 0.005, 600.0)
    for now_s in range(60):
        watch.take(float(now_s), 0.4 + 0.001 * max(0, now_s - 12), "dock1/device/dock" if now_s < 12 else "dock2/d/d")
    assert watch.failed == ("dock1/device/dock",)


def test_a_battery_that_rises_or_is_full_is_in_order() -> None:
    watch = ChargeWatch(10.0, 0.005, 60.0)
    for now_s in range(100):
        watch.take(float(now_s), 0.4 + 0.006 * now_s / 10, "dock1/device/dock")
    for now_s in range(100, 200):
        watch.take(float(now_s), 0.99, "dock2/device/dock")
    assert watch.trouble == ""


def test_the_nearest_dock_ties_by_address() -> None:
    assert nearest((0.0, 0.0), {"b": (1.0, 0.0), "a": (0.0, 1.0), "c": (3.0, 0.0)}) == ("a", 1.0)
    assert nearest((0.0, 0.0), {}) == ("", 0.0)


def test_a_longer_way_takes_from_the_reserve() -> None:
    assert Reserve(100.0, 0.5, level_per_s=0.001, level_per_m=0.01).seconds_after(5.0) == pytest.approx(50.0)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"detour": 0.5}, "no way is shorter than a straight line"),
        ({"idle_home_m": [0.0, 0.0]}, "idle_home_m has no effect without idle"),
        ({"idle": "Charge", "idle_home_m": [math.nan, 0.0]}, r"idle_home_m\[0\]: is not a number"),
    ],
)
def test_settings_that_cannot_be_are_refused_with_a_sentence(change: dict[str, Any], what: str) -> None:
    with pytest.raises(SettingsError, match=what):
        make_settings(ReserveMeter.Settings, {"level_per_m": 0.1, **change})
