"""Connect to another host over the user's own OpenSSH, and talk to the program of `pancakes.tools.remote_host` there.

The source of that program is sent over the connection as one line of Python, so a host needs only Python. A `HostLink`
belongs to one thread; only `obtain` blocks. This module also explains the errors of `ssh` to people.
"""

from __future__ import annotations

import base64
import contextlib
import errno
import json
import math
import os
import re
import secrets
import select
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, TypedDict

import msgspec

import pancakes.tools.remote_host as there
from pancakes.errors import PancakesError, UnreachableError
from pancakes.util import codecs
from pancakes.util.clock import MonotonicClock
from pancakes.util.codecs import plain_of

VARIABLE: Final = "PANCAKES_SSH"
"""The environment variable with the command to use instead of `ssh`, with options: `ssh -F FILE`."""
OPTIONS: Final = (
    *("-o", "BatchMode=yes"),
    *("-o", "ConnectTimeout=10"),
    *("-o", "ServerAliveInterval=5"),
    *("-o", "ServerAliveCountMax=3"),
)
NO_PYTHON: Final = 97
"""The exit code if no Python on the host is new enough."""
MODULES: Final = (
    "host_folders",
    "agent_processes",
    "agent_supervisor",
    "service_managers",
    "host_probe",
    "deployment",
    "server",
)
"""The modules that run on the host, each after those that it imports."""
_DYING: Final = """
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, 15, 0, 0, 0)
if os.getppid() == int(sys.argv[1]):
    os.execvp(sys.argv[2], sys.argv[2:])
"""
"""Runs a command that ends when its parent ends: 1 is PR_SET_PDEATHSIG of <linux/prctl.h>, 15 is SIGTERM."""
_HOST: Final = re.compile(r"[A-Za-z0-9_\[][\w.@:%+\[\]-]*")

_MEANINGS: Final = (
    (
        "permission denied",
        "does not accept your key",
        "make `ssh {host}` work without a password: ssh-copy-id {host}",
    ),
    (
        "identification has changed",
        "shows another host key than before",
        "find out why; then `ssh-keygen -R` and `ssh {host}`",
    ),
    ("host key verification failed", "shows a host key that is not known here", "compare it once: `ssh {host}`"),
    (
        "could not resolve",
        "is a name that this machine cannot look up",
        "correct `host` in the fleet file, or ~/.ssh/config",
    ),
    ("connection refused", "has no SSH server at that port", "start one there, or correct the port in ~/.ssh/config"),
    ("timed out", "does not answer", "see whether it runs, and whether its network is up"),
    ("no route to host", "cannot be reached", "see whether it runs, and whether its network is up"),
    ("network is unreachable", "cannot be reached", "see whether this machine has a network"),
    ("timeout, server", "no longer answers", "see whether it runs, and whether its network is up"),
)


def fault_of_host(host: str) -> str:
    """Return why a text cannot be the host argument of `ssh`, as a phrase; empty if it can."""
    return "" if _HOST.fullmatch(host) else "is not a host: write it as pi@robot1, or as a name of ~/.ssh/config"


def ssh_command(host: str, *options: str) -> list[str]:
    """Return the beginning of a command that reaches a host."""
    return [*shlex.split(os.environ.get(VARIABLE) or "ssh"), *OPTIONS, *options, host]


def start_ssh(command: Sequence[str], output: int, errors: int) -> subprocess.Popen[bytes]:
    """Start an `ssh` command that ends with this program, however this program ends and even if the host is silent.

    Args:
        command: the command.
        output: its standard output, as `subprocess` takes it.
        errors: the file descriptor of its standard error.

    Raises:
        OSError: this machine has no `ssh`.
    """
    if shutil.which(command[0]) is None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), command[0])
    dying = [sys.executable, "-I", "-S", "-c", _DYING, str(os.getpid())] if sys.platform == "linux" else []
    return subprocess.Popen(
        [*dying, *command],
        stdin=subprocess.PIPE,
        stdout=output,
        stderr=errors,
        start_new_session=True,  # Ctrl-C at the terminal reaches only Pancakes, which ends this command gracefully
    )


