"""The user's own OpenSSH: the commands that reach a host, and what its errors mean."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import pancakes.tools.there as there

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
    "own_supervisor",
    "service_managers",
    "looking",
    "launched_agents",
    "deploying",
    "serving",
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
    """Returns why a text is none that `ssh` could be given as a host, as a phrase; empty: it is one."""
    return "" if _HOST.fullmatch(host) else "is no host: write it as pi@robot1, or as a name of ~/.ssh/config"


def ssh_command(host: str, *options: str) -> list[str]:
    """Returns the beginning of a command that reaches a host."""
    return [*shlex.split(os.environ.get(VARIABLE) or "ssh"), *OPTIONS, *options, host]


def start_ssh(command: Sequence[str], output: int, errors: int) -> subprocess.Popen[bytes]:
    """Starts a command of `ssh`. It ends with this program, however that ends: also one to a host that says nothing.

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
    """Starts a Python on a host, which runs the line that is sent to it (`source`).

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
    """Returns the source of what runs on a host, as one line of Python.

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
        f"sys.modules[{package + '.serving'!r}].main({marker!r})\n"
    )
    return f"exec({program!r})\n".encode()


def silent(host: str, within_s: float, said: str) -> str:
    """Returns a sentence about a host that lets `ssh` in, or takes its connection, and says nothing.

    Args:
        host: the host.
        within_s: for how long.
        said: what `ssh`, and the shell over there, said on standard error.
    """
    last = next((line.strip() for line in reversed(said.splitlines()) if line.strip()), "")
    advice = f"see what `ssh {host} true` does, and what its shell runs at a login (~/.bashrc)"
    return f"{host} does not answer within {within_s:g} s{f' ({last})' if last else ''}: {advice}"


def sentence_of(host: str, code: int, said: str) -> str:
    """Returns what the end of a connection means, and what to do, as a sentence.

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
    """Returns a sentence to say where there is no `ssh` on this machine."""
    command = shlex.split(os.environ.get(VARIABLE) or "ssh")[0]
    why = (error.strerror or str(error)).lower()
    return f"{command} cannot be run ({why}): apt install openssh-client, or set {VARIABLE} to the command to use"


def scratch_file() -> int:
    """Returns an open file without a name."""
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def _shown(lines: Sequence[str], part: str) -> str:
    return next(line for line in lines if part in line.lower())
