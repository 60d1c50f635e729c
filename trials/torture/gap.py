"""The gap in control: for how long an actuator hears nothing while the task that commands it moves to another agent."""

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

from pancakes.client import Client, Where
from pancakes.control import Migrate

NAMES = ("left", "right")
PERIOD_S = 0.01
"""The task's own: without any move its commands are so far apart."""


class Gaps(NamedTuple):
    """What the actuators of two agents heard.

    Attributes:
        state_bytes: how much state the task carried.
        gaps_s: between the last command from one agent and the first from the other, for each move, ascending.
        refused: a sentence for each move that came to nothing.
        pauses_s: the longest time without a command in each of those: its task stood still, and went on where it was.
    """

    state_bytes: int
    gaps_s: Sequence[float]
    refused: Sequence[str]
    pauses_s: Sequence[float]

    def percentile_s(self, percent: float) -> float:
        """Returns the gap that so many of a hundred moves do not exceed."""
        return self.gaps_s[math.ceil(len(self.gaps_s) * percent / 100) - 1]


def measure(state_bytes: int, moves: int, survey: Survey = on_loopback, move_s: float = 20.0) -> Gaps:
    """Moves a task that drives a hundred times a second to and fro between two real agents.

    Args:
        state_bytes: how much state it carries.
        moves: how often it moves.
        survey: makes the ground that the agents stand on.
        move_s: how long a move may take before nobody waits for it any longer.
    """
    ground = survey(NAMES)
    with tempfile.TemporaryDirectory(prefix="pancakes-gap-") as name:
        directory = Path(name)
        fleet = ground.fleet(directory, pilot_on_left(directory, state_bytes))
        try:
            for agent in NAMES:
                fleet.start(agent, wait=True)
            with Client(Where(tuple(fleet.addresses.values()), "torture"), move_s) as client:
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
    """One move: when it was asked for and answered, on the machine's clock, and why it was refused, if it was."""

    asked_s: float
    answered_s: float
    refused: str


def pilot_on_left(directory: Path, state_bytes: int, guard: str = "") -> dict[str, str]:
    """Returns what follows `[agent]` in the configurations of both; `guard`: how the task is guarded."""
    rest = {
        agent: f'[device.motors]\ndriver = "torture.recorder"\n'
        f'settings = {{file = "{directory / agent}.commands"}}\n'
        '[service.log]\nsettings = {level = "info"}\n'
        for agent in NAMES
    }
    rest["left"] += f'[task.Pilot]\ntype = "torture.Pilot"\nsettings = {{state_bytes = {state_bytes}}}\n{guard}'
    return rest


def move_to_and_fro(client: Client, moves: int) -> list[Attempt]:
    """Moves the task from left to right, and back, so often."""
    attempts = []
    never = threading.Event()
    at, to = NAMES
    for number in range(moves):
        asked_s = time.monotonic()
        reply = client.request(at, Migrate("client/Pilot", to=to))
        if reply.ok:
            at, to = to, at
        attempts.append(Attempt(asked_s, time.monotonic(), "" if reply.ok else reply.reason))
        # It is to drive for a while, so that each move finds its ticks and checkpoints at another phase.
        never.wait(0.2 + 0.013 * (number % 7))
    return attempts


def commands_heard(directory: Path) -> list[tuple[float, str]]:
    """Returns when each actuator was commanded, on the machine's clock, and whose it is."""
    heard = []
    for agent in NAMES:
        for line in (directory / f"{agent}.commands").read_text().splitlines():
            heard.append((int(line.split()[0]) / 1e9, agent))
    return sorted(heard)


def gaps_in(heard: Sequence[tuple[float, str]]) -> list[float]:
    """Returns the times between the last command of one agent and the first of the other, ascending."""
    return sorted(now - before for (before, one), (now, other) in zip(heard, heard[1:], strict=False) if one != other)


def _longest_pause(heard: Sequence[tuple[float, str]], attempt: Attempt) -> float:
    """Returns the longest time between two commands during an attempt; it goes on just before it is answered."""
    return max(
        (
            now_s - before_s
            for (before_s, _), (now_s, _) in zip(heard, heard[1:], strict=False)
            if now_s > attempt.asked_s and before_s < attempt.answered_s
        ),
        default=0.0,
    )
