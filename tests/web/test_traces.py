"""Chains of packets are built from the reports of several agents."""

from __future__ import annotations

from typing import Any

import pytest

from pancakes.devices import Pose, Twist
from pancakes.packet import Packet
from pancakes.services.traces import TracedPackets
from pancakes.tools.web.command_causes import BUSY_S, IDLE_S, LOOK_S, PATIENCE_S, SOON_S, FleetTraces

MS = 1_000_000
POSE = Pose(1.0, 2.0, 0.0)


class Fleet:
    """A world that sends poses to a robot `a`, which answers each of them; and the page that asks both."""

    def __init__(self) -> None:
        self.agents = {name: TracedPackets(name) for name in ("world", "a")}
        self.traces = FleetTraces()
        for name in self.agents:
            self.traces.question(name)

    def react(self, ms: int, seq: int) -> None:
        """The pose takes 4 ms to the robot, which answers it 2 ms later."""
        sent = Packet("system", "pose", "world/client/Mocap", "a", ms / 1e3, seq, POSE)
        given = Packet("ctrl", "motors", "a/client/Scan", "", ms / 1e3, seq, Twist(0.1, 0.0), (sent.source, seq))
        self.agents["world"].hear(ms * MS, sent)
        self.agents["a"].hear((ms + 4) * MS, sent)
        self.agents["a"].hear((ms + 6) * MS, given)

    def ask(self, name: str, ms: int) -> Any:
        """Ask an agent as the page does; return the commands of which all is known then."""
        asked = self.traces.question(name)
        result = self.agents[name].answer(asked, ms * MS)
        self.traces.take(name, asked.packets, result, t=ms / 1e3)
        return self.traces.settled(ms / 1e3)


@pytest.fixture
def fleet() -> Fleet:
    return Fleet()


def test_chain_over_two_agents_is_completed(fleet: Fleet):
    fleet.react(100, 1)

    assert fleet.ask("a", 200) == []
    assert fleet.traces.question("world").packets == (("world/client/Mocap", 1),)
    ((t, command),) = fleet.ask("world", 250)
    assert t == pytest.approx(0.106)
    assert [round(1e3 * step.travel_s) for step in command.chain.steps] == [4, 0]
    assert [round(1e3 * step.handling_s) for step in command.chain.steps] == [2, 0]
    assert command.packet.body == "v_mps 0.1, omega_radps 0"
    assert fleet.traces.question("world").packets == ()


def test_each_command_is_returned_once_at_its_time(fleet: Fleet):
    found = []
    for seq in range(1, 6):
        fleet.react(100 * seq, seq)
        found += fleet.ask("a", 100 * seq + 50) + fleet.ask("world", 100 * seq + 60)
    assert [command.packet.seq for _, command in found] == [1, 2, 3, 4, 5]
    assert [t for t, _ in found] == pytest.approx([0.106, 0.206, 0.306, 0.406, 0.506])


def test_silent_agent_is_waited_for_only_so_long(fleet: Fleet):
    fleet.react(100, 1)
    fleet.ask("a", 200)

    assert fleet.traces.settled(0.2 + PATIENCE_S - 0.1) == []
    ((_, command),) = fleet.traces.settled(0.2 + PATIENCE_S + LOOK_S)
    assert [step.packet.source for step in command.chain.steps] == ["world/client/Mocap", "a/client/Scan"]


def test_unreachable_agent_is_not_waited_for(fleet: Fleet):
    fleet.traces.forget("world")
    fleet.react(100, 1)

    assert len(fleet.ask("a", 200)) == 1


def test_surplus_commands_are_counted(fleet: Fleet):
    for seq in range(1, 1001):
        fleet.react(7 * seq, seq)
    fleet.ask("a", 8000)
    assert fleet.traces.left_out("a") > 500


def test_agent_with_missing_causes_is_asked_sooner(fleet: Fleet):
    fleet.react(100, 1)
    fleet.ask("a", 200)
    assert (fleet.traces.pause_s("world"), fleet.traces.pause_s("a")) == (SOON_S, BUSY_S)
    fleet.ask("a", 300)
    fleet.ask("world", 300)
    fleet.ask("world", 400)
    assert (fleet.traces.pause_s("world"), fleet.traces.pause_s("a")) == (IDLE_S, IDLE_S)
