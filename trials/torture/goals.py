"""Kill the agent whose task has a goal at an action server of ROS 2: another one has it reached, no robot drives on.

The robots are action servers of another release in a process that is never struck, and the oracle: it says when a goal
is begun, and how it ends. Each has an agent; the task is guarded by three of these.
"""

from __future__ import annotations

import random
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from harness.report import spread
from ros2.ros_rig import RosAgent, RosPeer

from pancakes.client import Client
from pancakes.control import Guarding
from pancakes.errors import PancakesError

NAMES: Final = ("a", "b", "c", "d")
ACTION: Final = "test_msgs/action/Fibonacci"
LEASE_S: Final = 2.0
BEGINS_WITHIN_S: Final = LEASE_S + 1.5
"""The goal is sent to the next robot this long after the kill at the latest."""
STOPS_WITHIN_S: Final = 1.0
"""The robot whose agent was killed stands this long after the kill at the latest."""
CHECKPOINT_S: Final = 0.1
LATE_S: Final = 0.2
"""A checkpoint has come to the guardians this long after it was due."""
STEP_S: Final = 0.05
LEFT_S: Final = 0.8
"""So much of the way is left at a kill: more than the time to live of a command."""
STEPS: Final = (20, 49)
"""A goal of so many steps: each differs from those before and after it."""
WHOLE_WITHIN_S: Final = 120.0
KINDS: Final = (signal.SIGKILL, signal.SIGSTOP)
"""An agent that is stopped is killed once its robot stands: it is as silent, and its end of the pipe stays open."""

CONFIG: Final = """
fleet = "goals"
{peers}
[service.log]
settings = {{ level = "warning" }}
[device.nav]
driver = "ros2.action"
settings = {{ action = "{action}", name = "go" }}
"""
TASK: Final = """
[task.Errand]
type = "goals.Errand"
guard = {{ copies = 3, lease_s = {lease_s}, checkpoint_s = {checkpoint_s} }}
settings = {{ endless = true, goals = [{goals}] }}
"""


@dataclass
class GoalTally:
    """What came of the kills.

    Attributes:
        kills: how many of each kind.
        stood_s: from the kill to the end of the goal on the robot that was left.
        began_s: from the kill to its beginning on the next robot.
        late_s: from the kill to its success there, less its way: the steps that it takes.
        drove_on: kills after which the first robot did not stand in time.
        wrong: other promises that were broken, a sentence each.
        two_drove: kills after which two robots drove at once.
        before: kills after which the goal before was reached once more, because it was newer than the checkpoint.
    """

    kills: Counter[str] = field(default_factory=Counter)
    stood_s: list[float] = field(default_factory=list)
    began_s: list[float] = field(default_factory=list)
    late_s: list[float] = field(default_factory=list)
    drove_on: list[str] = field(default_factory=list)
    two_drove: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    before: int = 0

    @property
    def failures(self) -> list[str]:
        """Everything that may not be."""
        return [*self.drove_on, *self.two_drove, *self.wrong]

    def figures(self) -> dict[str, Any]:
        """Return the figures as plain values."""
        return {
            "kills": dict(self.kills),
            "drove_on": len(self.drove_on),
            "two_drove": len(self.two_drove),
            "wrong": len(self.wrong),
            "goal_before_again": self.before,
            "stood_s": spread(self.stood_s),
            "began_s": spread(self.began_s),
            "reached_after_way_s": spread(self.late_s),
        }


