"""Measure a publisher that is ten times too fast: memory, effect on control and ticks, and recovery."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NamedTuple

from torture.load_fleet import PATIENCE_S, LoadedFleet, Tasks

from pancakes.client import Client, Target
from pancakes.control import Describe

TIMES: Final = 10
"""The factor by which the publisher is too fast."""
MEMORY_BYTES: Final = 64 * 1024 * 1024
"""How much memory an agent may use above its baseline."""
LATE_S: Final = 0.05
"""How late 99 of 100 ticks, or replies to control packets, may be; the latest one depends on the machine."""
BEHIND_S: Final = 5.0
"""How long a reader may take to catch up at half of the bearable rate: 512 packets may wait, and the link's."""
JUST_COME: Final = 300
"""If fewer packets are between publisher and reader, none of them has waited since the overload."""
LAST_PER_S: Final = 40
"""The rate of packets at the end, per second."""


class Case(NamedTuple):
    """One case.

    Attributes:
        where: `inside` one agent, `over TCP` from agent to agent, on a channel of the user's; or `over TCP, on system`.
        size: the size of a body, in bytes.
        bearable_per_s: how many packets per second the reader can handle, given its work on each.
        keep: `queue`, or `reliable`.
    """

    where: str
    size: int
    bearable_per_s: float
    keep: str = "queue"

    @property
    def name(self) -> str:
        """The name of the case, for people."""
        size = f"{self.size} B" if self.size < 1024 else f"{self.size // 1024} KiB"
        return f"{self.where}, {size}, {self.keep}"

    @property
    def reader(self) -> str:
        """The name of the reading task."""
        if self.where.endswith("system"):
            return "SystemReader"
        return "ReliableReader" if self.keep == "reliable" else "QueueReader"


class Seen(NamedTuple):
    """The figures of one case.

    Attributes:
        memory_bytes: the most memory that any agent used above its baseline.
        control_s: how long replies took: to the client from each agent, and from agent to agent across the link.
        late_s: how late ticks were, of a task at 100 Hz on each agent.
        published, handled: packets.
        dropped: packets dropped at the subscription and per (peer, channel), by where an operator reads them.
        refused: how often `publish` was refused.
        disordered, doubled: packets that came before one, or as one, that had come.
        behind_s: how long it took to catch up once the publisher had slowed down.
    """

    memory_bytes: int
    control_s: list[float]
    late_s: list[float]
    published: int
    handled: int
    dropped: dict[str, int]
    refused: int
    disordered: int
    doubled: int
    behind_s: float

    def faults(self) -> list[str]:
        """Return a sentence for each fault."""
        found: list[str] = []
        if self.memory_bytes > MEMORY_BYTES:
            found.append(f"took {self.memory_bytes / 2**20:.0f} MiB above the baseline")
        found += [
            f"{what}: p99 {late_s * 1e3:.0f} ms"
            for what, late_s in (("replies", p99(self.control_s)), ("ticks", p99(self.late_s)))
            if late_s > LATE_S
        ]
        lost = self.published - self.handled
        if lost > sum(self.dropped.values()):
            found.append(f"{lost} packets are missing, and {sum(self.dropped.values())} are said to be dropped")
        if not lost and not self.refused:
            found.append("nothing was dropped or refused: that was no overload")
        if self.disordered or self.doubled:
            found.append(f"{self.disordered} packets out of order, {self.doubled} doubled")
        if self.behind_s > BEHIND_S:
            found.append(f"was behind for {self.behind_s:.1f} s afterwards")
        return found


def p99(values: Sequence[float]) -> float:
    """Return the 99th percentile."""
    return sorted(values)[int(len(values) * 0.99)]


