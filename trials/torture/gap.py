"""Measure the gap in control: how long an actuator gets no command while its task migrates to another agent."""

from __future__ import annotations

import math
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from torture.cuts import wait_for_both
from torture.grounds import Survey, on_loopback

from pancakes.client import Client, Target
from pancakes.control import Migrate

NAMES = ("left", "right")
PERIOD_S = 0.01
"""The period of the task: the gap between its commands without a migration."""


class Gaps(NamedTuple):
    """The commands that the actuators of two agents got.

    Attributes:
        state_bytes: how much state the task carried.
        gaps_s: the time from the last command of one agent to the first of the other, for each migration, ascending.
        refused: a sentence for each migration that failed.
        pauses_s: the longest time without a command in each failed one: the task was paused, and resumed at home.
    """

    state_bytes: int
    gaps_s: Sequence[float]
    refused: Sequence[str]
    pauses_s: Sequence[float]

    def percentile_s(self, percent: float) -> float:
        """Return a percentile of the gaps."""
        return self.gaps_s[math.ceil(len(self.gaps_s) * percent / 100) - 1]


def measure(state_bytes: int, moves: int, survey: Survey = on_loopback, move_s: float = 20.0) -> Gaps:
    """Migrate a task that drives a hundred times a second to and fro between two real agents.

    Args:
        state_bytes: how much state it carries.
        moves: how often it migrates.
        survey: makes the network of the agents.
        move_s: how long a migration may take before it is given up.
    """
    ground = survey(NAMES)
    with tempfile.TemporaryDirectory(prefix="pancakes-gap-") as name:
        directory = Path(name)
        fleet = ground.fleet(directory, pilot_on_left(directory, state_bytes))
        try:
            for agent in NAMES:
                fleet.start(agent, wait=True)
            with Client(Target(tuple(fleet.addresses.values()), "torture"), move_s) as client:
                wait_for_both(client, *NAMES)
                attempts = move_to_and_fro(client, moves)
        finally:
            fleet.close()
            ground.close()
        heard = commands_heard(directory)
        refused = [attempt for attempt in attempts if attempt.refused]
        return Gaps(
            state_bytes, gaps_in(heard), [it.refused for it in refused], [_longest_pause(heard, it) for it in refused]
        )


class Attempt(NamedTuple):
    """One migration: when it was requested and answered, on the machine's clock, and why it was refused, if it was."""

    asked_s: float
    answered_s: float
    refused: str


def pilot_on_left(directory: Path, state_bytes: int, guard: str = "") -> dict[str, str]:
    """Return the part after `[agent]` of both configurations; `guard`: how the task is guarded."""
    rest = {
        agent: f'[device.motors]\ndriver = "torture.recorder"\n'
        f'settings = {{file = "{directory / agent}.commands"}}\n'
        '[service.log]\nsettings = {level = "info"}\n'
        for agent in NAMES
    }
    rest["left"] += f'[task.Pilot]\ntype = "torture.Pilot"\nsettings = {{state_bytes = {state_bytes}}}\n{guard}'
    return rest


def move_to_and_fro(client: Client, moves: int) -> list[Attempt]:
    """Migrate the task from left to right and back, `moves` times in all."""
    attempts = []
    never = threading.Event()
    at, to = NAMES
    for number in range(moves):
        asked_s = time.monotonic()
        reply = client.request(at, Migrate("client/Pilot", to=to))
        if reply.ok:
            at, to = to, at
        attempts.append(Attempt(asked_s, time.monotonic(), "" if reply.ok else reply.reason))
        # Let it drive for a while, so that each migration begins at another phase of its ticks and checkpoints.
        never.wait(0.2 + 0.013 * (number % 7))
    return attempts


def commands_heard(directory: Path) -> list[tuple[float, str]]:
    """Return the time of each command, on the machine's clock, and the agent of its actuator."""
    heard = []
    for agent in NAMES:
        for line in (directory / f"{agent}.commands").read_text().splitlines():
            heard.append((int(line.split()[0]) / 1e9, agent))
    return sorted(heard)


def gaps_in(heard: Sequence[tuple[float, str]]) -> list[float]:
    """Return the times between the last command of one agent and the first of the other, ascending."""
    return sorted(now - before for (before, one), (now, other) in zip(heard, heard[1:], strict=False) if one != other)


def _longest_pause(heard: Sequence[tuple[float, str]], attempt: Attempt) -> float:
    """Return the longest time between two commands during an attempt; the task resumes just before the answer."""
    return max(
        (
            now_s - before_s
            for (before_s, _), (now_s, _) in zip(heard, heard[1:], strict=False)
            if now_s > attempt.asked_s and before_s < attempt.answered_s
        ),
        default=0.0,
    )
