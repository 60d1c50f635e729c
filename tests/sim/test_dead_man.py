"""The wheels of a simulated robot hold by themselves: the world stands for the firmware, and outlives the agent."""

from typing import Any

import pytest

from pancakes.control import Describe
from pancakes.devices import Twist
from pancakes.packet import CTRL
from pancakes.task import Task, every
from pancakes.testing import Fleet

BUS = "tcp://127.0.0.1:7499"
WORLD = {
    "bus": BUS,
    "robots": {"a": {"x_m": 0.0, "y_m": 0.0, "spread_m": 0.0, "spread_rad": 0.0}},
    "sensors": {},
    "movers": {},
}


class Driving(Task):
    """Drive straight on, with ten commands a second."""

    requires = ("motors",)

    @every(hz=10)
    def drive(self, tick):
        self.publish(CTRL, Twist(0.1, 0.0))


@pytest.fixture
def fleet():
    with Fleet(seed=3) as made:
        made.start("world", tasks={"World": {"type": "sim.world", "settings": WORLD}}, role="environment")
        wheels = {"type": "sim.differential_drive", "settings": {"world": BUS}, "hold_after_mission_s": 0.4}
        made.start("a", devices={"motors": wheels}, tasks={"Driving": Driving})
        made.run_for(2.0)
        yield made


def speeds(fleet, for_s):
    """Return how fast the robot was, each time that the world said so."""
    seen: list[Any] = []

    def see(packet):
        seen.extend((packet.stamp_s, body.v_mps) for body in packet.body.bodies if body.name == "a")

    stream = fleet.agents["world"].kernel.stream
    stream.tap("system", see, ("world_state",))
    fleet.run_for(for_s)
    stream.untap("system", see)
    return seen


def test_its_driver_says_so(fleet):
    assert fleet.agents["a"].ask(Describe("motors")).result["watchdog_s"] == 0.4


def test_they_stand_once_the_last_command_of_an_agent_that_is_gone_is_stale(fleet):
    before = speeds(fleet, 0.5)
    assert before and all(v_mps > 0.05 for _, v_mps in before)
    fleet.crash("a")
    gone_s = fleet.now()
    after = speeds(fleet, 2.0)
    assert any(v_mps > 0.05 for at_s, v_mps in after if at_s < gone_s + 0.25), "its last command is good yet"
    assert all(v_mps == 0.0 for at_s, v_mps in after if at_s > gone_s + 0.5)
    assert len([at_s for at_s, _ in after if at_s > gone_s + 0.5]) > 5
