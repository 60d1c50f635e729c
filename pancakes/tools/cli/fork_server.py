"""The program of a fork server: it loads what every agent needs, and forks agents as children of the launcher.

`python -m pancakes.tools.cli.fork_server FD PID`: FD is a socket, PID the process of the launcher. The fork server ends
when the launcher ends or closes the socket; its agents keep running. `pancakes.tools.launch.process` is the launcher's
side.
"""

from __future__ import annotations

import gc
import importlib
import os
import pkgutil
import socket
import sys
from collections.abc import Sequence
from typing import Final

import msgpack
from setproctitle import setproctitle

from pancakes.tools.cli import agent_command, agent_process, quiet_interrupt  # noqa: F401 - loaded for the agents
from pancakes.tools.cli.parent_death import die_with_parent
from pancakes.util.plugins import Plugins

LOADED: Final = ("pancakes.agent", "pancakes.durable", "pancakes.journal", "pancakes.mesh", "pancakes.services")
"""The packages that agents run. Each agent loads plug-ins itself: a thread that a plug-in starts is lost in a fork."""
LONGEST: Final = 1 << 20
"""The largest message for one child, in bytes."""
MOST_FILES: Final = 16
STANDARD_STREAMS: Final = (1, 2)


def main() -> None:
    """Load what agents need, and fork an agent for each request."""
    channel = connected()
    load(LOADED)
    child = serve(channel)
    if child is not None:
        message, files = child
        sys.argv[1:] = _take_place(msgpack.unpackb(message, unicode_errors="surrogateescape"), files)
        title = " ".join((sys.executable, "-m", agent_command.__name__, *sys.argv[1:]))
        setproctitle(os.fsencode(title).decode(errors="replace"))
        agent_command.agent(prog_name="pancakes-agent")


def connected() -> socket.socket:
    """Return the socket that the program's arguments name, and tie this process to its launcher's life."""
    channel, launcher_pid = socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2])
    die_with_parent(launcher_pid)
    return channel


def load(packages: Sequence[str]) -> None:
    """Import all modules of some packages, into memory that the forked processes share."""
    gc.disable()
    for name in packages:
        package = importlib.import_module(name)
        for module in pkgutil.walk_packages(package.__path__, f"{name}."):
            importlib.import_module(module.name)
    Plugins().unreadable()  # reading the entry points loads parts of Python, too
    gc.collect()
    gc.freeze()  # so that no garbage collection writes to shared memory pages


def serve(channel: socket.socket) -> tuple[bytes, list[int]] | None:
    """Fork a child for each message, until the launcher ends.

    Returns:
        None when the launcher ends; in each child its message, and the file descriptors that came with it.
    """
    while True:
        data, files, _, _ = socket.recv_fds(channel, LONGEST, MOST_FILES)
        if not data:
            return None
        try:
            is_child = _fork(channel)
        except OSError as error:
            channel.send(msgpack.packb([0, error.errno]))
        else:
            if is_child:
                channel.close()
                gc.enable()
                return data, files
        for file in files:
            os.close(file)


def _fork(channel: socket.socket) -> bool:
    """Fork a child, and report its process id to the launcher; return whether this is the child.

    It forks twice. The process between the two ends at once, so the system makes the launcher the parent of the child
    (the launcher asked to be such a parent). The child waits for that, because it may ask the system to end it with its
    parent.
    """
    report_reader, report_writer = os.pipe()
    release_reader, release_writer = os.pipe()
    try:
        between = os.fork()
    except OSError:
        for file in (report_reader, report_writer, release_reader, release_writer):
            os.close(file)
        raise
    if between == 0:
        os.close(report_reader)
        os.close(release_writer)
        pid, error = 0, 0
        try:
            pid = os.fork()
        except OSError as failed:
            error = failed.errno or 0
        else:
            if pid == 0:
                os.close(report_writer)
                if not os.read(release_reader, 1):  # the fork server has ended: the launcher does not know this child
                    os._exit(0)
                os.close(release_reader)
                return True
        os.write(report_writer, msgpack.packb([pid, error]))
        os._exit(0)
    os.close(report_writer)
    os.close(release_reader)
    answer = os.read(report_reader, LONGEST)
    os.waitpid(between, 0)
    os.close(report_reader)
    os.write(release_writer, b"\0")
    os.close(release_writer)
    channel.send(answer)
    return False


def _take_place(arguments: Sequence[str], files: Sequence[int]) -> list[str]:
    """Give an agent its own session and output; return its arguments, with the descriptor that reports its start."""
    # In its own session it gets no Ctrl-C of the terminal: the launcher gets that, and stops its agents in order.
    os.setsid()
    output, *ready = files
    for stream in STANDARD_STREAMS:
        os.dup2(output, stream)
    os.close(output)
    return [*arguments, *(f"--ready-fd={file}" for file in ready)]


if __name__ == "__main__":
    main()
