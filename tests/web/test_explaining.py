"""Why an actuator was commanded: the chain over two agents, with the times of its steps."""

from told import packet

from pancakes.control import Hold
from pancakes.devices.types import Pose, Twist
from pancakes.web.causes import Explaining

POSE = Pose(0.0, 0.0, 0.0)


def loop(explaining: Explaining, number: int, t: float) -> None:
    """One turn of a control loop: a pose comes from afar, the device tells it, and a task steers."""
    sent = packet("world/client/Capture", "system", "pose", POSE, stamp=t, seq=number)
    # The world's clock goes as this agent's, but it began 100 s earlier.
    explaining.hear(
        "world", packet("world/client/World", "system", "pose", POSE, stamp=t + 99.0, seq=number), t - 1.0, 1.0
    )
    sent = packet("world/client/Capture", "system", "pose", POSE, stamp=t + 100.0, seq=number)
    explaining.hear("a", sent, t + 0.003, 1.0)
    read = packet(
        "a/device/pose", "system", "pose", POSE, stamp=t + 0.004, seq=number, cause=("world/client/Capture", number)
    )
    explaining.hear("a", read, t + 0.004, 1.0)
    steer = packet(
        "a/client/T", "ctrl", "motors", Twist(0.1, 0.2), stamp=t + 0.006, seq=number, cause=("a/device/pose", number)
    )
    explaining.hear("a", steer, t + 0.006, 1.0)


def test_the_newest_command_is_led_back_to_its_first_cause():
    explaining = Explaining()
    loop(explaining, 1, 10.0)
    loop(explaining, 2, 11.0)

    found = explaining.explain("a")

    assert found is not None
    assert [step["source"] for step in found["steps"]] == ["world/client/Capture", "a/device/pose", "a/client/T"]
    assert [step["at_ms"] for step in found["steps"]] == [0.0, 4.0, 6.0]
    assert [step["travel_ms"] for step in found["steps"]] == [3.0, 0.0, 0.0]
    assert [step["handling_ms"] for step in found["steps"]] == [1.0, 2.0, 0.0]
    assert found["steps"][-1]["body"] == "v_mps 0.1, omega_radps 0.2"
    assert found["alike"] == {"count": 2, "p50_ms": 6.0, "p90_ms": 6.0, "max_ms": 6.0}


def test_mission_time_that_goes_faster_is_told_in_the_time_that_passes():
    explaining = Explaining()
    explaining.hear("a", packet("a/device/pose", "system", "pose", POSE, stamp=50.0), 10.0, 5.0)
    steer = packet("a/client/T", "ctrl", "motors", Twist(0.1, 0.0), stamp=50.01, cause=("a/device/pose", 1))
    explaining.hear("a", steer, 10.005, 5.0)

    found = explaining.explain("a")

    assert found is not None
    assert found["steps"][0]["handling_ms"] == 2.0


def test_a_safe_hold_is_no_command_and_who_was_not_commanded_has_no_chain():
    explaining = Explaining()
    explaining.hear("a", packet("a/device", "ctrl", "hold", Hold("its holder is gone")), 0.0, 1.0)

    assert explaining.explain("a") is None
    assert explaining.explain("b") is None


def test_the_steps_add_up_to_the_whole_though_whoever_watches_is_late():
    explaining = Explaining()
    # The first packets of both agents come 5 ms and 20 ms late, the next ones at once.
    for number, late_s in ((1, 0.02), (2, 0.0)):
        t = 10.0 + number
        sent = packet("world/client/Capture", "system", "pose", POSE, stamp=t, seq=number)
        explaining.hear("world", sent, t + late_s / 4, 1.0)
        explaining.hear("a", sent, t + 0.008, 1.0)
        cause = ("world/client/Capture", number)
        read = packet("a/device/pose", "system", "pose", POSE, stamp=t + 0.002, seq=number, cause=cause)
        explaining.hear("a", read, t + 0.002 + late_s, 1.0)
        cause = ("a/device/pose", number)
        steer = packet("a/client/T", "ctrl", "motors", Twist(0.1, 0.2), stamp=t + 0.003, seq=number, cause=cause)
        explaining.hear("a", steer, t + 0.003 + late_s, 1.0)

    found = explaining.explain("a")

    assert found is not None
    assert [step["at_ms"] for step in found["steps"]] == [0.0, 2.0, 3.0]
    assert [step["travel_ms"] for step in found["steps"]] == [2.0, 0.0, 0.0]
    assert [step["handling_ms"] for step in found["steps"]] == [0.0, 1.0, 0.0]
    assert found["alike"] == {"count": 2, "p50_ms": 3.0, "p90_ms": 3.0, "max_ms": 3.0}
