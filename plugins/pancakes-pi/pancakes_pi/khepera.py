"""The devices of a Khepera III on a serial line (`khepera3.*`): wheels, infrared sensors, sonars, battery."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from msgspec import Meta

from pancakes.devices import Battery, Infrared, Sonar, Twist
from pancakes.devices.driver import Actuator, Hardware, Sensor
from pancakes.settings import FilePath
from pancakes.sim.robot_models import KHEPERA_III
from pancakes_pi.khepera_lines import (
    CHARGE,
    PROXIMITY,
    SONARS,
    VOLTAGE,
    NoAnswerError,
    echo_in,
    ring_in,
    share_in,
    sonar,
    volts_in,
)
from pancakes_pi.khepera_port import KheperaPort, khepera_port
from pancakes_pi.real_hardware import refuse_virtual_time


@dataclass
class KheperaSettings:
    """Where the robot is.

    Attributes:
        port: the file of its serial port, such as `/dev/ttyUSB0` or `/dev/rfcomm0`.
        baud: bits a second.
    """

    port: FilePath
    baud: Annotated[int, Meta(ge=50)] = 115_200


class KheperaMotors(Actuator):
    """The wheels of a Khepera III (`khepera3.motors`).

    Its controller keeps the last speed where the agent is killed or the cable pulled out: it has no dead-man switch.
    """

    type = "motors"

    @dataclass
    class Settings(KheperaSettings, Actuator.Settings):
        """Where the robot is."""

    settings: Settings
    _port: KheperaPort | None = None
    _unheard = False

    @classmethod
    def hardware(cls, settings: Any) -> Sequence[Hardware]:
        return (Hardware(settings.port, "dialout"),)

    def open(self) -> None:
        refuse_virtual_time(self.context)
        self._port = khepera_port(self.context, self.settings.port, self.settings.baud)

    def write(self, command: Twist, ttl_s: float, source: str) -> None:
        drive = KHEPERA_III.drive
        wheels = drive.wheels(command)
        assert self._port is not None
        heard = self._port.drive(
            round(wheels.left_mps * drive.units_per_mps), round(wheels.right_mps * drive.units_per_mps)
        )
        if not heard and not self._unheard:
            self.context.log("warning", "commands are lost: the robot is not there")
        self._unheard = not heard

    def safe_stop(self) -> None:
        """Both wheels stand."""
        if self._port is not None:
            self._port.drive(0, 0)


class KheperaSensor(Sensor):
    """A sensor of a Khepera III, asked at the device's rate; its readings come when the robot has answered."""

    @dataclass
    class Settings(KheperaSettings, Sensor.Settings):
        """Where the robot is."""

    settings: Settings
    questions: tuple[str, ...] = ()
    _port: KheperaPort | None = None

    @classmethod
    def hardware(cls, settings: Any) -> Sequence[Hardware]:
        return (Hardware(settings.port, "dialout"),)

    def open(self) -> None:
        refuse_virtual_time(self.context)
        self._port = khepera_port(self.context, self.settings.port, self.settings.baud)

    def close(self) -> None:
        if self._port is not None:
            self._port.forget(self.context.device)

    def read(self) -> None:
        """Asks the robot."""
        assert self._port is not None
        self._port.ask(self.context.device, self.questions, self._answered)

    @abstractmethod
    def body(self, answers: list[list[int]]) -> Any:
        """Returns the reading in the answers. In the port's thread. Raises NoAnswerError."""

    def _answered(self, answers: list[list[int]]) -> None:
        try:
            self.context.deliver(self.body(answers))
        except NoAnswerError as error:
            self.context.missed(f"an answer is left out: {error}")


class KheperaInfrared(KheperaSensor):
    """The ring of nine infrared sensors (`khepera3.ir`)."""

    type = "ir"
    questions = (PROXIMITY,)

    def body(self, answers: list[list[int]]) -> Infrared:
        ring = KHEPERA_III.ir
        assert ring is not None
        raw = ring_in(answers[0])
        bearings = tuple(sensor.bearing_rad for sensor in ring.sensors)
        ranges = tuple(ring.curve.distance(float(value)) for value in raw)
        return Infrared(bearings, ranges, ring.curve.farthest_m, raw)


class KheperaSonar(KheperaSensor):
    """The five sonars (`khepera3.sonar`). Each takes a while: a rate of 2 Hz is what the robot can do."""

    type = "sonar"
    questions = tuple(sonar(number) for number in range(1, SONARS + 1))

    def body(self, answers: list[list[int]]) -> Sonar:
        ring = KHEPERA_III.sonar
        assert ring is not None
        found = [echo_in(answer) for answer in answers]
        ranges = tuple(ring.max_range_m if it is None else min(it, ring.max_range_m) for it in found)
        return Sonar(tuple(sensor.bearing_rad for sensor in ring.sensors), ranges, ring.max_range_m)


class KheperaBattery(KheperaSensor):
    """The battery (`khepera3.battery`)."""

    type = "battery"
    questions = (VOLTAGE, CHARGE)

    def body(self, answers: list[list[int]]) -> Battery:
        return Battery(volts_in(answers[0]), share_in(answers[1]))