def open_host(host: str, errors: int) -> tuple[subprocess.Popen[bytes], bytes]:
    """Start Python on a host; it then runs the line that it is sent (`source`).

    Args:
        host: the host.
        errors: the file descriptor of the standard error of `ssh`, and of Python on the host.

    Returns:
        The process of `ssh`, and the marker before each answer of the host: other output of its shell has no marker, so
        it is not taken for an answer. The host begins with an empty answer. Send nothing before that: a start file of
        the shell could read it from standard input.

    Raises:
        OSError: this machine has no `ssh`.
    """
    marker = f"pancakes-{secrets.token_hex(12)} ".encode()
    # The command contains the marker as a number, so that a shell which echoes its commands does not print the marker.
    begun = b"\n" + marker + b"{}\n"
    own = f"python3.{sys.version_info.minor}"
    names = " ".join(dict.fromkeys((own, "python3", "python3.14", "python3.13", "python3.12", "python3.11")))
    program = (
        f"for p in {names}; do "
        'if "$p" -c "import sys; sys.exit(sys.version_info < (3, 11))" 2>/dev/null; then '
        f'exec "$p" -u -c "import io, os; os.write(1, (0x{begun.hex()}).to_bytes({len(begun)})); '
        'exec(io.FileIO(0, closefd=False).readline())"; fi; done; '
        f"python3 -V 1>&2; exit {NO_PYTHON}"
    )
    command = [*ssh_command(host, "-T"), f"exec sh -c '{program}'"]
    return start_ssh(command, subprocess.PIPE, errors), marker


def source(marker: bytes) -> bytes:
    """Return the source of the host's program, as one line of Python.

    Args:
        marker: the prefix of each answer.
    """
    folder = Path(there.__file__).parent
    package = there.__name__
    modules = {"pancakes": "", "pancakes.tools": "", package: ""}
    modules.update({f"{package}.{name}": (folder / f"{name}.py").read_text() for name in MODULES})
    program = (
        "import sys, types\n"
        f"for name, source in {modules!r}.items():\n"
        "    module = types.ModuleType(name)\n"
        "    module.__path__, module.__source__ = [], source\n"
        "    sys.modules[name] = module\n"
        "    parent, _, last = name.rpartition('.')\n"
        "    if parent:\n"
        "        setattr(sys.modules[parent], last, module)\n"
        "    exec(compile(source, name, 'exec'), module.__dict__)\n"
        f"sys.modules[{package + '.server'!r}].main({marker!r})\n"
    )
    return f"exec({program!r})\n".encode()


def silent(host: str, within_s: float, errors: str) -> str:
    """Return a sentence about a host that accepts the connection but does not answer.

    Args:
        host: the host.
        within_s: how long it has been silent, in seconds.
        errors: what `ssh` and the host's shell printed on standard error.
    """
    last = next((line.strip() for line in reversed(errors.splitlines()) if line.strip()), "")
    advice = f"see what `ssh {host} true` does, and what its shell runs at a login (~/.bashrc)"
    return f"{host} does not answer within {within_s:g} s{f' ({last})' if last else ''}: {advice}"


def sentence_of(host: str, code: int, errors: str) -> str:
    """Return why a connection has ended, and what to do, as a sentence.

    Args:
        host: the host.
        code: the exit code of `ssh`.
        errors: what `ssh`, or Python on the host, printed on standard error.
    """
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    if code == NO_PYTHON:
        found = next((line for line in lines if line.startswith("Python")), "")
        has = f"only {found}" if found else "none"
        return f"{host}: Pancakes needs Python 3.11 or newer, and this host has {has}: install python3.11 there"
    for part, meaning, advice in _MEANINGS:
        if any(part in line.lower() for line in lines):
            line = next(line for line in lines if part in line.lower())
            return f"{host} {meaning} ({line}): {advice.format(host=host)}"
    last = lines[-1] if lines else f"ssh has ended with exit code {code}"
    return f"the connection to {host} is lost: {last}"


def no_ssh(error: OSError) -> str:
    """Return a sentence about a machine without `ssh`."""
    command = shlex.split(os.environ.get(VARIABLE) or "ssh")[0]
    why = (error.strerror or str(error)).lower()
    return f"{command} cannot be run ({why}): apt install openssh-client, or set {VARIABLE} to the command to use"


