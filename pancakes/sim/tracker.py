"""The tracker (`sim.tracker`): tells the fleet where bodies of the world are that do not tell it themselves.

It stands for a camera over the arena: it sees what is no robot of the fleet, and robots whose agents have died. The
barriers of robots keep clear of what it tells (docs/filters.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec

from pancakes.devices import RobotPose
from pancakes.devices.driver import Pace
from pancakes.events import Event
from pancakes.packet import LOG, NEIGHBOURS, SYSTEM, Packet, agent_of
from pancakes.settings import NotNegative, Positive
from pancakes.sim.world_state import WorldState
from pancakes.task import Task, on


class Tracked(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a body is like.

    Attributes:
        radius_m: the radius of a circle around its centre that holds all of it.
        max_mps: how fast it may move.
    """

    radius_m: Positive
    max_mps: NotNegative


class Tracker(Task):
    """Tell all neighbours where bodies are.

    Needs the task `sim.world`, or another simulated world, on the same agent.
    """

    @dataclass
    class Settings:
        """Which bodies it tells of.

        Attributes:
            bodies: what each of them is like, by its name in the world: `mover = { radius_m = 0.2, max_mps = 0.5 }`.
            tell_hz: how often.
            only_unlinked: whether it tells only of bodies whose agents are not linked with this one, such as robots
                that have died; else of all.
        """

        bodies: dict[str, Tracked] = field(default_factory=dict)
        tell_hz: Positive = 10.0
        only_unlinked: bool = False

    settings: Settings

    def on_start(self) -> None:
        self._missing_told = False
        self._linked: set[str] = set()
        self.on_settings()

    def on_settings(self) -> None:
        self._pace = Pace(self.settings.tell_hz)
        self._missing_told = False

    @on(LOG, Event)
    def link_changed(self, packet: Packet) -> None:
        """Take note of agents that are linked with this one."""
        event = packet.body
        if agent_of(packet.source) == self.agent and event.kind in ("peer_up", "peer_down"):
            peer = str(event.fields.get("peer", ""))
            if event.kind == "peer_up":
                self._linked.add(peer)
            else:
                self._linked.discard(peer)

    @on(SYSTEM)
    def seen(self, state: WorldState) -> None:
        """Tell where the bodies are, when it is time."""
        if not self._pace.due(state.time_s):
            return
        bodies = {body.name: body for body in state.bodies}
        for name, it in self.settings.bodies.items():
            if self.settings.only_unlinked and name in self._linked:
                continue
            if (body := bodies.get(name)) is not None:
                told = RobotPose(name, body.x_m, body.y_m, body.theta_rad, it.radius_m, it.max_mps)
                self.publish(SYSTEM, told, NEIGHBOURS)
        missing = [name for name in self.settings.bodies if name not in bodies]
        if missing and not self._missing_told:
            self._missing_told = True
            self.log.error(f"the tracker is to tell of {', '.join(missing)}, which the world has not")