def overload(directory: Path, case: Case, for_s: float, calm: float = 0.5) -> Seen:
    """Run one case with agents of its own.

    Args:
        directory: the folder for all files.
        case: the case.
        for_s: the least time that the publisher is too fast, in seconds.
        calm: the share of the bearable rate at which it publishes afterwards, while the reader catches up.
    """
    inside = case.where == "inside"
    flood = {"size": case.size, "channel": "system" if case.where.endswith("system") else "load"}
    reader: Tasks = {case.reader: {"work_s": 1 / case.bearable_per_s}, "Pulse": {}}
    tasks: dict[str, Tasks]
    if inside:
        tasks = {"a": {"Flood": flood, **reader}}
    else:
        tasks = {"a": {"Flood": {**flood, "to": "b"}, "Asker": {"to": "b"}, "Pulse": {}}, "b": reader}
    reading = "a" if inside else "b"
    with LoadedFleet(directory, tasks) as fleet:
        if not inside:
            fleet.wait(lambda: fleet.told("a", "Asker"), "the link")
        # The agents are warm, and have handled everything, before the baseline is measured.
        fleet.configure("a", "Flood", per_s=case.bearable_per_s / 2)
        fleet.wait(
            lambda: fleet.last(reading, case.reader).get("handled", 0) > case.bearable_per_s / 2, "first packets"
        )
        baseline = {name: fleet.memory_bytes(name) for name in tasks}
        with watching(fleet, list(tasks)) as (control_s, memory):
            began_s = time.monotonic()
            fleet.configure("a", "Flood", per_s=case.bearable_per_s * TIMES)
            fleet.client.wait(lambda: False, for_s)
            # On a busy machine the publisher is slow as well, so it continues until it was too fast.
            while not _shows(fleet, reading, case) and time.monotonic() < began_s + for_s + PATIENCE_S:
                fleet.client.wait(lambda: False, 0.1)
            ended_s = time.monotonic()
        fleet.configure("a", "Flood", per_s=case.bearable_per_s * calm)
        behind_s = fleet.wait(lambda: _behind(fleet, reading, case.reader) < JUST_COME, "catching up")
        # The last packets are sent one by one: a reader that waits for a core may have no room for more.
        fleet.configure("a", "Flood", per_s=LAST_PER_S)
        fleet.wait(lambda: _behind(fleet, reading, case.reader) < LAST_PER_S / 2, "only a few to wait")
        fleet.configure("a", "Flood", per_s=0.0)
        fleet.wait(lambda: not _behind(fleet, reading, case.reader), "the last packet")
        late_s = [
            late_s
            for name in tasks
            for row in fleet.told(name, "Pulse", began_s)
            if row["at_s"] <= ended_s
            for late_s in row["late_s"]
        ]
        if not inside:
            asked = [row for row in fleet.told("a", "Asker", began_s) if row.get("asked_s", ended_s) < ended_s]
            control_s += [row["took_s"] for row in asked]
        published, read = fleet.last("a", "Flood"), fleet.last(reading, case.reader)
        return Seen(
            max(max(taken) - baseline[name] for name, taken in memory.items()),
            control_s,
            late_s,
            published["published"] - published["too_large"],
            read["handled"],
            _dropped(fleet, reading, case.reader),
            published["refused"],
            read["disordered"],
            read["doubled"],
            behind_s,
        )


@contextmanager
def watching(fleet: LoadedFleet, agents: list[str]) -> Iterator[tuple[list[float], dict[str, list[int]]]]:
    """Ask the agents for something, as a second client, and look at their memory, until the end of the block.

    Yields:
        How long the replies took, in seconds; the memory of each agent, in bytes. Complete after the block.
    """
    control_s: list[float] = []
    memory: dict[str, list[int]] = {name: [fleet.memory_bytes(name)] for name in agents}
    over = threading.Event()

    def watch() -> None:
        with Client(Target(tuple(fleet.addresses.values()), "load")) as client:
            for name in agents:
                client.request(name, Describe("client/Pulse"))  # opens the connection
            while not over.wait(0.02):
                for name in agents:
                    began_s = time.monotonic()
                    client.request(name, Describe("client/Pulse"))
                    control_s.append(time.monotonic() - began_s)
                    memory[name].append(fleet.memory_bytes(name))

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield control_s, memory
    finally:
        over.set()
        watcher.join()


def _shows(fleet: LoadedFleet, reading: str, case: Case) -> bool:
    """Return whether the overload has had an effect: `publish` was refused, or packets were dropped."""
    if case.where == "inside" and case.keep == "reliable":
        return bool(fleet.last("a", "Flood")["refused"])
    return bool(_dropped(fleet, reading, case.reader))


def _dropped(fleet: LoadedFleet, reading: str, reader: str) -> dict[str, int]:
    """Return the drops that an operator sees in `pancakes task info` and (of links) `pancakes agent info`."""
    reads = fleet.client.request(reading, Describe(f"client/{reader}")).result["reads"]
    dropped = {f"{reader} on {row['channel']}": row["dropped"] for row in reads if row["dropped"]}
    for peer in fleet.client.request("a", Describe()).result["mesh"]["peers"]:
        if peer["name"] == reading:
            dropped |= {f"to {reading} on {channel}": count for channel, count in peer["dropped"].items()}
    return dropped


def _behind(fleet: LoadedFleet, reading: str, reader: str) -> int:
    """Return how many packets are between the newest published one and the newest handled one."""
    published: int = fleet.last("a", "Flood")["published"]
    last: int = fleet.last(reading, reader)["last"]
    return published - last
