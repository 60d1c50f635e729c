"""Two machines on one cable: network namespaces with a link between them, so that multicast works as between robots."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator

import psutil
import pytest

PREFIX = "pancakes-mdns-"
HOSTS = ("10.77.0.1", "10.77.0.2")


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)


def _remove_those_of_ended_processes() -> None:
    """Removes what a test left behind that was killed."""
    listed = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True).stdout
    for name in [line.split()[0] for line in listed.splitlines() if line.startswith(PREFIX)]:
        pid = name.removeprefix(PREFIX).partition("-")[0]
        if pid.isdecimal() and not psutil.pid_exists(int(pid)):
            subprocess.run(["ip", "netns", "del", name], capture_output=True)


@contextlib.contextmanager
def two_networks() -> Iterator[tuple[list[str], list[str]]]:
    """Makes them, and removes them at the end; yields the prefix of a command that runs on each machine."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and the program ip")
    _remove_those_of_ended_processes()
    names = [f"{PREFIX}{os.getpid()}-{number}" for number in (1, 2)]
    try:
        try:
            for name in names:
                _ip("netns", "add", name)
            _ip("link", "add", "wire0", "netns", names[0], "type", "veth", "peer", "name", "wire0", "netns", names[1])
            for name, host in zip(names, HOSTS, strict=True):
                _ip("-n", name, "link", "set", "lo", "up")
                _ip("-n", name, "addr", "add", f"{host}/24", "dev", "wire0")
                _ip("-n", name, "link", "set", "wire0", "up")
                _ip("netns", "exec", name, "true")  # in some containers they can be made, and not entered
        except subprocess.CalledProcessError as error:
            pytest.skip(f"this machine makes no network namespaces with a link: {error.stderr.decode().strip()}")
        yield tuple(["ip", "netns", "exec", name] for name in names)  # type: ignore[misc]
    finally:
        for name in names:
            subprocess.run(["ip", "netns", "del", name], capture_output=True)
