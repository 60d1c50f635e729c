"""A program: robots that exist only as nodes of ROS 2, in a small world of their own (`ros2.arena` starts it).

It runs with any release of ROS 2, and is no agent. Its first line of input says what the world has, the next when the
mission begins; where the input ends, it does. Its output are lines with the truth about the world, for a referee.
"""

from __future__ import annotations

import queue
import random
import sys
import threading
from typing import IO, Any, Final

import msgspec

from pancakes.settings import make_settings
from pancakes.sim.bodies import ContentSettings
from pancakes.sim.robot_models import robot_model
from pancakes.sim.world import STEP_S, Physics
from pancakes.util import codecs
from pancakes.util.clock import MonotonicClock
from pancakes_ros2.arena_clock import Beginning
from pancakes_ros2.simulated_robot import SimulatedRobot

AHEAD_S: Final = 0.02
"""It looks at its input at least that often, in seconds of the machine."""


class Contents(msgspec.Struct, frozen=True):
    """The first line of input.

    Attributes:
        world: the contents of the world, as plain values.
        seed: all that is drawn is drawn from this.
        state_hz: how often the truth is told.
    """

    world: dict[str, Any]
    seed: int
    state_hz: float


class TruthLine(msgspec.Struct, frozen=True):
    """A line of output: one of these.

    Attributes:
        ready: the nodes are there.
        state: a `WorldState`, as plain values.
        incident: an `Incident`, as plain values.
    """

    ready: bool = False
    state: Any = None
    incident: Any = None


def main() -> None:
    """Runs until the input ends."""
    lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(sys.stdin.buffer, lines), daemon=True).start()
    first = lines.get()
    if first is None:
        return
    contents = codecs.json_decoder(Contents)(first)
    settings = make_settings(ContentSettings, contents.world, owner="the arena")
    _serve(settings, Physics(settings, random.Random(contents.seed)), contents.state_hz, lines)


def _read(stream: IO[bytes], lines: queue.SimpleQueue[bytes | None]) -> None:
    for line in stream:
        lines.put(line)
    lines.put(None)


def _say(line: TruthLine) -> None:
    sys.stdout.buffer.write(codecs.json_encoder()(line) + b"\n")
    sys.stdout.buffer.flush()


def _serve(
    settings: ContentSettings, physics: Physics, state_hz: float, lines: queue.SimpleQueue[bytes | None]
) -> None:
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node

    rclpy.init(args=[])
    executor = SingleThreadedExecutor()
    robots = []
    for name in (*settings.robots, *settings.sensors):
        node = Node("base", namespace=f"/{name}")
        executor.add_node(node)
        robot = settings.robots.get(name)
        if robot is None:
            robots.append(SimulatedRobot(node, name, physics, None, ("motion",)))
            continue
        model = robot_model(robot.model)
        rings = (*("ir",) * (model.ir is not None), *("sonar",) * (model.sonar is not None))
        robots.append(SimulatedRobot(node, name, physics, model.drive, ("battery", *rings)))
    host = MonotonicClock().now
    steps, state_step = round(1.0 / (state_hz * STEP_S)), 0
    beginning: Beginning | None = None
    _say(TruthLine(ready=True))
    while True:
        while not lines.empty():
            line = lines.get()
            if line is None:
                rclpy.try_shutdown()
                return
            beginning = codecs.json_decoder(Beginning)(line)
        wait_s = AHEAD_S
        if beginning is not None:
            now_s = beginning.mission_at(host())
            while state_step * STEP_S <= now_s:
                physics.advance(state_step * STEP_S)
                _say(TruthLine(state=physics.state()))
                state_step += steps
            physics.advance(now_s)
            for incident in physics.take_incidents():
                _say(TruthLine(incident=incident))
            for each in robots:
                each.publish(now_s)
            due_s = min(state_step * STEP_S, *(each.next_s() for each in robots))
            wait_s = min(AHEAD_S, max(0.0, (due_s - now_s) / beginning.speed))
        executor.spin_once(timeout_sec=wait_s)


if __name__ == "__main__":
    main()
