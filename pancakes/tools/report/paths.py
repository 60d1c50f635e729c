"""Where all bodies were, as agents believed and as the world knew, and which task commanded the wheels. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from pancakes.control import Hold
from pancakes.packet import CTRL, SYSTEM, Packet, agent_of
from pancakes.tools.report.series import TimeSeries

POSE, WORLD, BATTERY = "pose", "world_state", "battery"
MOST_BODIES = 64


@dataclass
class Body:
    """Something that has a place.

    Attributes:
        name: what it is called; of an agent, the agent's name.
        kind: `robot`, `sensor` or `mover` where the world says so; `agent` where only its own poses are known.
        path: time in seconds, x and y in metres, heading in radians.
    """

    name: str
    kind: str
    path: TimeSeries = field(default_factory=TimeSeries)


@dataclass(frozen=True)
class CommandSpan:
    """A time in which one task commanded an agent's actuators; `task` is the task's name."""

    task: str
    from_s: float
    to_s: float


@dataclass
class BodyPaths:
    """The paths, commands and batteries of a recording.

    Attributes:
        truth: the bodies of the world, by name.
        poses: what each agent took for its own pose.
        commands: which task commanded the actuators of each agent, and when.
        batteries: the level of each agent's battery, from 0 to 1, over time.
    """

    truth: dict[str, Body] = field(default_factory=dict)
    poses: dict[str, Body] = field(default_factory=dict)
    commands: dict[str, list[CommandSpan]] = field(default_factory=dict)
    batteries: dict[str, TimeSeries] = field(default_factory=dict)

    def add(self, agent: str, packet: Packet, t_s: float) -> None:
        """Takes a packet that was seen on an agent."""
        if packet.channel == SYSTEM:
            if packet.type == WORLD:
                self._add_world(packet.body, t_s)
            elif packet.type == POSE and packet.source.startswith(f"{agent}/device/"):
                body = self.poses.setdefault(agent, Body(agent, "agent"))
                body.path.add(t_s, packet.body.x_m, packet.body.y_m, packet.body.theta_rad)
            elif packet.type == BATTERY and packet.source.startswith(f"{agent}/device/"):
                self.batteries.setdefault(agent, TimeSeries()).add(t_s, packet.body.level)
        elif packet.channel == CTRL and not isinstance(packet.body, Hold) and agent_of(packet.source) == agent:
            self._add_command(agent, packet.source.rpartition("/")[2], t_s)

    def _add_world(self, state: Any, t_s: float) -> None:
        for it in state.bodies:
            body = self.truth.get(it.name)
            if body is None:
                if len(self.truth) >= MOST_BODIES:
                    continue
                body = self.truth[it.name] = Body(it.name, it.kind)
            body.path.add(t_s, it.x_m, it.y_m, it.theta_rad)

    def _add_command(self, agent: str, task: str, t_s: float) -> None:
        commands = self.commands.setdefault(agent, [])
        if commands and commands[-1].task == task:
            commands[-1] = CommandSpan(task, commands[-1].from_s, t_s)
        else:
            commands.append(CommandSpan(task, t_s, t_s))

    def bodies(self) -> list[Body]:
        """Returns the bodies to draw: those of the world, and agents of which only their own poses are known."""
        shown = [body for body in self.truth.values() if body.path.kept]
        return shown + [body for name, body in self.poses.items() if name not in self.truth]
