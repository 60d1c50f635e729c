"""`EnergyGovernor`: keeps a mission alive by letting other tasks do less (`energy.governor`, paper §3.4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pancakes.bodies.devices.types import Battery, Load
from pancakes.bodies.energy.governing import Governing, GovernorSettings
from pancakes.bodies.energy.rim import AdjustingTask
from pancakes.packet import SYSTEM, Packet, agent_of
from pancakes.task import Tick, every, on


class EnergyGovernor(AdjustingTask):
    """Watches the battery of its agent, and turns down rates, settings and the network, by its policy.

    All of it by control packets. It sets everything back when the battery has recovered, and when it is stopped. Event:
    `effort_changed`.
    """

    requires = ("battery",)

    Settings = GovernorSettings

    @dataclass
    class State:
        """What outlives a restart.

        Attributes:
            effort: what was decided last.
            turned: whether any knob was ever turned.
        """

        effort: float = 1.0
        turned: bool = False

    settings: GovernorSettings
    state: State
    decider: Governing

    def on_start(self) -> None:
        self.decider = Governing(self.settings, self.now(), self.state.effort, self.state.turned)

    def on_settings(self) -> None:
        # What the old settings turned down and the new ones do not name is set back first.
        self.give_last(self.decider.give_back(self.now()))
        self.decider = Governing(self.settings, self.now(), self.state.effort, True)

    @on(SYSTEM, Battery, keep="latest")
    def measured(self, packet: Packet) -> None:
        """Takes a reading of the battery."""
        if agent_of(packet.source) == self.agent:
            self.decider.battery(self.now(), packet.body.level)

    @on(SYSTEM, Load, keep="latest")
    def loaded(self, packet: Packet) -> None:
        """Takes a reading of the processor's load."""
        if agent_of(packet.source) == self.agent:
            self.decider.load(packet.body.cpu)

    @every(hz=1)
    def decide(self, tick: Tick) -> None:
        """Decides, and gives the orders that follow."""
        orders = self.decider.decide(self.now())
        effort = self.decider.effort
        if effort != self.state.effort:
            self.state.effort = effort
            told: dict[str, Any] = {"effort": effort, "level": self.decider.level, "policy": self.settings.policy}
            self.event("effort_changed", **told)
        self.give(orders)
        self.state.turned = self.state.turned or self.decider.book.turned
