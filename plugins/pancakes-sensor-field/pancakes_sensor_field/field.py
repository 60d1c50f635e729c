"""The task that is a simulated field (`sensor_field.Field`): it answers the hardware bus, and publishes the truth.

It runs in an agent of the role `environment`, as `sim.world` does, and on the same bus: a node's `sim.motion` and
`sim.battery` and its `sensor_field.temperature` ask here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import msgspec

from pancakes.devices import Battery, Motion, Temperature
from pancakes.errors import PancakesError
from pancakes.packet import SYSTEM
from pancakes.sim.battery import BatteryModel
from pancakes.sim.hardware_bus import Attach, Attached, BusServer, Reading, Refused, Reply, Request, Sample
from pancakes.sim.world_state import BodyState, WorldState
from pancakes.task import Task, Tick, every
from pancakes_sensor_field.packets import FieldTruth, NodeTruth
from pancakes_sensor_field.physics import NodeSettings, Scene, SceneSettings

SENSES: Final = ("temperature", "motion", "battery")
FULL_V: Final = 4.2
EMPTY_V: Final = 3.3
"""Voltages of a lithium cell."""


class Field(Task):
    """The simulated field.

    It publishes `world_state` and `sensor_field.truth` on its own `system`, 5 times a second unless `rate_hz` is set.
    """

    @dataclass
    class Settings(SceneSettings):
        """The scene, and how to reach it.

        Attributes:
            bus: address at which simulated devices reach it.
        """

        bus: str = "tcp://127.0.0.1:7499"

    settings: Settings
    _server: BusServer | None = None

    def on_start(self) -> None:
        self._scene = Scene(self.settings)
        self._batteries = {
            name: BatteryModel(node.battery, FULL_V, EMPTY_V)
            for name, node in self.settings.nodes.items()
            if node.battery is not None
        }
        self._now_s = self.now()
        self._server = BusServer(self._actor.kernel.transport, self.call, self._serve, self.log)
        address = self._server.listen(self.settings.bus)
        self.log("info", f"the hardware bus listens at {address}")

    def on_stop(self) -> None:
        if self._server is not None:
            self._server.close()

    def on_failure(self, *error: Any) -> None:
        self.on_stop()

    def on_settings(self) -> None:
        self.log("warning", "a simulated field keeps its settings until its next start")

    @every(hz=5)
    def tell(self, tick: Tick) -> None:
        """Publish the state of the field."""
        self._advance()
        now_s = self._now_s
        nodes = tuple(self._truth(name, now_s) for name in self.settings.nodes)
        self.publish(SYSTEM, FieldTruth(now_s, nodes))
        bodies = [self._body(name, node) for name, node in self.settings.nodes.items()]
        bodies += [
            BodyState(walker.name, "mover", walker.x_m, walker.y_m, walker.theta_rad, walker.speed_mps, 0.0)
            for walker in self._scene.walkers(now_s)
        ]
        self.publish(SYSTEM, WorldState(now_s, tuple(bodies)))

    def _truth(self, name: str, now_s: float) -> NodeTruth:
        celsius, moving = self._scene.celsius(name, now_s), self._scene.moving(name, now_s)
        battery = self._batteries.get(name)
        if battery is None:
            return NodeTruth(name, celsius, moving)
        return NodeTruth(name, celsius, moving, battery.level, battery.listening, battery.spent)

    def _body(self, name: str, node: NodeSettings) -> BodyState:
        battery = self._batteries.get(name)
        if battery is None:
            return BodyState(name, "sensor", node.x_m, node.y_m, 0.0, 0.0, 0.0)
        volts, spent = battery.voltage_v, battery.spent
        return BodyState(name, "sensor", node.x_m, node.y_m, 0.0, 0.0, 0.0, volts, spent=spent)

    def _advance(self) -> None:
        """Drain the batteries for the time up to now."""
        now_s = self.now()
        for battery in self._batteries.values():
            battery.passed(now_s - self._now_s, 0.0)
        self._now_s = now_s

    def _serve(self, request: Request) -> Reply | None:
        """Answer a request of a simulated device."""
        self._advance()
        try:
            return self._answer(request)
        except PancakesError as error:
            return Refused(request.device, str(error))

    def _answer(self, request: Request) -> Reply | None:
        node = self.settings.nodes.get(request.body)
        if node is None:
            known = ", ".join(self.settings.nodes) or "none"
            raise PancakesError(f"the simulated field has no node {request.body!r}, only {known}")
        match request:
            case Attach():
                self._check(request.body, request.type)
                return Attached(request.device)
            case Sample():
                self._hear_of_radio(request)
                value = msgspec.to_builtins(self._sample(request.body, request.type))
                return Reading(request.device, request.type, value)
        raise PancakesError(f"nothing in a simulated field has wheels, and {request.body} is not a robot")

    def _hear_of_radio(self, request: Sample) -> None:
        """Take what a node reports about its radio when it asks for its battery."""
        battery = self._batteries.get(request.body)
        if battery is not None and request.packets_sent is not None:
            battery.packets_sent(request.packets_sent)
        if battery is not None and request.listening is not None:
            battery.listening = request.listening

    def _check(self, node: str, device_type: str) -> None:
        if device_type not in SENSES:
            raise PancakesError(f"a node of a simulated field has no device of the type {device_type!r}")
        if device_type == "battery" and node not in self._batteries:
            raise PancakesError(f"the node {node} of the simulated field has no battery")

    def _sample(self, node: str, device_type: str) -> Any:
        self._check(node, device_type)
        battery = self._batteries.get(node)
        if battery is not None:
            battery.sampled(device_type)
        if device_type == "temperature":
            celsius = self._scene.celsius(node, self._now_s)
            return Temperature(celsius + self.settings.noise_c * self.random.gauss(0.0, 1.0))
        if device_type == "motion":
            return Motion(self._scene.moving(node, self._now_s))
        settings = self.settings.nodes[node].battery
        assert battery is not None and settings is not None
        voltage_v = battery.voltage_v + settings.noise_v * self.random.gauss(0.0, 1.0)
        return Battery(voltage_v, battery.level_at(voltage_v))
