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
from typing import Any

import msgpack

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


def kind_of(packet: list[Any]) -> str:
    """Returns the kind of a packet that was decoded with `unpack`."""
    kind: str = packet[1]
    return kind


def body_of(packet: list[Any]) -> dict[str, Any]:
    """Returns the number and the data of a packet that was decoded with `unpack`."""
    body: dict[str, Any] = packet[7]
    return body


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


def _listen() -> None:
    for line in sys.stdin:
        _lines.put(line)
    os._exit(0)


threading.Thread(target=_listen, daemon=True).start()
