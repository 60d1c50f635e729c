"""What `pancakes doctor` says of devices: one that is silent, and one that misses too many readings."""

from cli.test_doctor import agent, found_in, levels, task


def device(**readings):
    told = {"came": 1000, "missed": 0, "why": "", "silent_s": None, **readings}
    return agent(tasks=[task("gps", service="device", device="pose", readings=told)])


def test_doctor_names_a_device_that_is_silent():
    (found,) = found_in(device(silent_s=45.2))
    assert (found.level, found.about) == ("warning", "a/gps")
    assert found.text == "has had no reading for 45 s" and found.advice


def test_doctor_names_a_device_that_misses_readings():
    (found,) = found_in(device(missed=34, why="OSError: [Errno 121] Remote I/O error"))
    assert (found.level, found.about) == ("warning", "a/gps")
    assert "missed 34 of 1034 readings or commands (3.3 %)" in found.text and "Errno 121" in found.text


def test_a_miss_now_and_then_is_no_finding():
    assert levels(found_in(device(missed=3, why="noise"))) == [("ok", "a")]
