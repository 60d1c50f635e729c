"""The processes of a peer, with which the benchmark talks in lines of JSON, and one run of two of them, or many."""

from __future__ import annotations

import json
import os
import select
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

from benchmarks.agent_process import PATIENCE_S, end
from benchmarks.crowd import Shape
from benchmarks.environments import RCLPY, ROSPY, ZENOH, Peer, environment


class PeerProcess:
    """A peer's script that runs.

    Args:
        name: who it is, for errors.
        process: it, with a pipe to its input and one from its output.
    """

    def __init__(self, name: str, process: subprocess.Popen[bytes]) -> None:
        self.name = name
        self.process = process
        self._heard = b""

    def say(self, **fields: Any) -> None:
        """Tells it something."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{json.dumps(fields)}\n".encode())
        self.process.stdin.flush()

    def hear(self) -> dict[str, Any]:
        """Waits until it says something.

        Raises:
            TimeoutError: it says nothing.
            RuntimeError: it ended.
        """
        assert self.process.stdout is not None
        until_s = time.monotonic() + PATIENCE_S
        while b"\n" not in self._heard:
            if not select.select([self.process.stdout], [], [], max(0.0, until_s - time.monotonic()))[0]:
                raise TimeoutError(f"{self.name} said nothing within {PATIENCE_S:g} s")
            part = os.read(self.process.stdout.fileno(), 65_536)
            if not part:
                raise RuntimeError(f"{self.name} ended before it had said what was awaited")
            self._heard += part
        line, _, self._heard = self._heard.partition(b"\n")
        said: dict[str, Any] = json.loads(line)
        return said

    def hear_of(self, key: str) -> Any:
        """Waits until it says something with this key, and returns its value."""
        while key not in (said := self.hear()):
            pass
        return said[key]


@contextmanager
def peer_process(
    peer: Peer, python: Path, *arguments: str, variables: Mapping[str, str] = MappingProxyType({})
) -> Iterator[PeerProcess]:
    """Runs a peer's script, and ends it."""
    started = subprocess.Popen(
        [str(python), str(peer.script), *arguments],
        env={**environment(), **variables},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        process_group=0,  # see `agent_process.process`
    )
    try:
        yield PeerProcess(f"{peer.name} ({' '.join(arguments)})", started)
    finally:
        end([started])


def ros2_variables() -> dict[str, str]:
    """Returns what keeps the processes of this run to themselves: a DDS domain, and this machine."""
    return {"ROS_DOMAIN_ID": str(1 + os.getpid() % 100), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def pair(peer: Peer, python: Path, round_trips: int, packets: int, size: int) -> dict[str, Any]:
    """Measures round trips, then packets one way, between two processes; returns what the near one reports.

    Raises:
        RuntimeError: packets were lost.
    """
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as directory, ExitStack() as stack:
        variables: dict[str, str] = {}
        if peer is ROSPY:
            # Written into the directory, and reached on this machine only.
            variables = {"ROS_IP": "127.0.0.1", "ROS_HOME": directory, "ROS_LOG_DIR": directory}
            master = stack.enter_context(peer_process(peer, python, "master", variables=variables))
            variables["ROS_MASTER_URI"] = master.hear_of("at")
        if peer is RCLPY:
            variables = ros2_variables()
        far = stack.enter_context(peer_process(peer, python, "far", variables=variables))
        near = stack.enter_context(peer_process(peer, python, "near", far.hear_of("at"), variables=variables))
        near.say(round_trips=round_trips, packets=packets, size=size)
        report = near.hear()
    if report["received"] != packets:
        raise RuntimeError(f"{report['received']} of {packets} packets arrived over {peer.name}")
    return report


def zenoh_crowd(python: Path, shape: Shape, packets: int, size: int) -> dict[int, dict[str, Any]]:
    """Has many processes of zenoh send to each other; returns what each reports, by its number.

    Where `shape` names each receiver, each has a key to which all others publish; else each sender has one, to which
    all others subscribe.
    """
    with ExitStack() as stack:
        members = {}
        addresses: list[str] = []
        for number in shape.members:
            member = members[number] = stack.enter_context(peer_process(ZENOH, python, "member"))
            receivers, senders = shape.receivers_of(number), shape.senders_to(number)
            takes = ([number] if senders else []) if shape.addressed else senders
            to = receivers if shape.addressed else ([number] if receivers else [])
            member.say(
                number=number,
                connect=addresses if number in shape.receivers else addresses[: len(shape.receivers)],
                packets=packets,
                size=size,
                senders=senders,
                takes=[f"bench/{it}" for it in takes],
                to=[f"bench/{it}" for it in to],
            )
            addresses.append(member.hear_of("at"))
        stack.callback(end, [member.process for member in members.values()])
        for member in members.values():
            member.hear_of("ready")
        for member in members.values():
            member.say(go=True)
        reports: dict[int, dict[str, Any]] = {number: {} for number in members}
        for number, member in members.items():
            awaited = ["began_s"] + (["ended_s"] if shape.senders_to(number) else [])
            while any(key not in reports[number] for key in awaited):
                reports[number].update(member.hear())
        return reports
