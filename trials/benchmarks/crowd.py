"""Many agents at once, each a process of its own: eight that send to one, and eight of which each sends to all.

What a packet costs is counted at its receivers: every one that arrives counts.
"""

from __future__ import annotations

import os
import select
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
from benchmarks.agent_process import (
    PATIENCE_S,
    agent_process,
    end,
    head_of,
    listening_at,
    offer_tasks,
    read_report,
)

MEMBERS = 8


class Shape(msgspec.Struct, frozen=True):
    """Who sends to whom.

    Attributes:
        name: what it is called.
        senders: how many send, each to all receivers but itself.
        receivers: how many receive: the first ones.
        addressed: whether a sender names each receiver in turn, instead of all neighbours at once.
        packets: how many each sender sends to each receiver.
    """

    name: str
    senders: Sequence[int]
    receivers: Sequence[int]
    addressed: bool
    packets: int

    @property
    def members(self) -> list[int]:
        """Everybody."""
        return sorted({*self.senders, *self.receivers})

    def receivers_of(self, sender: int) -> list[int]:
        """Returns who gets the packets of `sender`."""
        return [it for it in self.receivers if it != sender] if sender in self.senders else []

    def senders_to(self, receiver: int) -> list[int]:
        """Returns whose packets `receiver` gets."""
        return [it for it in self.senders if it != receiver] if receiver in self.receivers else []

    @property
    def deliveries(self) -> int:
        """How many packets arrive altogether."""
        return self.packets * sum(len(self.senders_to(receiver)) for receiver in self.receivers)


EIGHT_TO_ONE = Shape("8to1", range(1, MEMBERS + 1), [0], True, 30_000)
ALL_TO_ALL = Shape("all", range(MEMBERS), range(MEMBERS), False, 10_000)
ALL_TO_EACH = Shape("each", range(MEMBERS), range(MEMBERS), True, 5_000)

_TASK = """
[channel.bench]
[channel.load]
[task.Member]
type = "bench.Member"
settings = {{ {settings} }}
"""


def pancakes(shape: Shape, packets: int, size: int = 64) -> dict[int, dict[str, Any]]:
    """One run of ours. Returns what each member reports, by its number, or the first fault."""
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name, ExitStack() as stack:
        directory = Path(name)
        environment = offer_tasks(directory)
        readers: dict[int, int] = {}
        processes = []
        peers: list[str] = []
        for member in shape.members:
            readers[member], writer = os.pipe()
            stack.callback(os.close, readers[member])
            try:
                settings = _settings(shape, member, packets, size, writer)
                config = head_of(f"a{member}", directory, peers) + _TASK.format(settings=settings)
                # The first one is to be there before the others dial it.
                agent = agent_process(config, directory, environment, pass_fds=(writer,), until_ready=not peers)
                processes.append(stack.enter_context(agent))
            finally:
                os.close(writer)
            peers = peers or [listening_at(environment, "a0", processes[0])]
        stack.callback(end, processes)
        reports: dict[int, dict[str, Any]] = {}
        while len(reports) < len(readers) and not any("fault" in report for report in reports.values()):
            awaited = {reader: member for member, reader in readers.items() if member not in reports}
            # With a fault anywhere the others may wait for ever, so whoever speaks first is heard first.
            spoke = select.select(list(awaited), [], [], PATIENCE_S)[0]
            if not spoke:
                raise TimeoutError(f"members {sorted(awaited.values())} reported nothing within {PATIENCE_S:g} s")
            reports.update({awaited[reader]: read_report(reader) for reader in spoke})
        return reports


def _settings(shape: Shape, member: int, packets: int, size: int, report_fd: int) -> str:
    receivers = [f"a{it}" for it in shape.receivers_of(member)]
    to = receivers if shape.addressed or not receivers else ["*"]
    values: dict[str, Any] = {
        "report_fd": report_fd,
        "members": len(shape.members),
        "packets": packets,
        "size": size,
        "leads": member == 0,
        "to": to,
        "receivers": receivers,
        "senders": [f"a{it}" for it in shape.senders_to(member)],
    }
    return ", ".join(f"{key} = {msgspec.json.encode(value).decode()}" for key, value in values.items())


def rate(shape: Shape, packets: int, reports: dict[int, dict[str, Any]]) -> float:
    """Returns how many packets a second arrived, from the first sender's beginning to the last packet handled.

    Raises:
        RuntimeError: one was lost; the sentence says where, or which link broke.
    """
    wanted = packets * len(shape.senders_to(shape.receivers[0]))
    for report in reports.values():
        if "fault" in report:
            raise RuntimeError(report["fault"])
    for receiver in shape.receivers:
        if reports[receiver]["received"] != wanted:
            raise RuntimeError(f"{reports[receiver]['received']} of {wanted} packets arrived at member {receiver}")
    began_s = min(reports[it]["began_s"] for it in shape.senders)
    return wanted * len(shape.receivers) / (max(reports[it]["ended_s"] for it in shape.receivers) - began_s)


def cpu_us(shape: Shape, packets: int, reports: dict[int, dict[str, Any]]) -> list[float]:
    """Returns the µs of processor time that a packet takes at its receiver, and at one that only sends."""
    receivers = [reports[it]["cpu_s"] for it in shape.receivers]
    senders = [reports[it]["cpu_s"] for it in shape.senders if it not in shape.receivers]
    return [sum(side) / shape.deliveries * shape.packets / packets * 1e6 for side in (receivers, senders)]
