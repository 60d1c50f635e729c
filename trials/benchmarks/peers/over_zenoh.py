"""Processes with zenoh, as peers that are joined by TCP and never give a packet up.

    python over_zenoh.py far
    python over_zenoh.py near ADDRESS
    python over_zenoh.py member

Round trips go as express messages, which zenoh does not hold back to put several into one; everything else does not.
"""

from __future__ import annotations

import json
import queue
import socket
import sys
import time
from collections.abc import Sequence
from typing import Any

import zenoh
from talk import BODY, KIND, KNOCK_S, answering, encode, hear, knock, measure, say, unpack


def opened(connect: Sequence[str]) -> tuple[zenoh.Session, str]:
    """Returns a session, and where others reach it."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"tcp/127.0.0.1:{server.getsockname()[1]}"
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/enabled", "false")
    config.insert_json5("listen/endpoints", json.dumps([address]))
    config.insert_json5("connect/endpoints", json.dumps(list(connect)))
    return zenoh.open(config), address


def publisher(session: zenoh.Session, key: str, express: bool = False) -> zenoh.Publisher:
    """Returns a publisher that waits rather than give a packet up."""
    return session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK, express=express)


def far() -> None:
    """Answers pings, and acknowledges the last of what comes one way."""
    session, address = opened([])
    take = answering(publisher(session, "near", express=True).put)
    session.declare_subscriber("far", lambda sample: take(sample.payload.to_bytes()))
    say(at=address)
    hear()


def near(address: str) -> None:
    """Measures round trips, then packets one way."""
    session, _ = opened([address])
    came: queue.SimpleQueue[Any] = queue.SimpleQueue()
    session.declare_subscriber("near", lambda sample: came.put(unpack(sample.payload.to_bytes())))
    pings, loads = publisher(session, "far", express=True), publisher(session, "far")
    plan = hear()
    knock(pings.put, came)
    measure(plan, pings.put, loads.put, came.get)


def member() -> None:
    """One of many: sends to the keys that it is told, and takes what comes on its own."""
    told = hear()
    session, address = opened(told["connect"])
    say(at=address)
    waits_for = set(told["senders"])
    awaited = told["packets"] * len(told["senders"])
    count = 0
    ended_s = 0.0

    def take(sample: zenoh.Sample) -> None:
        nonlocal count, ended_s
        packet = unpack(sample.payload.to_bytes())
        body = packet[BODY]
        if packet[KIND] == "knock":
            if body["number"] in waits_for:
                waits_for.discard(body["number"])
                if not waits_for:
                    say(ready=True)
            return
        count += 1
        if count == awaited:
            ended_s = time.monotonic()
            say(ended_s=ended_s, received=count)

    for key in told["takes"]:
        session.declare_subscriber(key, take)
    publishers = [publisher(session, key) for key in told["to"]]
    if not awaited:
        say(ready=True)
    while not hear(KNOCK_S):
        for it in publishers:
            it.put(encode("knock", told["number"], b""))
    data = bytes(told["size"])
    began_s = time.monotonic()
    for number in range(told["packets"]):
        for it in publishers:
            it.put(encode("load", number, data))
    say(began_s=began_s)
    hear()


if __name__ == "__main__":
    {"far": far, "near": lambda: near(sys.argv[2]), "member": member}[sys.argv[1]]()
