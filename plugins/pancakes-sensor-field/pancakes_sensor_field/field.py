"""The task that is a simulated field (`sensor_field.Field`): it answers the hardware bus, and publishes the truth.

It runs in an agent of the role `environment`, as `sim.world` does, and on the same bus: a node's `sim.motion` and
`sim.battery` and its `sensor_field.temperature` ask here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from pancakes import SYSTEM, PancakesError, Tick, every
from pancakes.devices import Battery, Motion, Temperature
from pancakes.worlds import BatteryModel, BodyState, SimulatedWorld, WorldState
from pancakes_sensor_field.packets import FieldTruth, NodeTruth
from pancakes_sensor_field.physics import NodeSettings, Scene, SceneSettings

SENSES: Final = ("temperature", "motion", "battery")
FULL_V: Final = 4.2
EMPTY_V: Final = 3.3
"""Voltages of a lithium cell."""


class Field(SimulatedWorld):
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

    def on_start(self) -> None:
        self._scene = Scene(self.settings)
        self._batteries = {
            name: BatteryModel(node.battery, FULL_V, EMPTY_V)
            for name, node in self.settings.nodes.items()
            if node.battery is not None
        }
        self._now_s = self.now()
        super().on_start()

    @every(hz=5)
    def tell(self, tick: Tick) -> None:
        """Publish the state of the field."""
        self.advance()
        now_s = self._now_s
        nodes = tuple(self._node(name, now_s) for name in self.settings.nodes)
        self.publish(SYSTEM, FieldTruth(now_s, nodes))
        self.publish_truth()

    def truth(self) -> WorldState:
        now_s = self._now_s
        bodies = [self._body(name, node) for name, node in self.settings.nodes.items()]
        bodies += [
            BodyState(walker.name, "mover", walker.x_m, walker.y_m, walker.theta_rad, walker.speed_mps, 0.0)
            for walker in self._scene.walkers(now_s)
        ]
        return WorldState(now_s, tuple(bodies))

    def _node(self, name: str, now_s: float) -> NodeTruth:
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

    def advance(self) -> None:
        """Drain the batteries for the time up to now."""
        now_s = self.now()
        for battery in self._batteries.values():
            battery.passed(now_s - self._now_s, 0.0)
        self._now_s = now_s

    def check(self, body: str, device_type: str, model: str = "") -> None:
        if body not in self.settings.nodes:
            known = ", ".join(self.settings.nodes) or "none"
            raise PancakesError(f"the simulated field has no node {body!r}, only {known}")
        if device_type not in SENSES:
            raise PancakesError(f"a node of a simulated field has no device of the type {device_type!r}")
        if device_type == "battery" and body not in self._batteries:
            raise PancakesError(f"the node {body} of the simulated field has no battery")

    def radio(self, body: str, packets_sent: int | None, listening: bool | None) -> None:
        """Take what a node reports about its radio when it asks for its battery."""
        battery = self._batteries.get(body)
        if battery is not None and packets_sent is not None:
            battery.packets_sent(packets_sent)
        if battery is not None and listening is not None:
            battery.listening = listening

    def sample(self, body: str, device_type: str) -> Any:
        self.check(body, device_type)
        battery = self._batteries.get(body)
        if battery is not None:
            battery.sampled(device_type)
        if device_type == "temperature":
            celsius = self._scene.celsius(body, self._now_s)
            return Temperature(celsius + self.settings.noise_c * self.random.gauss(0.0, 1.0))
        if device_type == "motion":
            return Motion(self._scene.moving(body, self._now_s))
        settings = self.settings.nodes[body].battery
        assert battery is not None and settings is not None
        voltage_v = battery.voltage_v + settings.noise_v * self.random.gauss(0.0, 1.0)
        return Battery(voltage_v, battery.level_at(voltage_v))