def scratch_file() -> int:
    """Return an open file without a name."""
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


OPEN_S: Final = 30.0
"""How long a host may take for its first answer, in seconds."""
CALL_S: Final = 900.0
"""How long a request may take, in seconds: a slow disk unpacks wheels."""
SILENT_S: Final = 30.0
"""How long a host may be silent after its first answer, in seconds; it sends a sign of life every few seconds."""
PIECE_BYTES: Final = 192 * 1024
"""Files are sent in pieces of this many bytes."""
_CHUNK: Final = 1 << 16
_NOW: Final = MonotonicClock().now


LONGEST_LINE: Final = 16 << 20
"""The longest answer of a host, in bytes."""


class _Message(TypedDict, total=False):
    """One line of a host: the answer to a request, or an event of an agent."""

    id: int
    result: Any
    fault: str
    agent: str
    event: str
    text: str
    code: int


class HostError(PancakesError):
    """A host cannot do what was requested. The sentence names the host, and what to do."""


class HostLink:
    """One connection to a host, for use in one thread. Only `obtain`, `send_file` and `close` block.

    Args:
        host: the host, as `ssh` takes it.

    Attributes:
        host: the same.
        lost: why the connection has ended, as a sentence; empty: it has not ended.
        begun: whether the host has begun to answer.

    Raises:
        PancakesError: this machine has no `ssh`.
    """

    def __init__(self, host: str) -> None:
        self.host = host
        self.lost = ""
        self._errors = scratch_file()
        try:
            self._process, self._marker = open_host(host, self._errors)
        except OSError as error:
            os.close(self._errors)
            raise PancakesError(no_ssh(error)) from None
        assert self._process.stdin is not None and self._process.stdout is not None
        self._in, self._out = self._process.stdout.fileno(), self._process.stdin.fileno()
        for end in (self._in, self._out):
            os.set_blocking(end, False)
        self._waiting = bytearray(source(self._marker))
        self._line = bytearray()
        self._number = 0
        self._heard_s = _NOW()
        self._noise_bytes = 0
        self.begun = False

    @property
    def reads(self) -> int:
        """The file descriptor to read answers from."""
        return self._in

    @property
    def writes(self) -> int:
        """The file descriptor to write requests to."""
        return self._out

    @property
    def has_more(self) -> bool:
        """Whether requests wait that `flush` can write."""
        return self.begun and bool(self._waiting)

    def send(self, do: str, **arguments: Any) -> int:
        """Send a request; return the `id` that its answer will have."""
        self._number += 1
        self._waiting += json.dumps({"id": self._number, "do": do, **arguments}).encode() + b"\n"
        self.flush()
        return self._number

    def flush(self) -> None:
        """Write as much of the waiting requests as the connection takes now; nothing before the host's first answer."""
        try:
            while self.has_more and not self.lost:
                del self._waiting[: os.write(self._out, self._waiting[:_CHUNK])]
        except BlockingIOError:
            pass
        except OSError:
            self._waiting.clear()  # `read` finds the end of the connection

    def read(self) -> list[dict[str, Any]]:
        """Return the answers and events that have arrived; if the connection has ended, `lost` says why."""
        if self.lost:
            return []
        try:
            data = os.read(self._in, _CHUNK)
        except BlockingIOError:
            return []
        if not data:
            self._end()
            return []
        *lines, begun = data.split(b"\n")
        if lines:
            lines[0], self._line = bytes(self._line) + lines[0], bytearray()
        self._line += begun
        if not self.begun:
            del self._line[:-_CHUNK]  # a shell may print endlessly without a newline
        try:
            if max(map(len, (*lines, self._line))) > LONGEST_LINE:
                raise ValueError(f"a line of more than {LONGEST_LINE >> 20} MiB")
            found = [it for line in lines for it in self._parsed(line)]
        except (ValueError, msgspec.ValidationError) as error:
            self._end(0.0)
            self.lost = f"{self.host} sends an answer that is not Pancakes' ({error}): see what runs there"
            return []
        if found:
            self._heard_s = _NOW()
        if found and not self.begun:
            self.begun, self._noise_bytes = True, os.lseek(self._errors, 0, os.SEEK_END)
            self.flush()
        return [it for it in found if it and it.get("event") != "alive"]

    def _parsed(self, line: bytes) -> Iterator[dict[str, Any]]:
        """Yield the message of a line. Text before the marker, or without one, is from the user's shell there.

        Raises:
            ValueError, msgspec.ValidationError: the line has the marker, but the rest is not a message.
        """
        _, marker, message = line.partition(self._marker)
        if marker:
            yield codecs.convert(plain_of(message), _Message)

    def obtain(self, do: str, within_s: float = CALL_S, kind: Any = Any, **arguments: Any) -> Any:
        """Send a request and wait for its answer; messages of the host in between are ignored.

        Args:
            do: the name of the request.
            within_s: how long the answer may take, in seconds.
            kind: the type of the answer.
            arguments: the arguments of the request.

        Raises:
            HostError: the host cannot do it, or its answer has another type.
            UnreachableError: the connection has ended, or no answer arrives in time.
        """
        number, began_s = self.send(do, **arguments), _NOW()
        while not self.lost:
            # Before its first answer, a host has the whole time: `ssh` may go through other hosts.
            patience_s = min(began_s + within_s, max(began_s, self._heard_s) + SILENT_S if self.begun else math.inf)
            left_s = patience_s - _NOW()
            if left_s <= 0:
                self._give_up(min(within_s, SILENT_S) if self.begun else within_s)
                break
            writes = [self._out] if self.has_more else []
            readable, writable, _ = select.select([self._in], writes, [], left_s)
            if writable:
                self.flush()
            for answer in self.read() if readable else ():
                if answer.get("id") != number:
                    continue
                if "fault" in answer:
                    raise HostError(f"{self.host} {answer['fault']}")
                try:
                    return codecs.convert(answer.get("result"), kind)
                except msgspec.ValidationError as error:
                    raise HostError(f"the answer of {self.host} to {do!r} cannot be read: {error}") from None
        raise UnreachableError(self.lost)

    def send_file(self, name: str, digest: str, data: bytes, sent: Callable[[int], None] = lambda count: None) -> None:
        """Send a wheel; after each piece, `sent` gets the number of bytes sent so far. Errors are those of `obtain`."""
        for start in range(0, len(data), PIECE_BYTES):
            piece, end = data[start : start + PIECE_BYTES], start + PIECE_BYTES
            encoded = base64.b64encode(piece).decode()
            self.obtain("put", name=name, digest=digest, data=encoded, last=end >= len(data))
            sent(min(end, len(data)))

    def close(self, within_s: float = 5.0) -> None:
        """End the connection, and with it the agents that were launched over it."""
        self.let_go()
        with contextlib.suppress(subprocess.TimeoutExpired):
            # A host that has never answered will not react to the end of its input either.
            self._process.wait(within_s if self.begun else 0.0)
        self._end(0.0)

    def let_go(self) -> None:
        """Close the input of the host: it ends the agents that were launched. `close` waits for that."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()

    def end_if_silent(self) -> bool:
        """End the connection if the host has been silent too long; return whether it was ended."""
        patience_s = SILENT_S if self.begun else OPEN_S
        if self.lost or _NOW() - self._heard_s < patience_s:
            return False
        self._give_up(patience_s)
        return True

    def _give_up(self, within_s: float) -> None:
        errors = self._last_errors()
        self.close(0.0)
        self.lost = silent(self.host, within_s, errors)

    def _last_errors(self) -> str:
        """Return the end of what was printed on standard error since the host's first answer."""
        size = os.lseek(self._errors, 0, os.SEEK_END)
        return os.pread(self._errors, _CHUNK, max(self._noise_bytes, size - _CHUNK)).decode("utf-8", "replace")

    def _end(self, within_s: float = 1.0) -> None:
        if self.lost:
            return
        try:
            code = self._process.wait(within_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        self.lost = sentence_of(self.host, code, self._last_errors())
        os.close(self._errors)
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with contextlib.suppress(OSError):
                pipe.close()
