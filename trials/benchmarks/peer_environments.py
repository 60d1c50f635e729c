"""Environments for what a user might take instead of Pancakes, each a virtual environment of its own.

They come from the same package index as everything else and go into `.venv/peers`; what is there and fits is not
installed again. A peer that is in no package index is looked for in the system's own Python.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import msgspec

ROOT = Path(__file__).resolve().parents[2]
PLACE = ROOT / ".venv" / "peers"
SCRIPTS = Path(__file__).resolve().parent / "peers"


class PeerMissing(Exception):
    """A peer is not here and cannot be got; the sentence says why, and what to do."""


class Peer(msgspec.Struct, frozen=True):
    """Something that a user might take instead.

    Attributes:
        name: what people call it.
        script: the program that runs as each of its processes.
        modules: what must be there to import.
        requirements: what is installed for it; empty where that is nothing that a package index has.
        hint: where nothing can be installed: how to get it.
    """

    name: str
    script: Path
    modules: tuple[str, ...]
    requirements: tuple[str, ...] = ()
    hint: str = ""


PYZMQ = Peer("pyzmq", SCRIPTS / "over_pyzmq.py", ("zmq", "msgpack"), ("pyzmq>=26", "msgpack>=1"))
ZENOH = Peer("zenoh", SCRIPTS / "over_zenoh.py", ("zenoh", "msgpack"), ("eclipse-zenoh>=1.1", "msgpack>=1"))
ROSPY = Peer(
    "rospy",
    SCRIPTS / "over_rospy.py",
    ("rospy", "rosmaster.master", "std_msgs.msg", "msgpack"),
    hint="it is in no package index; Debian has it: `apt install python3-rospy python3-rosmaster python3-msgpack`",
)


def python_of(peer: Peer) -> Path:
    """Returns a Python that has a peer, and makes its environment if need be.

    Raises:
        PeerMissing: there is none, and it could not be made.
    """
    if not peer.requirements:
        return _system_python(peer)
    place = PLACE / peer.name
    python, made_for = place / "bin" / "python", place / "made-for"
    PLACE.mkdir(parents=True, exist_ok=True)
    with open(PLACE / f"{peer.name}.lock", "w") as lock:  # two may be started at once
        fcntl.flock(lock, fcntl.LOCK_EX)
        wanted = _digest(peer)
        if not (made_for.is_file() and made_for.read_text() == wanted and os.access(python, os.X_OK)):
            print(f"making an environment for {peer.name} ...", file=sys.stderr, flush=True)
            shutil.rmtree(place, ignore_errors=True)
            _run(peer, [sys.executable, "-m", "venv", str(place)])
            pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-input"]
            _run(peer, [*pip, *peer.requirements])
            made_for.write_text(wanted)
    fault = _fault(python, peer)
    if fault:
        raise PeerMissing(f"{peer.name} was installed in {place}, but {fault}")
    return python


def environment() -> dict[str, str]:
    """Returns the variables of a peer's process: those of this one that say nothing about its Python."""
    return {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}


def _system_python(peer: Peer) -> Path:
    found = shutil.which("python3", path=os.defpath)
    if found is None:
        raise PeerMissing(f"{peer.name} needs the system's own Python, and there is none: {peer.hint}")
    fault = _fault(Path(found), peer)
    if fault:
        raise PeerMissing(f"{found}: {fault}; {peer.hint}")
    return Path(found)


def _digest(peer: Peer) -> str:
    made_for = f"{sys.version} {sys.base_prefix} {' '.join(peer.requirements)}"
    return hashlib.sha256(made_for.encode()).hexdigest()


def _fault(python: Path, peer: Peer) -> str:
    """Returns why a Python cannot import what a peer needs; empty where it can."""
    command = [str(python), "-c", f"import {', '.join(peer.modules)}"]
    done = subprocess.run(command, env=environment(), stdin=subprocess.DEVNULL, capture_output=True, text=True)
    return done.stderr.strip().rpartition("\n")[2] if done.returncode else ""


def _run(peer: Peer, command: list[str]) -> None:
    done = subprocess.run(command, env=environment(), stdin=subprocess.DEVNULL, stdout=sys.stderr)
    if done.returncode:
        raise PeerMissing(f"{peer.name} could not be installed: `{' '.join(command)}` ended with {done.returncode}")
