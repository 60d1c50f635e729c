"""The gap in control: for how long an actuator hears nothing while the task that commands it moves to another agent."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from torture.cuts import wait_for_link
from torture.live import LiveFleet, free_ports
from torture.proxy import Proxy

from pancakes.cli.client import Client
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
    """

    state_bytes: int
    gaps_s: Sequence[float]
    refused: Sequence[str]

    def percentile_s(self, percent: float) -> float:
        """Returns the gap that so many of a hundred moves do not exceed."""
        return self.gaps_s[min(len(self.gaps_s) - 1, int(len(self.gaps_s) * percent / 100))]


def measure(state_bytes: int, moves: int, delay_s: float = 0.0, loss: float = 0.0) -> Gaps:
    """Moves a task that drives a hundred times a second to and fro between two real agents.

    Args:
        state_bytes: how much state it carries.
        moves: how often it moves.
        delay_s: how much later everything arrives, each way; 0: loopback as it is.
        loss: the share of frames that are lost on the way and sent again.
    """
    with tempfile.TemporaryDirectory(prefix="pancakes-gap-") as name:
        directory = Path(name)
        listen = {agent: f"tcp://127.0.0.1:{port}" for agent, port in zip(NAMES, free_ports(2), strict=True)}
        # TCP sees a loss by the acknowledgements that are missing, two round trips later where nothing follows.
        proxy = Proxy(listen["right"], delay_s, loss, again_s=4 * delay_s) if delay_s or loss else None
        way = proxy.address if proxy is not None else listen["right"]
        rest = {
            agent: f'[device.motors]\ndriver = "torture.recorder"\n'
            f'settings = {{file = "{directory / agent}.commands"}}\n'
            '[service.log]\nsettings = {level = "info"}\n'
            for agent in NAMES
        }
        rest["left"] += f'[task.Pilot]\ntype = "torture.Pilot"\nsettings = {{state_bytes = {state_bytes}}}\n'
        fleet = LiveFleet(directory, NAMES, rest, listen, {"left": [way], "right": []})
        try:
            for agent in NAMES:
                fleet.start(agent, wait=True)
            refused = _move(fleet, moves)
        finally:
            fleet.close()
            if proxy is not None:
                proxy.close()
        return Gaps(state_bytes, _gaps(directory), refused)


def _move(fleet: LiveFleet, moves: int) -> list[str]:
    refused = []
    with Client(at=list(fleet.addresses.values()), timeout_s=20.0) as client:
        wait_for_link(client, *NAMES)
        time.sleep(1.0)
        at, to = NAMES
        for number in range(moves):
            reply = client.request(at, Migrate("client/Pilot", to=to))
            if reply.ok:
                at, to = to, at
            else:
                refused.append(reply.reason)
            time.sleep(0.2 + 0.013 * (number % 7))  # at another phase of the ticks and checkpoints each time
    return refused


def _gaps(directory: Path) -> list[float]:
    heard = []
    for agent in NAMES:
        for line in (directory / f"{agent}.commands").read_text().splitlines():
            heard.append((int(line.split()[0]) / 1e9, agent))
    heard.sort()
    return sorted(now - before for (before, one), (now, other) in zip(heard, heard[1:], strict=False) if one != other)
