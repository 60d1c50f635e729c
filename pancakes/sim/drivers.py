"""Drivers for the devices of a simulated robot or sensor node (`sim.*`).

The hardware is in the world's process, at the other end of the hardware bus. Asking a sensor does not block: the
reading is delivered when it arrives. A simulator of your own (`simulated_world.py`) is reached by the same drivers; for
a type that is not among them derive from `SimulatedSensor` or `SimulatedActuator`, and set `type`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

from pancakes.devices import DockState, Twist
from pancakes.devices.driver import Actuator, DeviceContext, Driver, Sensor
from pancakes.errors import PancakesError
from pancakes.packet import NEIGHBOURS, SYSTEM
from pancakes.settings import Positive
from pancakes.sim.hardware_bus import Attach, Attachment, BusClient, Command, Drive, Halt, RawReading, Request, Sample
from pancakes.sim.robot_models import robot_model


class BusDevice:
    """The end of one simulated device on the hardware bus.

    Args:
        context: the device's.
        world: address of the world's hardware bus.
        deliver: takes a reading, in the transport's thread; None: it is published as the device's reading.
    """

    def __init__(self, context: DeviceContext, world: str, deliver: Callable[[Any], None] | None = None) -> None:
        self._context = context
        self._deliver = deliver or context.deliver
        self._bus: BusClient = context.shared(
            f"sim.bus {world}", lambda: BusClient(context.transport, world, context.log)
        )
        self._refusal = ""
        self.waiting = False
        """Whether a request has no reply yet."""

    def attach(self, attach: Attach) -> None:
        self._bus.attach(Attachment(attach, self._reading, self._refused, self._lost))

    def detach(self) -> None:
        self._bus.detach(self._context.device)

    def send(self, request: Request) -> bool:
        return self._bus.send(request)

    def _reading(self, answer: RawReading) -> None:
        self.waiting = False
        try:
            body = answer.body()
        except PancakesError as error:
            self._refused(str(error))
            return
        self._deliver(body)

    def _refused(self, reason: str) -> None:
        self.waiting = False
        if reason != self._refusal:  # the same reason at each sample is logged only once
            self._refusal = reason
            self._context.log("error", reason)

    def _lost(self) -> None:
        self.waiting = False
        self._refusal = ""


class SimulatedDevice(Driver):
    """Open and close the hardware bus for a driver; its settings name the world and the body."""

    @dataclass
    class Settings:
        """Where the body is.

        Attributes:
            world: address of the world's hardware bus, such as `tcp://127.0.0.1:7499`.
            body: the body's name in the world; empty means the agent's name.
        """

        world: str
        body: str = ""

    context: DeviceContext
    settings: Settings
    type: ClassVar[str]
    _bus: BusDevice | None = None

    def _attach(self, model: str = "") -> None:
        self._body = self.settings.body or self.context.agent
        self._bus = BusDevice(self.context, self.settings.world)
        self._bus.attach(Attach(self._body, self.context.device, self.type, model))

    def close(self) -> None:
        if self._bus is not None:
            self._bus.detach()


class SimulatedSensor(SimulatedDevice, Sensor):
    """Read a sensor of a body in a simulated world."""

    reports_radio: ClassVar[bool] = False

    def open(self) -> None:
        self._attach()

    def read(self) -> Any | None:
        """Ask for a reading, which comes later. Only one request is pending at a time."""
        bus = self._bus
        if bus is not None and not bus.waiting:
            packets_sent = self.context.mission_packets_sent() if self.reports_radio else None
            listening = self.context.network_awake() if self.reports_radio else None
            bus.waiting = True  # before sending: the reply comes in another thread
            if not bus.send(Sample(self._body, self.context.device, self.type, packets_sent, listening)):
                bus.waiting = False
        return None


class SimulatedPose(SimulatedSensor):
    """The true pose of a body: for a robot by itself, without a motion capture (`sim.pose`)."""

    type = "pose"


class SimulatedBattery(SimulatedSensor):
    """A robot's battery, which also pays for its agent's radio: for what it sends, and while it listens
    (`sim.battery`)."""

    type = "battery"
    reports_radio = True


class SimulatedInfrared(SimulatedSensor):
    """A robot's ring of infrared sensors (`sim.ir`)."""

    type = "ir"


