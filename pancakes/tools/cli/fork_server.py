"""The program of a fork server: it loads what every agent needs, and forks agents as children of the launcher.

`python -m pancakes.tools.cli.fork_server FD PID`, with the number of a socket, and the process of the launcher. It ends
when the launcher closes the socket, or ends; the agents go on. `pancakes.tools.launch.process` is the launcher's end.
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
"""Agents run what is in these packages. Plug-ins are loaded by each agent: a thread that one begins would be lost."""
LONGEST: Final = 1 << 20
"""The largest message for one child, in bytes."""
MOST_FILES: Final = 16
STANDARD_STREAMS: Final = (1, 2)


def main() -> None:
    """Load what agents need, and fork them as it is asked to."""
    channel = connected()
    load(LOADED)
    child = serve(channel)
    if child is not None:
        message, files = child
        sys.argv[1:] = _take_place(msgpack.unpackb(message), files)
        setproctitle(" ".join((sys.executable, "-m", agent_command.__name__, *sys.argv[1:])))
        agent_command.agent(prog_name="pancakes-agent")


def connected() -> socket.socket:
    """Return the socket that the program's arguments name. From here on the program ends with its launcher."""
    channel, launcher_pid = socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2])
    die_with_parent(launcher_pid)
    return channel


def load(packages: Sequence[str]) -> None:
    """Import all modules of some packages, into memory that what is forked shares."""
    gc.disable()
    for name in packages:
        package = importlib.import_module(name)
        for module in pkgutil.walk_packages(package.__path__, f"{name}."):
            importlib.import_module(module.name)
    Plugins().unreadable()  # reading the entry points loads parts of Python, too
    gc.collect()
    gc.freeze()  # no collection writes to what all of them share


def serve(channel: socket.socket) -> tuple[bytes, list[int]] | None:
    """Fork a child for each message, until the launcher ends.

    Returns:
        None at that end; in each child its message, and the file descriptors that came with it.
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
    """Fork a child, and tell the launcher its process; return whether this is the child.

    A process between the two ends at once: the system gives its child to the launcher, which asks for that. The child
    waits until then, because it may ask the system to end it with its parent.
    """
    said, say = os.pipe()
    held, release = os.pipe()
    try:
        between = os.fork()
    except OSError:
        for file in (said, say, held, release):
            os.close(file)
        raise
    if between == 0:
        os.close(said)
        os.close(release)
        pid, error = 0, 0
        try:
            pid = os.fork()
        except OSError as failed:
            error = failed.errno or 0
        else:
            if pid == 0:
                os.close(say)
                if not os.read(held, 1):  # the fork server has ended, and the launcher knows nothing of this one
                    os._exit(0)
                os.close(held)
                return True
        os.write(say, msgpack.packb([pid, error]))
        os._exit(0)
    os.close(say)
    os.close(held)
    answer = os.read(said, LONGEST)
    os.waitpid(between, 0)
    os.close(said)
    os.write(release, b"\0")
    os.close(release)
    channel.send(answer)
    return False


def _take_place(arguments: Sequence[str], files: Sequence[int]) -> list[str]:
    """Give an agent a session and its output; return its arguments, with the descriptor that learns of its start."""
    # An interrupt at the terminal reaches the launcher, which stops its agents in order.
    os.setsid()
    output, *ready = files
    for stream in STANDARD_STREAMS:
        os.dup2(output, stream)
    os.close(output)
    return [*arguments, *(f"--ready-fd={file}" for file in ready)]


if __name__ == "__main__":
    main()
