"""The pins of a Raspberry Pi, by gpiozero: a motion sensor, a sensor of distance, two wheels (`pi.*`)."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any

from msgspec import Meta

from pancakes.devices import Motion, Sonar, Twist
from pancakes.devices.driver import Actuator, DeviceContext, Hardware, Sensor
from pancakes.errors import PancakesError
from pancakes.settings import Positive
from pancakes.sim.robot_models import DriveKinematics
from pancakes_pi.real_hardware import refuse_virtual_time

Pin = Annotated[int, Meta(ge=0, le=27)]
"""A pin's number as the processor counts (BCM): GPIO17 is 17."""
GPIO = (Hardware("/dev/gpiochip0", "gpio"), Hardware("/dev/gpiomem", "gpio"))


@contextmanager
def sentences_of_gpiozero() -> Iterator[None]:
    """Makes a sentence of what gpiozero raises in its block."""
    from gpiozero.exc import BadPinFactory, GPIOZeroError

    try:
        # gpiozero warns of each library that it does not find, on its way to the next one.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (BadPinFactory, ImportError) as error:  # an ImportError where GPIOZERO_PIN_FACTORY names a library
        text = " ".join(str(error).split())
        raise PancakesError(
            f"this computer has no pins that gpiozero can use ({text}): apt install python3-lgpio, or pip install lgpio"
        ) from None
    except GPIOZeroError as error:
        raise PancakesError(" ".join(str(error).split())) from None


class PinMotion(Sensor):
    """A motion sensor on a pin, such as a PIR (`pi.motion`). It speaks by itself, and at its rate where it has one."""

    type = "motion"
    rate = "optional"

    @dataclass
    class Settings:
        """Where it is.

        Attributes:
            pin: its pin.
            active_high: whether the pin is high where something moves.
        """

        pin: Pin
        active_high: bool = True

    settings: Settings
    _input: Any = None

    @classmethod
    def hardware(cls, settings: Any) -> Sequence[Hardware]:
        return GPIO

    def open(self) -> None:
        refuse_virtual_time(self.context)
        with sentences_of_gpiozero():
            from gpiozero import DigitalInputDevice

            self._input = DigitalInputDevice(self.settings.pin, pull_up=None, active_state=self.settings.active_high)
            # Called in a thread of gpiozero's.
            self._input.when_activated = lambda: self.context.deliver(Motion(True))
            self._input.when_deactivated = lambda: self.context.deliver(Motion(False))
        self.context.deliver(self.read())

    def close(self) -> None:
        if self._input is not None:
            self._input.close()

    def read(self) -> Motion:
        return Motion(bool(self._input.is_active))


class PinDistance(Sensor):
    """An ultrasonic sensor with a trigger and an echo, such as the HC-SR04 (`pi.distance`): a sonar with one bearing.

    An HC-SR04 answers with 5 V, and a pin takes 3.3 V: two resistors belong between them.
    """

    type = "sonar"

    @dataclass
    class Settings:
        """Where it is.

        Attributes:
            trigger: the pin that asks.
            echo: the pin that answers.
            max_range_m: its full range, which is told where it hears nothing.
            bearing_rad: where it looks, in the frame of the body.
        """

        trigger: Pin
        echo: Pin
        max_range_m: Positive = 2.0
        bearing_rad: float = 0.0

        def __post_init__(self) -> None:
            if self.trigger == self.echo:
                raise ValueError("trigger and echo are two pins")

    settings: Settings
    _sensor: Any = None

    @classmethod
    def hardware(cls, settings: Any) -> Sequence[Hardware]:
        return GPIO

    def open(self) -> None:
        refuse_virtual_time(self.context)
        settings = self.settings
        with sentences_of_gpiozero():
            from gpiozero import DistanceSensor

            self._sensor = DistanceSensor(
                echo=settings.echo, trigger=settings.trigger, max_distance=settings.max_range_m, partial=True
            )

    def close(self) -> None:
        if self._sensor is not None:
            self._sensor.close()

    def read(self) -> Sonar | None:
        settings = self.settings
        range_m = min(float(self._sensor.distance), settings.max_range_m)
        if range_m <= 0.0:  # so gpiozero says that it has measured nothing yet
            return None
        return Sonar((settings.bearing_rad,), (range_m,), settings.max_range_m)


class PinMotors(Actuator):
    """Two wheels on a motor board with an H bridge for each: L298N, DRV8833, TB6612 and the like (`pi.motors`).

    Pins keep their last level where the process is killed: the wheels then turn on. Let a watchdog of the board, or of
    the system, end that.
    """

    type = "motors"

    @dataclass
    class Settings:
        """Where the wheels are.

        Attributes:
            left: the pins that turn the left wheel forward and backward.
            right: those of the right wheel.
            wheel_base_m: distance between the wheels.
            max_wheel_mps: how fast a wheel runs over the ground at full power; speed is taken to be proportional.
            left_enable, right_enable: the enable pins, where the board has such.
        """

        left: tuple[Pin, Pin]
        right: tuple[Pin, Pin]
        wheel_base_m: Positive
        max_wheel_mps: Positive
        left_enable: Pin | None = None
        right_enable: Pin | None = None

        def __post_init__(self) -> None:
            pins = [*self.left, *self.right, *(it for it in (self.left_enable, self.right_enable) if it is not None)]
            if twice := next((pin for pin in pins if pins.count(pin) > 1), None):
                raise ValueError(f"pin {twice} is named twice")

    settings: Settings

    def __init__(self, context: DeviceContext, settings: Any) -> None:
        super().__init__(context, settings)
        self._wheels: list[Any] = []

    @cached_property
    def _drive(self) -> DriveKinematics:
        settings = self.settings
        fastest_radps = 2 * settings.max_wheel_mps / settings.wheel_base_m
        return DriveKinematics(
            settings.wheel_base_m, settings.max_wheel_mps, settings.max_wheel_mps, fastest_radps, units_per_mps=1.0
        )

    @classmethod
    def hardware(cls, settings: Any) -> Sequence[Hardware]:
        return GPIO

    def open(self) -> None:
        refuse_virtual_time(self.context)
        settings = self.settings
        with sentences_of_gpiozero():
            from gpiozero import Motor

            pins = ((settings.left, settings.left_enable), (settings.right, settings.right_enable))
            for (forward, backward), enable in pins:
                self._wheels.append(Motor(forward, backward, enable=enable))

    def close(self) -> None:
        for wheel in self._wheels:
            wheel.close()

    def write(self, command: Twist, ttl_s: float, source: str) -> None:
        wheels = self._drive.wheels(command)
        for wheel, speed_mps in zip(self._wheels, (wheels.left_mps, wheels.right_mps), strict=True):
            wheel.value = min(1.0, max(-1.0, speed_mps / self.settings.max_wheel_mps))

    def safe_stop(self) -> None:
        """Both wheels stand."""
        for wheel in self._wheels:
            wheel.stop()
