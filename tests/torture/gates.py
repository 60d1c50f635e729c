"""Gates that hold an agent at one step of what it does, from outside: it stands still in a write to a pipe.

A named pipe lies where the agent is about to write. The pipe is shorter than what it writes, so the write does not end
until somebody reads; nobody does, and the agent is killed there. It knows nothing of all this.
"""

from __future__ import annotations

import fcntl
import os
import select
from pathlib import Path
from urllib.parse import quote

from pancakes.mesh.migration.record import Phase, TaskId
from pancakes.runtime.hosting.records import KIND
from pancakes.runtime.journal.journal import SUFFIX

PIPE_BYTES = 4096
BALLAST_BYTES = 2 * PIPE_BYTES
"""Of a task's state, so that its snapshot is longer than the pipe."""
_TEMPORARY = ".tmp"


class Gate:
    """A named pipe in somebody's way.

    Args:
        path: where it lies; nothing may be there.

    Raises:
        FileExistsError: something is there, such as what the agent is writing just now.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        os.mkfifo(path)
        # Both ways: so nobody waits in `open`, neither we nor the agent.
        self._handle = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        fcntl.fcntl(self._handle, fcntl.F_SETPIPE_SZ, PIPE_BYTES)

    def reached(self, timeout_s: float) -> bool:
        """Waits until somebody stands there; returns whether somebody does."""
        poll = select.poll()
        poll.register(self._handle, select.POLLIN)
        return bool(poll.poll(timeout_s * 1000.0))

    def phase(self) -> Phase | None:
        """Returns the phase in the record that somebody is writing; None where it is no record."""
        head = os.read(self._handle, 512)
        # The record itself is torn, as it is to be; its second field is what it begins with.
        return next((phase for phase in Phase if b"phase" + _text(phase.value) in head), None)

    def remove(self) -> None:
        """Takes it out of the way; whoever stood there fails to write, if it still lives."""
        self.path.unlink(missing_ok=True)
        os.close(self._handle)


def _text(value: str) -> bytes:
    return bytes((0xA0 | len(value),)) + value.encode()


def journal_file(state: Path, agent: str, task_id: TaskId) -> Path:
    """Returns where an agent keeps its record of a task, in the directory of all states."""
    return state / agent / f"{KIND}.{quote(str(task_id), safe='')}{SUFFIX}"


def identity_file(state: Path, agent: str) -> Path:
    """Returns the file that an agent replaces when it opens its journal; it is then ready for records."""
    return state / agent / f"identity.identity{SUFFIX}"


def before_write(state: Path, agent: str, task_id: TaskId) -> Gate:
    """Returns a gate at the agent's next write of its record of a task.

    Raises:
        FileExistsError: it is writing one just now.
    """
    path = journal_file(state, agent, task_id)
    return Gate(path.with_name(path.name + _TEMPORARY))
