"""Devices on the pins of a Raspberry Pi, with the pins that gpiozero's own tests use."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gpiozero
import pytest
from gpiozero.pins.mock import MockFactory, MockPin, MockPWMPin, MockTriggerPin
from pancakes_pi.pins import PinDistance, PinMotion, PinMotors

from pancakes.control import Stop
from pancakes.devices import Motion, Sonar, Twist
from pancakes.packet import CTRL
from pancakes.settings import check_settings
from pancakes.task import Task
from pancakes.testing import threaded_agent


@pytest.fixture
def pins() -> Iterator[MockFactory]:
    """Pins of no hardware; none is in use afterwards."""
    before = gpiozero.Device.pin_factory
    factory = gpiozero.Device.pin_factory = MockFactory(pin_class=MockPWMPin)
    yield factory
    factory.close()
    factory.reset()
    gpiozero.Device.pin_factory = before


class Drive(Task):
    requires = ("motors",)


WHEELS = {"left": [17, 18], "right": [22, 23], "wheel_base_m": 0.2, "max_wheel_mps": 0.5}


def levels(pins: MockFactory, *numbers: int) -> list[float]:
    return [round(float(pins.pin(number).state), 3) for number in numbers]


def test_motion_is_told_as_it_begins_and_ends(pins: MockFactory) -> None:
    with threaded_agent("a", devices={"pir": {"type": PinMotion, "settings": {"pin": 4}}}) as agent:
        agent.wait_for(Motion, lambda body: not body.detected)
        pins.pin(4).drive_high()
        agent.wait_for(Motion, lambda body: body.detected)
        agent.probe.forget()
        pins.pin(4).drive_low()
        agent.wait_for(Motion, lambda body: not body.detected)


def test_a_pin_may_be_low_where_something_moves(pins: MockFactory) -> None:
    device = {"type": PinMotion, "rate_hz": 20, "settings": {"pin": 4, "active_high": False}}
    pins.pin(4).drive_high()
    with threaded_agent("a", devices={"pir": device}) as agent:
        agent.wait_for(Motion, lambda body: not body.detected)
        pins.pin(4).drive_low()
        agent.wait_for(Motion, lambda body: body.detected)


def test_a_distance_is_measured_by_the_time_of_the_echo(pins: MockFactory) -> None:
    pins.pin_class = MockPin
    echo = pins.pin(24)
    pins.pin(23, pin_class=MockTriggerPin, echo_pin=echo, echo_time=0.005)
    settings = {"trigger": 23, "echo": 24, "bearing_rad": 0.5}
    with threaded_agent("a", devices={"sonar": {"type": PinDistance, "rate_hz": 10, "settings": settings}}) as agent:
        found = agent.wait_for(Sonar, lambda body: body.ranges_m[0] < 2.0, timeout_s=20.0).body
        assert found.bearings_rad == (0.5,) and found.max_range_m == 2.0
        assert 0.5 < found.ranges_m[0] < 2.0, "5 ms are 0.86 m; a loaded machine measures more"


def test_wheels_turn_by_pwm_and_stand_at_the_safe_hold(pins: MockFactory) -> None:
    device = {"type": PinMotors, "hold_after_mission_s": 30.0, "settings": WHEELS}
    with threaded_agent("a", devices={"wheels": device}, tasks={"Drive": Drive}) as agent:
        for twist, wanted in (
            (Twist(0.25, 0.0), [0.5, 0.0, 0.5, 0.0]),
            (Twist(-0.5, 0.0), [0.0, 1.0, 0.0, 1.0]),
            (Twist(0.0, 2.5), [0.0, 0.5, 0.5, 0.0]),
            (Twist(0.5, 5.0), [0.0, 0.0, 1.0, 0.0]),
            (Twist(float("nan"), 0.0), [0.0, 0.0, 0.0, 0.0]),
        ):
            agent.task("Drive").publish(CTRL, twist)
            agent.wait_until(lambda: levels(pins, 17, 18, 22, 23) == wanted, what=str((twist, wanted)))  # noqa: B023
        agent.task("Drive").publish(CTRL, Twist(0.25, 0.0))
        agent.wait_until(lambda: levels(pins, 17, 22) == [0.5, 0.5])
        assert agent.ask(Stop("Drive")).ok
        agent.wait_until(lambda: levels(pins, 17, 18, 22, 23) == [0.0, 0.0, 0.0, 0.0])


def test_wheels_stand_where_the_agent_ends_and_their_pins_are_free(pins: MockFactory) -> None:
    device = {"type": PinMotors, "hold_after_mission_s": 30.0, "settings": WHEELS}
    with threaded_agent("a", devices={"wheels": device}, tasks={"Drive": Drive}) as agent:
        agent.task("Drive").publish(CTRL, Twist(0.25, 0.0))
        agent.wait_until(lambda: levels(pins, 17, 22) == [0.5, 0.5])
    assert levels(pins, 17, 18, 22, 23) == [0.0, 0.0, 0.0, 0.0]
    gpiozero.LED(17).close()


def test_a_pin_that_is_in_use_is_named(pins: MockFactory) -> None:
    devices = {name: {"type": PinMotion, "settings": {"pin": 4}} for name in ("one", "two")}
    with threaded_agent("a", devices=devices) as agent:
        assert "pin GPIO4 is already in use" in agent.wait_for_event("task_failed")["error"]


@pytest.mark.parametrize("library", ["", "rpigpio"])
def test_a_computer_without_pins_is_named(monkeypatch: pytest.MonkeyPatch, library: str) -> None:
    monkeypatch.setattr(gpiozero.Device, "pin_factory", None)
    if library:
        monkeypatch.setenv("GPIOZERO_PIN_FACTORY", library)
    else:
        monkeypatch.delenv("GPIOZERO_PIN_FACTORY", raising=False)
    with threaded_agent("a", devices={"pir": {"type": PinMotion, "settings": {"pin": 4}}}) as agent:
        error = agent.wait_for_event("task_failed", task="pir")["error"]
        assert error.startswith("this computer has no pins that gpiozero can use (")


@pytest.mark.parametrize(
    ("cls", "settings", "problem"),
    [
        (PinMotion, {"pin": 28}, "pin: expected an integer <= 27"),
        (PinDistance, {"trigger": 4, "echo": 4}, "trigger and echo are two pins"),
        (PinMotors, {**WHEELS, "right": [17, 23]}, "pin 17 is named twice"),
        (PinMotors, {**WHEELS, "wheel_base_m": 0}, "wheel_base_m"),
    ],
)
def test_settings_that_make_no_sense_are_named(cls: Any, settings: dict[str, Any], problem: str) -> None:
    assert problem in "; ".join(map(str, check_settings(cls.Settings, settings)))


def test_they_refuse_virtual_time_with_a_sentence(virtual_agent: Any) -> None:
    agent = virtual_agent("a", devices={"pir": {"type": PinMotion, "settings": {"pin": 4}}})
    failed = agent.wait_for_event("task_failed", task="pir")
    assert "a/device/pir is real hardware, which knows no virtual time" in failed["error"]
