"""What the scripts of the peers share: the packets, and how they talk to whoever starts them.

Neither this nor the scripts import anything of Pancakes: they run in environments of their own. A script prints a
line of JSON for each thing that it has to say, and reads one from its standard input for each that it is told. It ends
when that input does, so none outlives who started it.
"""

from __future__ import annotations

import json
import os
import queue
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, Final

import msgpack

KNOCK_S: Final = 0.1
"""How often another is called until it has been heard."""
KIND: Final = 1
BODY: Final = 7
"""Places in a packet that was decoded with `unpack`."""
Bytes = Callable[[bytes], object]
"""Sends a packet, or takes one."""

unpack = msgpack.unpackb
_pack = msgpack.Packer().pack
# Whatever else is printed, by a library that greets for example, goes to the error stream.
_said = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)
_lines: queue.SimpleQueue[str] = queue.SimpleQueue()


def encode(kind: str, number: int, data: bytes) -> bytes:
    """Returns a packet as it travels, with all that one of Pancakes' has."""
    body = {"number": number, "data": data}
    row = ["bench", kind, "near/client/Near", "far/client/Far", time.monotonic(), number, None, body, None]
    packed: bytes = _pack(row)
    return packed


def say(**fields: Any) -> None:
    """Tells whoever started this something."""
    _said.write(f"{json.dumps(fields)}\n")  # in one piece: several threads may have something to say
    _said.flush()


def hear(timeout_s: float | None = None) -> dict[str, Any]:
    """Waits until whoever started this says something; nothing comes back where that takes too long."""
    try:
        line: dict[str, Any] = json.loads(_lines.get(timeout=timeout_s))
    except queue.Empty:
        return {}
    return line


def answering(send: Bytes) -> Bytes:
    """Returns what takes each packet of the far process: pings are answered, and the last of what comes one way."""
    count = 0

    def take(data: bytes) -> None:
        nonlocal count
        packet = unpack(data)
        body = packet[BODY]
        if packet[KIND] == "ping":
            count = 0
            send(encode("pong", body["number"], body["data"]))
        else:
            count += 1
            if body["number"] < 0:
                send(encode("got", count, b""))

    return take


def knock(send: Bytes, came: queue.SimpleQueue[Any]) -> None:
    """Calls the far process until it and this one know of each other.

    Args:
        send: sends a ping.
        came: what it has answered.
    """
    while True:
        send(encode("ping", -1, b""))
        try:
            came.get(timeout=KNOCK_S)
            break
        except queue.Empty:
            continue
    time.sleep(2 * KNOCK_S)
    while not came.empty():
        came.get()


def measure(plan: dict[str, Any], ping: Bytes, load: Bytes, answer: Callable[[], Any]) -> None:
    """Measures round trips, then packets one way; says what came out, and waits for the end.

    Args:
        plan: how many of each (`round_trips`, `packets`), and how many bytes of data (`size`).
        ping: sends a packet that is answered.
        load: sends one of many.
        answer: waits for the next packet that comes back, and decodes it with `unpack`.
    """
    data = bytes(plan["size"])
    times_s = []
    for number in range(plan["round_trips"]):
        asked_s = time.perf_counter()
        ping(encode("ping", number, data))
        answer()
        times_s.append(time.perf_counter() - asked_s)
    packets = plan["packets"]
    began_s = time.perf_counter()
    for number in range(packets):
        load(encode("load", number if number + 1 < packets else -1, data))
    received = answer()[BODY]["number"]
    say(times_s=times_s, per_s=packets / (time.perf_counter() - began_s), received=received)
    hear()


def _listen() -> None:
    for line in sys.stdin:
        _lines.put(line)
    os._exit(0)


threading.Thread(target=_listen, daemon=True).start()
