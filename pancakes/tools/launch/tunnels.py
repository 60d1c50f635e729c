"""Ways to the agents of other hosts for a client on this machine: Unix sockets that OpenSSH leads to theirs.

An agent takes what comes that way for its own user's, as it is; so it asks for no keys.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from pancakes.errors import PancakesError, Unreachable
from pancakes.mesh.address import LOCAL
from pancakes.runtime.clock import MonotonicClock
from pancakes.tools.launch.host_link import OPEN_S
from pancakes.tools.launch.hosts import Host
from pancakes.tools.launch.ssh import no_ssh, scratch_file, sentence_of, silent, ssh_command, start_ssh

LOOK_S: Final = 0.05
END_S: Final = 2.0
"""A way that has not ended so long after it was told to is killed."""
_NOW: Final = MonotonicClock().now


@contextmanager
def tunnels(hosts: Iterable[Host]) -> Iterator[dict[str, str]]:
    """Makes a way to each agent of some hosts, whether it runs or not, and takes them away at the end. It may wait.

    Yields:
        The address of each agent, by its name.

    Raises:
        PancakesError: a host cannot be reached, or does not let these ways be made.
    """
    folder = tempfile.mkdtemp(prefix="pancakes-way-")
    addresses: dict[str, str] = {}
    made: list[_Tunnel] = []
    try:
        for host in hosts:
            ways = {}
            for name, agent in host.is_["agents"].items():
                path = Path(folder) / f"{len(addresses)}.sock"
                ways[path] = agent["socket"]
                addresses[name] = f"{LOCAL}://{path}"
            made.append(_Tunnel(host.name, ways))
        until_s = _NOW() + OPEN_S
        for tunnel in made:
            tunnel.wait(until_s)
        yield addresses
    finally:
        for tunnel in made:
            tunnel.close()
        shutil.rmtree(folder, ignore_errors=True)


class _Tunnel:
    """The ways to the agents of one host."""

    def __init__(self, host: str, ways: dict[Path, str]) -> None:
        self._host, self._ways = host, ways
        options = [word for here, there in ways.items() for word in ("-L", f"{here}:{there}")]
        options += ["-o", "ExitOnForwardFailure=yes", "-o", "StreamLocalBindMask=0177"]
        self._errors = scratch_file()
        try:
            # It ends with what is at the other end of its standard input, however that ends.
            command = [*ssh_command(host, "-T", *options), "exec sh -c 'while read -r line; do :; done'"]
            self._process = start_ssh(command, subprocess.DEVNULL, self._errors)
        except OSError as error:
            os.close(self._errors)
            raise PancakesError(no_ssh(error)) from None

    def wait(self, until_s: float) -> None:
        while not all(path.exists() for path in self._ways):
            code = self._process.poll()
            said = os.pread(self._errors, 65_536, 0).decode("utf-8", "replace")
            if code is not None:
                raise Unreachable(sentence_of(self._host, code, said))
            if _NOW() > until_s:
                raise Unreachable(silent(self._host, OPEN_S, said))
            time.sleep(LOOK_S)

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        with contextlib.suppress(OSError):
            os.close(self._errors)
