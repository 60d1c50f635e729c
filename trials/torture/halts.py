"""Halt a fleet of real agents whose links lose packets: how long after that do actuators still get commands?

The agents run in network namespaces. A driver logs each command on the clock that all processes of a machine share, so
everything is judged from outside.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from torture.live import LiveFleet
from torture.namespaces import Namespaces

from pancakes.client import Client, Target
from pancakes.control import Describe, EndHalt, Halt
from pancakes.errors import PancakesError

NAMES = ("r1", "r2", "r3", "r4")
PORT = 7401
PATIENCE_S = 30.0
DRIVES_S = 0.5
"""How long the actuators run between two halts."""
STANDS_S = 1.0
"""How long they are watched after a halt."""


@dataclass(frozen=True)
class Halting:
    """One halt.

    Attributes:
        to: the agents that were asked; the others hear of it from them.
        stood_s: from the request to the last command of each actuator.
        moved_after: the actuators that got a command later than `STANDS_S`, or none before the halt.
    """

    to: Sequence[str]
    stood_s: Sequence[float]
    moved_after: Sequence[str]


def halt_often(spaces: Namespaces, rounds: int, loss: float, delay_s: float) -> list[Halting]:
    """Halt a fleet again and again, in turns by asking all of its agents, and only one.

    Args:
        spaces: makes the namespaces.
        rounds: how often.
        loss: the share of IP packets that is lost, each way, between all agents; the person who asks has a good link.
        delay_s: how much later each IP packet arrives.
    """
    home = spaces.places[0]
    places = {name: spaces.add() for name in NAMES}
    for one, other in combinations([home, *places.values()], 2):
        link = spaces.link(one, other)
        link.loss, link.delay_s = 0.0 if one is home else loss, delay_s
    addresses = {name: f"tcp://{place.host}:{PORT}" for name, place in places.items()}
    commands = {name: place.command for name, place in places.items()}
    with tempfile.TemporaryDirectory(prefix="pancakes-halts-") as folder:
        directory = Path(folder)
        rest = {
            name: f'[device.motors]\ndriver = "torture.recorder"\nsettings = {{file = "{directory / name}.commands"}}\n'
            '[task.Pilot]\ntype = "torture.Pilot"\nsettings = {state_bytes = 16}\n'
            for name in NAMES
        }
        fleet = LiveFleet(directory, NAMES, rest, addresses, None, commands)
        try:
            for name in NAMES:
                fleet.start(name, wait=True)
            with Client(Target(tuple(addresses.values()), "torture"), PATIENCE_S) as client:
                _meet(client)
                return [_halt(client, directory, number) for number in range(rounds)]
        finally:
            fleet.close()


def _halt(client: Client, directory: Path, number: int) -> Halting:
    never = threading.Event()
    never.wait(DRIVES_S)
    to = NAMES if number % 2 == 0 else (NAMES[number // 2 % len(NAMES)],)
    asked_s = time.monotonic()
    # On such links an answer may be late, or its link end: what counts is when the actuators stand.
    with suppress(PancakesError):
        client.request_all(Halt(f"halt {number}"), *to, timeout_s=STANDS_S)
    never.wait(max(0.0, asked_s + STANDS_S - time.monotonic()))
    heard = {name: _commands(directory, name) for name in NAMES}
    never.wait(0.3)
    later = [name for name in NAMES if len(_commands(directory, name)) > len(heard[name])]
    idle = [name for name in NAMES if not any(asked_s - DRIVES_S < it < asked_s for it in heard[name])]
    stood_s = [max(0.0, max(heard[name], default=asked_s) - asked_s) for name in NAMES]
    later.extend(f"{name}, whose halt could not be ended" for name in NAMES if not _end(client, name))
    _meet(client)
    return Halting(to, stood_s, [*later, *idle])


def _end(client: Client, name: str) -> bool:
    """End the halt of an agent, however often its link ends meanwhile; return whether it is ended."""
    until_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        with suppress(PancakesError):
            reply = client.request(name, EndHalt(), timeout_s=3.0)
            if reply.ok or "is not halted" in reply.reason:
                return True
    return False


def _commands(directory: Path, name: str) -> list[float]:
    lines = (directory / f"{name}.commands").read_text().splitlines()
    return [int(line.split()[0]) / 1e9 for line in lines]


def _meet(client: Client) -> None:
    """Wait until all agents have links to all others, and drive."""
    until_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        try:
            found = [client.request(name, Describe()).result for name in NAMES]
        except PancakesError:  # one is only just starting
            continue
        driving = [any(it["task"] == "Pilot" and it["state"] == "running" for it in row["tasks"]) for row in found]
        if all(driving) and all(len(row["neighbours"]) == len(NAMES) - 1 for row in found):
            return
        threading.Event().wait(0.1)
    raise TimeoutError(f"the agents did not find each other within {PATIENCE_S:g} s, or do not drive")
