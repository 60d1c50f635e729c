"""The fork server's program for tests: it loads Pancakes once, and each child runs a module as `python -m` would.

`python -m harness.forked_program FD PID`, as `pancakes.tools.cli.fork_server`, on which it stands. See
`harness.programs`.
"""

from __future__ import annotations

import os
import runpy
import sys
import time
from collections.abc import Sequence
from typing import IO

import msgpack
from setproctitle import setproctitle

from pancakes.tools.cli.fork_server import connected, load, serve

LOADED = (
    *(
        "pancakes.agent",
        "pancakes.durable",
        "pancakes.journal",
        "pancakes.mesh",
        "pancakes.services",
        "pancakes.client",
    ),
    *("pancakes.tools.cli", "pancakes.tools.launch"),
)
STANDARD_STREAMS = (0, 1, 2)


def main() -> None:
    """Loads what agents and commands need, and is each child that is asked for."""
    channel = connected()
    ours = os.environ["PYTHONPATH"].split(os.pathsep)
    path = [entry for entry in sys.path[1:] if entry not in ours]
    load(LOADED)
    child = serve(channel)
    if child is not None:
        message, files = child
        module, arguments, environment, directory, session, group, numbers = msgpack.unpackb(message)
        setproctitle(" ".join((sys.executable, "-m", module, *arguments)))  # which needs the first environment
        take_place(environment, directory, session, group)
        take_files(files, numbers)
        sys.path[:] = [os.getcwd(), *filter(None, environment.get("PYTHONPATH", "").split(os.pathsep)), *path]
        sys.argv[1:] = arguments
        sys.modules.pop(module, None)  # it runs as __main__
        runpy.run_module(module, run_name="__main__", alter_sys=True)


def take_place(environment: dict[str, str], directory: str, session: bool, group: int | None) -> None:
    """Takes what a new process is given, or has from its parent."""
    os.environ.clear()
    os.environ.update(environment)
    time.tzset()
    os.chdir(directory)
    if session:
        os.setsid()
    if group is not None:
        os.setpgid(0, group)


def take_files(files: Sequence[int], numbers: Sequence[int]) -> None:
    """Gives the open files the numbers that they have in the parent, and opens the standard streams on the first ones.

    They arrived as any numbers, which may be among those that are wanted: so all are moved out of the way first.
    """
    free = max(*numbers, *files) + 1
    moved = [os.dup2(file, free + place) for place, file in enumerate(files)]
    for file in files:
        os.close(file)
    for file, number in zip(moved, numbers, strict=True):
        os.dup2(file, number)
        os.close(file)
    sys.stdin, sys.stdout, sys.stderr = map(stream, STANDARD_STREAMS)


def stream(number: int) -> IO[str]:
    """Opens a standard stream as Python does at its start."""
    was = (sys.stdin, sys.stdout, sys.stderr)[number]
    if number == 0:
        return open(0, encoding=was.encoding, errors=was.errors, closefd=False)
    # Python writes no line late on standard error, nor on a terminal.
    buffering = 1 if number == 2 or os.isatty(number) else -1
    made = open(number, "w", buffering, was.encoding, was.errors, closefd=False)  # noqa: SIM115 - open to the end
    if os.environ.get("PYTHONUNBUFFERED"):
        made.reconfigure(write_through=True)
    return made


if __name__ == "__main__":
    main()
