"""Connect to another host over the user's own OpenSSH, and talk to the program of `pancakes.tools.remote_host` there.

The source of that program is sent over the connection as one line of Python, so a host needs nothing but Python. A
`HostLink` belongs to one thread; only `obtain` waits. The sentences for the errors of `ssh` are made here.
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
from pancakes.errors import PancakesError, Unreachable
from pancakes.util import codecs
from pancakes.util.clock import MonotonicClock
from pancakes.util.codecs import plain_of

VARIABLE: Final = "PANCAKES_SSH"
"""The environment variable that names another command than `ssh`, with options: `ssh -F FILE`."""
OPTIONS: Final = (
    *("-o", "BatchMode=yes"),
    *("-o", "ConnectTimeout=10"),
    *("-o", "ServerAliveInterval=5"),
    *("-o", "ServerAliveCountMax=3"),
)
NO_PYTHON: Final = 97
"""The exit code where a host has no Python that is new enough."""
MODULES: Final = (
    "host_folders",
    "agent_processes",
    "agent_supervisor",
    "service_managers",
    "host_probe",
    "deployment",
    "server",
)
"""What runs there, each after those that it imports."""
_DYING: Final = """
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, 15, 0, 0, 0)
if os.getppid() == int(sys.argv[1]):
    os.execvp(sys.argv[2], sys.argv[2:])
"""
"""Ends a command with the program that starts it: 1 is PR_SET_PDEATHSIG of <linux/prctl.h>, 15 is SIGTERM."""
_HOST: Final = re.compile(r"[A-Za-z0-9_\[][\w.@:%+\[\]-]*")

_MEANINGS: Final = (
    (
        "permission denied",
        "does not take your key",
        "see that `ssh {host}` lets you in without a password: ssh-copy-id {host}",
    ),
    (
        "identification has changed",
        "shows another host key than before",
        "find out why; then `ssh-keygen -R` and `ssh {host}`",
    ),
    ("host key verification failed", "shows a host key that is not known here", "compare it once: `ssh {host}`"),
    (
        "could not resolve",
        "is no name that this machine can look up",
        "correct host in the fleet file, or ~/.ssh/config",
    ),
    ("connection refused", "has no SSH server at that port", "start one there, or correct the port in ~/.ssh/config"),
    ("timed out", "does not answer", "see whether it runs, and whether its network is up"),
    ("no route to host", "cannot be reached", "see whether it runs, and whether its network is up"),
    ("network is unreachable", "cannot be reached", "see whether this machine has a network"),
    ("timeout, server", "does not answer any more", "see whether it runs, and whether its network is up"),
)


def fault_of_host(host: str) -> str:
    """Return why a text is none that `ssh` could be given as a host, as a phrase; empty: it is one."""
    return "" if _HOST.fullmatch(host) else "is no host: write it as pi@robot1, or as a name of ~/.ssh/config"


def ssh_command(host: str, *options: str) -> list[str]:
    """Return the beginning of a command that reaches a host."""
    return [*shlex.split(os.environ.get(VARIABLE) or "ssh"), *OPTIONS, *options, host]


def start_ssh(command: Sequence[str], output: int, errors: int) -> subprocess.Popen[bytes]:
    """Start a command of `ssh`. It ends with this program, however that ends: also one to a host that says nothing.

    Args:
        command: the command.
        output: what becomes of its standard output, as `subprocess` takes it.
        errors: a file that takes its standard error.

    Raises:
        OSError: there is no `ssh` here.
    """
    if shutil.which(command[0]) is None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), command[0])
    dying = [sys.executable, "-I", "-S", "-c", _DYING, str(os.getpid())] if sys.platform == "linux" else []
    return subprocess.Popen(
        [*dying, *command],
        stdin=subprocess.PIPE,
        stdout=output,
        stderr=errors,
        start_new_session=True,  # an interrupt at the terminal reaches Pancakes, which ends it in order
    )


def open_host(host: str, errors: int) -> tuple[subprocess.Popen[bytes], bytes]:
    """Start a Python on a host, which runs the line that is sent to it (`source`).

    Args:
        host: the host.
        errors: a file that takes what `ssh`, and Python over there, say.

    Returns:
        The process of `ssh`, and the marker that stands before each answer of the host, so that nothing that its shell
        prints is taken for one. The host begins with an empty answer. Nothing may be sent before that: a start file of
        the shell that reads would take it.

    Raises:
        OSError: there is no `ssh` here.
    """
    marker = f"pancakes-{secrets.token_hex(12)} ".encode()
    # The command has it as a number: a shell that shows its commands does not show the marker.
    begun = b"\n" + marker + b"{}\n"
    own = f"python3.{sys.version_info.minor}"
    names = " ".join(dict.fromkeys((own, "python3", "python3.13", "python3.12", "python3.11", "python3.14")))
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
    """Return the source of what runs on a host, as one line of Python.

    Args:
        marker: what stands before each of its answers.
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