class SimulatedSonar(SimulatedSensor):
    """A robot's ring of sonars (`sim.sonar`)."""

    type = "sonar"


class SimulatedLaserScan(SimulatedSensor):
    """A robot's laser scanner (`sim.laser_scan`)."""

    type = "laser_scan"


class SimulatedEncoders(SimulatedSensor):
    """The encoders of a robot's wheels, `left` and `right` (`sim.encoders`)."""

    type = "encoders"


class SimulatedMotion(SimulatedSensor):
    """A sensor node's motion sensor (`sim.motion`)."""

    type = "motion"


class SimulatedActuator(SimulatedDevice, Actuator):
    """Command an actuator of a body in a simulated world, of the subclass's `type`; the world counts each command's
    time to live. Two wheels have a driver of their own, `DifferentialDrive`.
    """

    def open(self) -> None:
        self._attach()

    def write(self, command: Any, ttl_s: float, source: str) -> None:
        """Send a command. Without a connection to the world, it is lost."""
        if self._bus is not None:
            self._bus.send(Command(self._body, self.context.device, self.type, command, ttl_s, source))

    def watchdog_s(self, hold_after_s: float) -> float:
        """Return the hold time: the world, in place of a firmware, counts each command's time to live."""
        return hold_after_s

    def safe_stop(self) -> None:
        """Go to the safe hold at once."""
        if self._bus is not None:
            self._bus.send(Halt(self._body, self.context.device))


class DifferentialDrive(SimulatedActuator):
    """Drive the two wheels of a robot (`sim.differential_drive`).

    A command too fast for the wheels is slowed down with its curvature kept.
    """

    type = "motors"

    @dataclass
    class Settings(SimulatedActuator.Settings):
        """Where the robot is, and what its wheels are like.

        Attributes:
            model: what kind of robot it is; the world refuses another than its own.
            wheel_base_m: the distance between the wheels as it was measured on this robot, if that differs
                from the model's.
        """

        model: str = "khepera3"
        wheel_base_m: Positive | None = None

        def __post_init__(self) -> None:
            robot_model(self.model)  # an unknown one is a fault of the settings

    settings: Settings

    def open(self) -> None:
        model = robot_model(self.settings.model)
        self._kinematics = model.drive
        if self.settings.wheel_base_m is not None:
            self._kinematics = replace(model.drive, wheel_base_m=self.settings.wheel_base_m)
        self._attach(model.name)

    def write(self, command: Twist, ttl_s: float, source: str) -> None:
        """Run the wheels. Without a connection to the world, the command is lost."""
        if self._bus is None:
            return
        wheels = self._kinematics.wheels(command)
        self._bus.send(
            Drive(self._body, self.context.device, wheels.left_mps, wheels.right_mps, ttl_s, source),
        )


class SimulatedDock(SimulatedActuator):
    """A dock, whose holder is charged while it stands at it (`sim.dock`). At its rate it publishes a `dock_state`."""

    type = "dock"
    rate = "needed"

    def open(self) -> None:
        self._body = self.settings.body or self.context.agent
        self._bus = BusDevice(self.context, self.settings.world, self._told)
        self._bus.attach(Attach(self._body, self.context.device, self.type))

    def tick(self) -> None:
        """Ask the world what the dock does; the answer comes later."""
        bus = self._bus
        if bus is not None and not bus.waiting:
            bus.waiting = True  # before sending: the reply comes in another thread
            if not bus.send(Sample(self._body, self.context.device, "dock_state")):
                bus.waiting = False

    def _told(self, state: DockState) -> None:
        self.context.call(partial(publish_dock_state, self.context, state))


def publish_dock_state(context: DeviceContext, state: DockState) -> None:
    """Publish what a dock does, to its own agent and to all neighbours. In the device's actor.

    Args:
        context: of the dock's driver.
        state: what it does.
    """
    context.send(SYSTEM, state, "")
    context.send(SYSTEM, state, NEIGHBOURS)
