"""Hold an agent at one step of its work, from outside: it blocks in a write to a pipe.

A named pipe is put in place of the file that the agent is about to write. The pipe is too short for the data, so the
write blocks; nobody reads, and the agent is killed there. The agent knows nothing of this.
"""

from __future__ import annotations

import fcntl
import os
import select
from contextlib import suppress
from pathlib import Path
from urllib.parse import quote

import msgpack

from pancakes.durable.record import TaskId
from pancakes.durable.register import Standing
from pancakes.durable.store import RECORD
from pancakes.journal.file_journal import WRITE_AHEAD, read_ahead
from pancakes.journal.journal import SUFFIX

PIPE_BYTES = 4096
BALLAST_BYTES = 2 * PIPE_BYTES
"""The size of a task's state that makes its snapshot longer than the pipe."""


class Gate:
    """A named pipe in place of a file.

    Args:
        path: its path, which must not exist.

    Raises:
        FileExistsError: something is there, such as what the agent is writing just now.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        os.mkfifo(path)
        # Open it for reading and writing, so that neither we nor the agent block in `open`.
        self._handle = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        fcntl.fcntl(self._handle, fcntl.F_SETPIPE_SZ, PIPE_BYTES)

    def reached(self, timeout_s: float) -> bool:
        """Wait until a process blocks there; return whether one does."""
        poll = select.poll()
        poll.register(self._handle, select.POLLIN)
        return bool(poll.poll(timeout_s * 1000.0))

    def standing(self, task_id: TaskId) -> Standing | None:
        """Return where the agent stands by the record that is being written; None: it is none of that task.

        What it has promised comes after the state, and is not in the pipe: so an owner that is about to promise the
        task stands as one that offers it.
        """
        written = os.read(self._handle, PIPE_BYTES)
        at = written.find(_text(RECORD) + _text(str(task_id)))
        begin = written.find(_text("register"), at) if at >= 0 else -1
        if begin < 0:
            return None
        # The record is incomplete, as intended, but the register begins with the fields that are needed.
        head = msgpack.Unpacker(strict_map_key=False)
        head.feed(written[begin + len(_text("register")) :])
        head.read_array_header()
        (_, owner, *_), _, _, _, heir = (head.unpack() for _ in range(5))
        agent = self.path.parent.name
        if owner[0] == agent:
            return Standing.OFFERED if heir[0] else Standing.OWNER
        return Standing.HEIR if heir[0] == agent else Standing.RELEASED

    def remove(self) -> None:
        """Remove the pipe; a process that blocks there fails to write, if it still lives."""
        self.path.unlink(missing_ok=True)
        os.close(self._handle)


def _text(value: str) -> bytes:
    return bytes((0xA0 | len(value),)) + value.encode()


class WriteGate(Gate):
    """A gate in place of the file that a journal appends to.

    Args:
        directory: the state directory.
    """

    def __init__(self, directory: Path) -> None:
        super().__init__(directory / "gate")
        self._kept = directory / (WRITE_AHEAD + ".kept")
        with suppress(FileNotFoundError):  # the journal may be empty
            os.link(directory / WRITE_AHEAD, self._kept)
        self.path = self.path.rename(directory / WRITE_AHEAD)

    @property
    def lies(self) -> bool:
        """Whether the gate is still there: after a failed write, a journal creates its file again."""
        return file_number(self.path) == os.fstat(self._handle).st_ino

    def remove(self) -> None:
        if self.lies:
            if self._kept.exists():
                self._kept.rename(self.path)
            else:
                self.path.unlink()
        self._kept.unlink(missing_ok=True)
        os.close(self._handle)


class RecordWatch:
    """Watch an agent's journal for the next record of a task.

    Args:
        state: the directory of all states.
        agent: the agent.
        task_id: the task.
    """

    def __init__(self, state: Path, agent: str, task_id: TaskId) -> None:
        self._file = journal_file(state, agent, task_id)
        self._ahead = state / agent / WRITE_AHEAD
        self._key = str(task_id)
        self._number = file_number(self._file)
        self._ahead_number, self._read = file_number(self._ahead), len(self._new(0))

    def written(self) -> bool:
        """Return whether a record was written since."""
        if file_number(self._file) != self._number:
            return True
        if (number := file_number(self._ahead)) != self._ahead_number:
            self._ahead_number, self._read = number, 0
        entries = [entry for batch in read_ahead(self._new(self._read)).batches for entry in batch.entries]
        return any((entry.kind, entry.key) == (RECORD, self._key) for entry in entries)

    def _new(self, since: int) -> bytes:
        with suppress(FileNotFoundError), self._ahead.open("rb") as file:
            file.seek(since)
            return file.read()
        return b""


def file_number(path: Path) -> int | None:
    """Return the identity of a file, which differs for its replacement; None: the file does not exist."""
    try:
        return os.stat(path).st_ino
    except FileNotFoundError:
        return None


def journal_file(state: Path, agent: str, task_id: TaskId) -> Path:
    """Return the path of an agent's record of a task, in the directory of all states."""
    return state / agent / f"{RECORD}.{quote(str(task_id), safe='')}{SUFFIX}"


def identity_file(state: Path, agent: str) -> Path:
    """Return the file that an agent replaces when it opens its journal; it is then ready for records."""
    return state / agent / f"identity.identity{SUFFIX}"