def silent(host: str, within_s: float, said: str) -> str:
    """Return a sentence about a host that lets `ssh` in, or takes its connection, and is silent.

    Args:
        host: the host.
        within_s: for how long.
        said: what `ssh`, and the shell over there, said on standard error.
    """
    last = next((line.strip() for line in reversed(said.splitlines()) if line.strip()), "")
    advice = f"see what `ssh {host} true` does, and what its shell runs at a login (~/.bashrc)"
    return f"{host} does not answer within {within_s:g} s{f' ({last})' if last else ''}: {advice}"


def sentence_of(host: str, code: int, said: str) -> str:
    """Return what the end of a connection means, and what to do, as a sentence.

    Args:
        host: the host.
        code: the exit code of `ssh`.
        said: what it, or Python over there, said on standard error.
    """
    lines = [line.strip() for line in said.splitlines() if line.strip()]
    if code == NO_PYTHON:
        found = next((line for line in lines if line.startswith("Python")), "")
        has = f"only {found}" if found else "none"
        return f"{host}: Pancakes needs Python 3.11 or newer there, and it has {has}: install one there, as python3.11"
    for part, meaning, advice in _MEANINGS:
        if any(part in line.lower() for line in lines):
            return f"{host} {meaning} ({_shown(lines, part)}): {advice.format(host=host)}"
    said_last = lines[-1] if lines else f"ssh has ended with {code}"
    return f"the connection to {host} is lost: {said_last}"


def no_ssh(error: OSError) -> str:
    """Return a sentence to say if there is no `ssh` on this machine."""
    command = shlex.split(os.environ.get(VARIABLE) or "ssh")[0]
    why = (error.strerror or str(error)).lower()
    return f"{command} cannot be run ({why}): apt install openssh-client, or set {VARIABLE} to the command to use"


def scratch_file() -> int:
    """Return an open file without a name."""
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def _shown(lines: Sequence[str], part: str) -> str:
    return next(line for line in lines if part in line.lower())


OPEN_S: Final = 30.0
"""A host that has not answered for so long cannot be reached."""
CALL_S: Final = 900.0
"""The longest that anything asked of a host takes: a slow disk unpacks wheels."""
SILENT_S: Final = 30.0
"""A host that has begun to answer says each few seconds that it lives; one that is silent for so long has gone."""
PIECE_BYTES: Final = 192 * 1024
"""Files are sent in pieces of so many bytes."""
_CHUNK: Final = 1 << 16
_NOW: Final = MonotonicClock().now


LONGEST_LINE: Final = 16 << 20
"""No answer of a host is longer."""


class _Told(TypedDict, total=False):
    """What a host says in one line: the answer to a request, or an event of an agent."""

    id: int
    result: Any
    fault: str
    agent: str
    event: str
    text: str
    code: int


class HostError(PancakesError):
    """A host cannot do what it was asked for. The sentence names it, and what to do."""


