"""The base of simulated worlds: `SimulatedWorld`, a task that answers the hardware bus and reports the truth.

A world owns its simulator, in one actor. Devices of other agents reach it over the hardware bus (`hardware_bus.py`), as
they would reach the wires of their robot. `Simulation.world()`, the demos, the page and the report know a world by this
class and by what it publishes, never by its name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pancakes.errors import PancakesError
from pancakes.packet import SYSTEM
from pancakes.sim.bodies import WorldSettings
from pancakes.sim.hardware_bus import (
    Attach,
    Attached,
    BusServer,
    Drive,
    Halt,
    RawCommand,
    Reading,
    Refused,
    Reply,
    Requested,
    Sample,
)
from pancakes.sim.robot_models import Wheels
from pancakes.sim.world_state import WorldState
from pancakes.task import Task

EARLY_S = 1e-6
"""A clock that reads this much less than a moment means that moment."""


class SimulatedWorld(Task):
    """A simulated world. Derive from it to bring a simulator of your own, in an agent of the role `environment`.

    A subclass makes its simulator in `on_start` and calls `super().on_start()` then, which opens the hardware bus. It
    lets the simulator follow the mission clock in `advance`, answers devices in the methods below, publishes the truth
    with `publish_truth`, and reports incidents with `incident`. All of it runs in the actor of the task.

    A request that cannot be served raises a `PancakesError`; its sentence goes to the log of the device's agent. What a
    subclass does not override is refused.
    """

    @dataclass
    class Settings(WorldSettings):
        """The contents of the world, and its address. They are read once, when the task starts.

        Attributes:
            bus: address at which simulated devices reach it.
        """

        bus: str = "tcp://127.0.0.1:7499"

    settings: Any
    _server: BusServer | None = None

    def on_start(self) -> None:
        """Open the hardware bus. The simulator must exist by then."""
        self._server = BusServer(self._actor.kernel.transport, self.call, self._serve, self.log)
        address = self._server.listen(self.settings.bus)
        self.log("info", f"the hardware bus listens at {address}")

    def on_stop(self) -> None:
        """Close the hardware bus, so that the devices notice."""
        if self._server is not None:
            self._server.close()

    def on_failure(self, *error: Any) -> None:
        """Close the hardware bus, so that a world that is started again can have its address."""
        SimulatedWorld.on_stop(self)

    def on_settings(self) -> None:
        """Warn: a simulator that runs keeps its contents."""
        self.log("warning", "a world that runs keeps its contents: its new settings count from its next start")

    # What a subclass provides ------------------------------------------------------------------------------------

    def truth(self) -> WorldState:
        """Return what all bodies do, as of the newest step. To be read between two turns, in virtual time."""
        raise NotImplementedError(f"{type(self).__qualname__} has no truth(): what do its bodies do?")

    def advance(self) -> None:
        """Advance the simulator to the present, `self.now()`. Called before each request is answered."""

    def check(self, body: str, device_type: str, model: str) -> None:
        """Make sure that a body has a device of a type.

        Args:
            body: the body's name.
            device_type: the type of the device.
            model: for `motors`, the robot model that the device believes it drives; else empty.

        Raises:
            PancakesError: it has not.
        """
        raise PancakesError(f"the simulated world has no device of the type {device_type!r}, and no body {body!r}")

    def sample(self, body: str, device_type: str) -> Any:
        """Return the reading of a body's sensor, a body of the packet type `device_type`.

        Raises:
            PancakesError: there is no such body, or it has no such sensor.
        """
        raise PancakesError(f"the simulated world has no sensor of the type {device_type!r}")

    def drive(self, body: str, wheels: Wheels, ttl_s: float, source: str) -> None:
        """Let a robot's two wheels run for the next `ttl_s` mission seconds, or until the next command.

        Args:
            body: the robot's name.
            wheels: how fast the wheels are to run. They may be no numbers, or faster than the robot can.
            ttl_s: for how long the command is good; then the wheels must stop.
            source: address of the task that gave the command.

        Raises:
            PancakesError: there is no such robot, or the command cannot be carried out.
        """
        raise PancakesError(f"nothing in this simulated world has wheels, and {body} is not a robot")

    def act(self, body: str, device_type: str, command: Any, ttl_s: float, source: str) -> None:
        """Carry out a command to an actuator other than wheels; the other end is a `SimulatedActuator`.

        Args:
            body: the body's name.
            device_type: the type of the actuator.
            command: a body of that packet type, decoded; its numbers are finite and within their bounds.
            ttl_s: for how long it is good; then the actuator must go to its safe hold.
            source: address of the task that gave it.

        Raises:
            PancakesError: there is no such body, or it has no such actuator.
        """
        raise PancakesError(f"the simulated world has no actuator of the type {device_type!r}")

    def hold(self, body: str, device: str) -> None:
        """Bring an actuator of a body to its safe hold; `device` is its name in the body's agent.

        Raises:
            PancakesError: there is no such body.
        """
        raise PancakesError(f"nothing in this simulated world has wheels, and {body} is not a robot")

    def radio(self, body: str, packets_sent: int | None, listening: bool | None) -> None:
        """Take what a body's agent reports about its radio, which may drain its battery.

        Args:
            body: the body's name; it may be unknown.
            packets_sent: how many mission packets its agent has sent so far; None: nothing new.
            listening: whether its radio listens; None: nothing new.
        """

    # What it does ------------------------------------------------------------------------------------------------

    def publish_truth(self) -> None:
        """Publish the truth, as a `world_state` on `system`."""
        self.publish(SYSTEM, self.truth())

    def incident(self, kind: str, time_s: float, names: tuple[str, ...], x_m: float, y_m: float) -> None:
        """Report an incident as an event, which judges count.

        Args:
            kind: `collision` or `out_of_bounds`.
            time_s: mission time.
            names: the bodies that it concerns.
            x_m: where it happened.
            y_m: where it happened.
        """
        self.event(kind, time_s=time_s, names=list(names), x_m=x_m, y_m=y_m)

    def _serve(self, request: Requested) -> Reply | None:
        """Answer a request of a simulated device, at the world's present."""
        self.advance()
        try:
            if type(request) is Sample:  # before the others: most of all are
                if request.packets_sent is not None or request.listening is not None:
                    self.radio(request.body, request.packets_sent, request.listening)
                return Reading(request.device, request.type, self.sample(request.body, request.type))
            match request:
                case Drive():
                    wheels = Wheels(request.left_mps, request.right_mps)
                    self.drive(request.body, wheels, request.ttl_s, request.source)
                case RawCommand():
                    self.act(request.body, request.type, request.command(), request.ttl_s, request.source)
                case Attach():
                    self.check(request.body, request.type, request.model)
                    return Attached(request.device)
                case Halt():
                    self.hold(request.body, request.device)
        except PancakesError as error:
            return Refused(request.device, str(error))
        return None
