"""A process of a peer, with which the benchmark talks in lines of JSON."""

from __future__ import annotations

import json
import os
import select
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

from benchmarks.agent_process import PATIENCE_S, end
from benchmarks.peer_environments import Peer, environment


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