class GoalFleet:
    """Four agents, four robots, one task.

    Args:
        directory: the folder for all files.
        domain: the DDS domain of all processes.
        seed: of the moments of the kills.
    """

    def __init__(self, directory: Path, domain: int, seed: int) -> None:
        self._directory, self._domain = directory, domain
        self._random = random.Random(f"goals/{seed}")
        self.tally = GoalTally()
        self._robots = RosPeer(domain, "robots")
        self._agents: dict[str, RosAgent] = {}
        self._life = 0
        for name in NAMES:
            self._robots.order("serve", action=f"/{name}/go", type=ACTION, step_s=STEP_S)
            self._robots.told.wait(lambda line: "serves" in line)
        goals = ", ".join(f"'{{\"order\": {steps}}}'" for steps in range(STEPS[0], STEPS[1] + 1))
        self._start("a", TASK.format(lease_s=LEASE_S, checkpoint_s=CHECKPOINT_S, goals=goals))
        for name in NAMES[1:]:
            self._start(name)

    def run(self, kills: int, done: Callable[[GoalTally], None]) -> GoalTally:
        """Kill the owner of the task so often."""
        for number in range(kills):
            self._wait_until_whole()
            self._kill(KINDS[number % 5 == 4])
            done(self.tally)
            if len(self.tally.failures) > 10:
                break
        return self.tally

    def close(self) -> None:
        """End all processes."""
        for agent in self._agents.values():
            agent.process.kill()
            agent.process.wait()
        self._robots.close()

    def _start(self, name: str, task: str = "") -> None:
        peers = ", ".join(f'"local://{other}"' for other in NAMES if other != name)
        self._life += 1
        text = CONFIG.format(peers=f"peers = [{peers}]", action=ACTION) + task
        self._agents[name] = RosAgent(self._directory / name, self._domain, name, text)

    def _wait_until_whole(self) -> None:
        """Wait until three agents guard the task and all four are linked, so that one may be lost."""
        until_s = time.monotonic() + WHOLE_WITHIN_S
        while not self._is_whole():
            if time.monotonic() > until_s:
                raise AssertionError(f"the task is not guarded by three agents within {WHOLE_WITHIN_S} s")

    def _is_whole(self) -> bool:
        rows: list[dict[str, Any]] = []
        try:
            with Client() as client:
                for name in NAMES:
                    rows += client.request(name, Guarding()).result
        except PancakesError:
            return False
        owner = next((row for row in rows if "guardians" in row and row["lease"] and row["permit_s"]), None)
        if owner is None:
            return False
        held = {row["agent"] for row in rows if row["lease"] and row["epoch"] == owner["epoch"]}
        return len(owner["guardians"]) == 3 and set(owner["guardians"]) <= held

    # A kill ------------------------------------------------------------------------------------------------------

    def _hear(self, what: str, within_s: float) -> dict[str, Any]:
        """Return the next time that a goal begins or ends."""
        return self._robots.told.wait(lambda line: what in line or (what == "either" and _is_act(line)), within_s)

    def _kill(self, how: signal.Signals) -> None:
        tally = self.tally
        self._robots.told.forget()
        goal = self._hear("begins", 60.0)
        steps, name = goal["steps"], goal["begins"].split("/")[1]
        story = f"kill {tally.kills.total() + 1} ({how.name}) of {name} at a goal of {steps} steps"
        time.sleep(self._random.uniform(0.0, steps * STEP_S - LEFT_S))
        agent = self._agents[name]
        agent.process.send_signal(how)
        killed_s = time.monotonic()
        tally.kills[how.name] += 1
        ended = self._end_of(goal, killed_s, story)
        if how == signal.SIGSTOP:
            agent.process.send_signal(signal.SIGKILL)
        agent.process.wait()
        if ended["state"] == "succeeded":
            tally.wrong.append(f"{story}: the robot drove on to its goal")
        self._follow(goal, ended, killed_s, story)
        self._start(name)

    def _end_of(self, goal: dict[str, Any], killed_s: float, story: str) -> dict[str, Any]:
        ended = self._robots.told.wait(lambda line: line.get("id") == goal["id"] and "ends" in line, 30.0)
        stood_s = ended["at_s"] - killed_s
        self.tally.stood_s.append(stood_s)
        if stood_s > STOPS_WITHIN_S:
            self.tally.drove_on.append(f"{story}: its robot stood after {stood_s:.2f} s")
        return ended

    def _follow(self, goal: dict[str, Any], ended: dict[str, Any], killed_s: float, story: str) -> None:
        """Judge what another robot does with the goal."""
        tally = self.tally
        began = self._hear("begins", 60.0)
        began_s = began["at_s"] - killed_s
        if began["steps"] != goal["steps"] and killed_s - goal["at_s"] < CHECKPOINT_S + LATE_S:
            # No guardian knew that the goal before had been reached.
            tally.before += 1
            killed_s += self._hear("ends", 60.0)["at_s"] - began["at_s"]
            began = self._hear("begins", 60.0)
        tally.began_s.append(began_s)
        if began["at_s"] < ended["at_s"] or began["at_work"]:
            tally.two_drove.append(f"{story}: the next robot began before the first one stood")
        if began["begins"] == goal["begins"]:
            tally.wrong.append(f"{story}: its own robot goes on")
        if began["steps"] != goal["steps"]:
            tally.wrong.append(f"{story}: the goal after it was of {began['steps']} steps")
        if began_s > BEGINS_WITHIN_S:
            tally.wrong.append(f"{story}: the next robot began after {began_s:.2f} s")
        last = self._hear("either", 60.0)
        if last.get("id") != began["id"] or last.get("state") != "succeeded":
            tally.wrong.append(f"{story}: the next robot did not reach it: {last}")
        else:
            tally.late_s.append(last["at_s"] - killed_s - goal["steps"] * STEP_S)


def _is_act(line: dict[str, Any]) -> bool:
    return "begins" in line or "ends" in line


def kill_agents(kills: int, domain: int, seed: int, done: Callable[[GoalTally], None]) -> GoalTally:
    """Run a fleet, and kill the owner of its task so often."""
    with tempfile.TemporaryDirectory(prefix="pancakes-goals-") as directory:
        fleet = GoalFleet(Path(directory), domain, seed)
        try:
            return fleet.run(kills, done)
        finally:
            fleet.close()
