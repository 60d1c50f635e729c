"""Find the files of Pancakes on a host, for the user of this session."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shutil
import signal
import time
from pathlib import Path
from typing import Any

COMPLETE = "complete"
"""The file that is written last into an environment: without it, the environment is incomplete."""


class HostError(Exception):
    """A request failed. The text is a clause about the host, such as `has no room left`."""


def prepare_environment() -> None:
    """Set the folder and the variables of a login, because an SSH session may lack them."""
    with contextlib.suppress(HostError, OSError):  # without a home folder, stay in the present one
        os.chdir(home())
    own = f"/run/user/{os.getuid()}"
    if "XDG_RUNTIME_DIR" not in os.environ and os.path.isdir(own):
        os.environ["XDG_RUNTIME_DIR"] = own


def home() -> Path:
    """Return the home directory of the user."""
    try:
        return Path.home()
    except RuntimeError:
        raise HostError(f"has no home folder for the user {os.getuid()}: set HOME there") from None


def data_folder() -> Path:
    """Return the folder of deployed files."""
    base = os.environ.get("XDG_DATA_HOME")
    return (Path(base) if base else home() / ".local" / "share") / "pancakes"


def agent_folder(fleet: str, name: str) -> Path:
    """Return the folder with the versions of an agent."""
    return data_folder() / "agents" / fleet / name


def current_python(fleet: str, name: str) -> Path:
    """Return the path of the interpreter of an agent's current version, whether it exists or not."""
    return agent_folder(fleet, name) / "current" / "environment" / "bin" / "python"


def has_keys(fleet: str, name: str) -> bool:
    """Return whether an agent has keys of its own on this host."""
    places = (data_folder() / "keys", Path("/etc/pancakes/keys"))
    return any(os.path.lexists(place / fleet / name / "key.pem") for place in places)


def runtime_folder() -> Path:
    """Return the directory in which running agents are registered."""
    named, base = os.environ.get("PANCAKES_RUNTIME_DIR"), os.environ.get("XDG_RUNTIME_DIR")
    if named:
        return Path(named)
    return Path(base) / "pancakes" if base and os.path.isdir(base) else Path(f"/tmp/pancakes-{os.getuid()}")


def socket_of(fleet: str, name: str) -> str:
    """Return the path of the socket at which an agent listens for local connections."""
    folder = runtime_folder() / "local"
    return str(folder / f"{name}.sock" if fleet == "default" else folder / fleet / f"{name}.sock")


def running() -> list[dict[str, Any]]:
    """Return the register entries of the running agents."""
    found = []
    with contextlib.suppress(OSError):
        for path in sorted(runtime_folder().glob("*.json")):
            with contextlib.suppress(OSError, ValueError), open(path, "rb") as file:
                if is_locked(file.fileno()):
                    found.append(json.loads(file.read(65_536)))
    return found


def end_process(fleet: str, name: str, within: float) -> bool:
    """Stop the process of an agent, and wait at most `within` seconds; return whether it has ended.

    Raises:
        HostError: it is the process of another user.
    """

    def pid() -> int:
        return next((it["pid"] for it in running() if (it["fleet"], it["name"]) == (fleet, name)), 0)

    if found := pid():
        try:
            os.kill(found, signal.SIGTERM)
        except ProcessLookupError:
            return True
        except PermissionError:
            raise HostError(f"runs {name} as another user (process {found})") from None
    until_s = time.monotonic() + within
    while pid() and time.monotonic() < until_s:
        time.sleep(0.05)
    return not pid()


def is_locked(handle: int) -> bool:
    """Return whether another process has locked a file."""
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    fcntl.flock(handle, fcntl.LOCK_UN)
    return False


def interpreter_for(fleet: str, name: str) -> str:
    """Return a Python with Pancakes: of the agent's version, of another agent, or on the PATH; empty if none exists."""
    own = current_python(fleet, name)
    if own.exists():
        return str(own)
    others = sorted((data_folder() / "agents").glob("*/*/current/environment/bin/python"))
    if others:
        return str(others[0])
    program = shutil.which("pancakes-agent", path=f"{os.environ.get('PATH', '')}:{home() / '.local' / 'bin'}")
    if program is None:
        return ""
    with contextlib.suppress(OSError), open(program, "rb") as file:
        found = re.match(rb"#!(\S+python\S*)\s", file.readline(512))
        if found is not None:
            return os.fsdecode(found[1])
    return ""


def write_whole(path: Path, data: bytes) -> None:
    """Write a file atomically: after a crash it has either the new content or the old."""
    temporary = path.with_name(f".{path.name}.new")
    with open(temporary, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
