"""The findings of `pancakes doctor` about devices that are silent or miss too many readings."""

import pytest
from cli.test_doctor import agent, found_in, levels, task


def device(**readings):
    told = {"came": 1000, "missed": 0, "why": "", "silent_s": None, **readings}
    return agent(tasks=[task("gps", service="device", device="pose", readings=told)])


def test_doctor_reports_a_silent_device():
    (found,) = found_in(device(silent_s=45.2))
    assert (found.level, found.about) == ("warning", "a/gps")
    assert found.text == "has had no reading for 45 s" and found.advice


def test_doctor_reports_a_device_that_misses_readings():
    (found,) = found_in(device(missed=34, why="OSError: [Errno 121] Remote I/O error"))
    assert (found.level, found.about) == ("warning", "a/gps")
    assert "missed 34 of 1034 readings or commands (3.3 %)" in found.text and "Errno 121" in found.text


@pytest.mark.parametrize(("missed", "came", "share"), [(30, 0, "100 %"), (997, 3, "99.7 %"), (2, 98, "2 %")])
def test_doctor_prints_the_share_of_misses(missed, came, share):
    (found,) = found_in(device(missed=missed, came=came, why="unplugged"))
    assert f"missed {missed} of {missed + came} readings or commands ({share})" in found.text


def test_rare_misses_are_not_reported():
    assert levels(found_in(device(missed=3, why="noise"))) == [("ok", "a")]


def reserve(**told):
    return agent(reserve={"seconds": 50.0, "trouble": "", "charging": False, "dock": "dock1/device/dock", **told})


def test_doctor_reports_a_dock_that_does_not_charge():
    (found,) = found_in(reserve(trouble="dock1 says that it charges, and the battery does not rise: check the dock"))
    assert (found.level, found.about) == ("warning", "a")
    assert found.text.startswith("dock1 says") and found.advice


def test_doctor_reports_a_robot_that_cannot_reach_a_dock_unless_it_is_charged():
    (found,) = found_in(reserve(seconds=-12.0))
    assert found.level == "warning" and "12 s less than it needs" in found.text
    assert levels(found_in(reserve(seconds=-12.0, charging=True))) == [("ok", "a")]
    assert levels(found_in(reserve())) == [("ok", "a")]
