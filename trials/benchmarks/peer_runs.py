"""One run of a peer: two processes of it, or many."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from benchmarks.agent_process import end
from benchmarks.crowd import Shape
from benchmarks.peer_environments import ROSPY, ZENOH, Peer
from benchmarks.peer_process import peer_process


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