class HostLink:
    """One connection to a host, for the thread that has it. Nothing here waits but `obtain`.

    Args:
        host: the host, as `ssh` takes it.

    Attributes:
        host: the same.
        lost: a sentence about the end of the connection; empty: it has not ended.
        begun: whether the host has begun to answer.

    Raises:
        PancakesError: there is no `ssh` on this machine.
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
        """The file descriptor at which answers come."""
        return self._in

    @property
    def writes(self) -> int:
        """The file descriptor to which requests go."""
        return self._out

    @property
    def has_more(self) -> bool:
        """Whether requests wait that can be written (`flush`)."""
        return self.begun and bool(self._waiting)

    def send(self, do: str, **arguments: Any) -> int:
        """Ask for something; return the number that its answer bears."""
        self._number += 1
        self._waiting += json.dumps({"id": self._number, "do": do, **arguments}).encode() + b"\n"
        self.flush()
        return self._number

    def flush(self) -> None:
        """Write as much of what waits as the connection takes now; nothing before the host has begun to answer."""
        try:
            while self.has_more and not self.lost:
                del self._waiting[: os.write(self._out, self._waiting[:_CHUNK])]
        except BlockingIOError:
            pass
        except OSError:
            self._waiting.clear()  # its end is read where answers come

    def read(self) -> list[dict[str, Any]]:
        """Return the answers and the events that have come; where the connection has ended, `lost` says why."""
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
            del self._line[:-_CHUNK]  # a shell may print without an end
        try:
            if max(map(len, (*lines, self._line))) > LONGEST_LINE:
                raise ValueError(f"a line of more than {LONGEST_LINE >> 20} MiB")
            found = [it for line in lines for it in self._parsed(line)]
        except (ValueError, msgspec.ValidationError) as error:
            self._end(0.0)
            self.lost = f"{self.host} answers what Pancakes does not say ({error}): see what runs there"
            return []
        if found:
            self._heard_s = _NOW()
        if found and not self.begun:
            self.begun, self._noise_bytes = True, os.lseek(self._errors, 0, os.SEEK_END)
            self.flush()
        return [it for it in found if it and it.get("event") != "alive"]

    def _parsed(self, line: bytes) -> Iterator[dict[str, Any]]:
        """Yield what a line says; what stands before the marker, or has none, is of the user's shell over there.

        Raises:
            ValueError, msgspec.ValidationError: it has the marker, and is no answer.
        """
        _, marker, said = line.partition(self._marker)
        if marker:
            yield codecs.convert(plain_of(said), _Told)

    def obtain(self, do: str, within_s: float = CALL_S, kind: Any = Any, **arguments: Any) -> Any:
        """Ask for something, and wait for the answer; what the host tells meanwhile is passed over.

        Args:
            do: what is asked for.
            within_s: how long the answer may take.
            kind: the type of the answer.
            arguments: what is said with it.

        Raises:
            HostError: the host cannot do it, or its answer is none of that type.
            Unreachable: the connection has ended, or no answer comes in time.
        """
        number, began_s = self.send(do, **arguments), _NOW()
        while not self.lost:
            # One that has not begun has the whole time for it: `ssh` may go through other hosts.
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
                    raise HostError(f"{self.host} answers {do} with what cannot be read: {error}") from None
        raise Unreachable(self.lost)

    def send_file(self, name: str, digest: str, data: bytes, told: Callable[[int], None] = lambda sent: None) -> None:
        """Send a wheel; `told` gets how many bytes of it are there by now. The errors are those of `obtain`."""
        for start in range(0, len(data), PIECE_BYTES):
            piece, end = data[start : start + PIECE_BYTES], start + PIECE_BYTES
            encoded = base64.b64encode(piece).decode()
            self.obtain("put", name=name, digest=digest, data=encoded, last=end >= len(data))
            told(min(end, len(data)))

    def close(self, within_s: float = 5.0) -> None:
        """End the connection, and with it what was launched over it."""
        self.let_go()
        with contextlib.suppress(subprocess.TimeoutExpired):
            # One that has never answered does not hear that this is over either.
            self._process.wait(within_s if self.begun else 0.0)
        self._end(0.0)

    def let_go(self) -> None:
        """Let the host know that nothing more comes. It ends what was launched; `close` waits for that."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()

    def end_if_silent(self) -> bool:
        """End the connection to a host that should have said something by now; return whether it has done so."""
        patience_s = SILENT_S if self.begun else OPEN_S
        if self.lost or _NOW() - self._heard_s < patience_s:
            return False
        self._give_up(patience_s)
        return True

    def _give_up(self, within_s: float) -> None:
        said = self._said()
        self.close(0.0)
        self.lost = silent(self.host, within_s, said)

    def _said(self) -> str:
        """Return the end of what was said on standard error since the host began to answer."""
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
        self.lost = sentence_of(self.host, code, self._said())
        os.close(self._errors)
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            with contextlib.suppress(OSError):
                pipe.close()
