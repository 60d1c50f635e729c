"""The devices of many robots, in one process: they ask and command a simulated world as the robots' agents do.

Each robot has a connection of its own to the hardware bus, as its agent would have. It asks its infrared ring ten times
a second and gives its wheels a new command as often, half a period later; the robots are spread over the period.
"""

from __future__ import annotations

import json
import os
import selectors
import socket
import sys
import time

from pancakes.sim.hardware_bus import Attach, Drive, RawReading, ReplyReader, Sample, encode

RATE_HZ = 10.0
GOOD_FOR_S = 0.5
SETTLE_S = 2.0
SPEED_MPS = 0.1
TURN_MPS = 0.012
"""How much faster one wheel runs than the other: the robots go in circles."""


class Robot:
    """One robot's connection."""

    def __init__(self, number: int, place: tuple[str, int]) -> None:
        name = f"robot{number}"
        self.socket = socket.create_connection(place)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.reader = ReplyReader()
        self.asked_s = 0.0
        self.ask = encode(Sample(name, "ir", "ir"))
        self.command = encode(Drive(name, "motors", *wheels_mps(number), GOOD_FOR_S, f"{name}/client/Roam"))
        self.socket.sendall(encode(Attach(name, "ir", "ir")) + encode(Attach(name, "motors", "motors", "khepera3")))


def wheels_mps(number: int) -> tuple[float, float]:
    """Returns how fast a robot's wheels run, the left one and the right one."""
    turn_mps = TURN_MPS if number % 2 else -TURN_MPS
    return SPEED_MPS - turn_mps, SPEED_MPS + turn_mps


def run(place: tuple[str, int], count: int, duration_s: float, ready_fd: int) -> None:
    """Says when the world's processor time is to be looked at, by a line of JSON each; the second has the figures."""
    robots = [Robot(number, place) for number in range(count)]
    selector = selectors.DefaultSelector()
    for robot in robots:
        selector.register(robot.socket, selectors.EVENT_READ, robot)
    period_s = 1.0 / RATE_HZ
    actions = [(number * period_s / count, robot, "ask") for number, robot in enumerate(robots)]
    actions += [((number / count + 0.5) % 1.0 * period_s, robot, "command") for number, robot in enumerate(robots)]
    actions.sort(key=lambda action: action[0])
    start_s = time.monotonic() + 0.1
    measure_s, end_s = start_s + SETTLE_S, start_s + SETTLE_S + duration_s
    late_s: list[float] = []
    asked, measuring, turn, index = 0, False, 0, 0
    while True:
        now_s = time.monotonic()
        if now_s >= measure_s and not measuring:
            measuring, asked, late_s = True, 0, []
            os.write(ready_fd, b"{}\n")
        if now_s >= end_s:
            break
        while (due_s := start_s + turn * period_s + actions[index][0]) <= now_s:
            _, robot, what = actions[index]
            if what == "ask":
                robot.asked_s = due_s
                asked += 1
            robot.socket.sendall(robot.ask if what == "ask" else robot.command)
            index += 1
            if index == len(actions):
                turn, index = turn + 1, 0
        for key, _ in selector.select(max(0.0, due_s - time.monotonic())):
            robot = key.data
            for reply in robot.reader.feed(robot.socket.recv(65_536)):
                if isinstance(reply, RawReading):
                    late_s.append(time.monotonic() - robot.asked_s)
    late_s.sort()
    report = {"asked": asked, "answered": len(late_s), "p50_ms": 0.0, "p99_ms": 0.0}
    if late_s:
        report.update(p50_ms=late_s[len(late_s) // 2] * 1e3, p99_ms=late_s[int(len(late_s) * 0.99)] * 1e3)
    os.write(ready_fd, json.dumps(report).encode() + b"\n")


if __name__ == "__main__":
    run((sys.argv[1], int(sys.argv[2])), int(sys.argv[3]), float(sys.argv[4]), int(sys.argv[5]))
    sys.stdin.read()
