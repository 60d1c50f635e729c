"""Environments: one as users of Pancakes have it, and one for each thing that a user might take instead.

They come from the same package index as everything else and go below `.venv`; what is there and fits is not installed
again. A peer that is in no package index is looked for in the system's own Python.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import msgspec

ROOT = Path(__file__).resolve().parents[2]
PLACE = ROOT / ".venv" / "peers"
USERS = ROOT / ".venv" / "users"
METADATA = ("setup.cfg", "pyproject.toml", "README.md", "LICENSE")
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
RCLPY = Peer(
    "rclpy",
    SCRIPTS / "over_rclpy.py",
    ("rclpy", "std_msgs.msg", "geometry_msgs.msg", "msgpack"),
    (*(f"ros-kilted-{it}" for it in ("rclpy", "rmw-fastrtps-cpp", "std-msgs", "geometry-msgs")), "msgpack>=1"),
)
PYSPY = Peer("py-spy", SCRIPTS, ("pip",), ("py-spy>=0.4",))
"""No peer, but what profiles are taken with; it has no module."""
MANGO = Peer("mango", SCRIPTS / "over_mango.py", ("mango", "msgpack"), ("mango-agents>=2.1", "msgpack>=1"))


def python_of(peer: Peer) -> Path:
    """Returns a Python that has a peer, and makes its environment if need be.

    Raises:
        PeerMissing: there is none, and it could not be made.
    """
    if not peer.requirements:
        return _system_python(peer)
    place = PLACE / peer.name
    with _held(place):
        if _made_for(place) != (wanted := _digest(*peer.requirements)):
            _make(place, peer.name, peer.requirements, wanted)
    python = place / "bin" / "python"
    fault = _fault(python, peer)
    if fault:
        raise PeerMissing(f"{peer.name} was installed in {place}, but {fault}")
    return python


def python_of_users() -> Path:
    """Returns the Python of an environment with Pancakes as users install it: no plug-ins, and nothing to test with.

    Raises:
        PeerMissing: it could not be made.
    """
    installed = (
        USERS / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages" / "pancakes"
    )
    with _held(USERS):
        metadata = [(ROOT / name).read_text() for name in METADATA]
        if _made_for(USERS) != (wanted := _digest(*metadata)):
            with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name:
                for file in METADATA:  # of a copy: an installation leaves its traces
                    shutil.copy(ROOT / file, name)
                shutil.copytree(ROOT / "pancakes", Path(name) / "pancakes", ignore=_NO_CACHE)
                _make(USERS, "users", [f"{name}[keys]"], wanted)
        if _contents(installed) != _contents(ROOT / "pancakes"):
            shutil.rmtree(installed)
            shutil.copytree(ROOT / "pancakes", installed, ignore=_NO_CACHE)
            _run("Pancakes", [str(USERS / "bin" / "python"), "-m", "compileall", "-q", str(installed)])
    return USERS / "bin" / "python"


_NO_CACHE = shutil.ignore_patterns("__pycache__")


def _contents(package: Path) -> dict[str, bytes]:
    return {str(path.relative_to(package)): path.read_bytes() for path in package.rglob("*.py")}


@contextmanager
def _held(place: Path) -> Iterator[None]:
    """Keeps an environment from others: two benchmarks may be started at once."""
    place.parent.mkdir(parents=True, exist_ok=True)
    with open(place.with_name(f"{place.name}.lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _made_for(place: Path) -> str:
    made_for = place / "made-for"
    return made_for.read_text() if made_for.is_file() and os.access(place / "bin" / "python", os.X_OK) else ""


def _make(place: Path, name: str, requirements: Sequence[str], wanted: str) -> None:
    print(f"making an environment for {name} ...", file=sys.stderr, flush=True)
    shutil.rmtree(place, ignore_errors=True)
    _run(name, [sys.executable, "-m", "venv", str(place)])
    pip = [
        str(place / "bin" / "python"),
        "-m",
        "pip",
        "install",
        "--quiet",
        "--disable-pip-version-check",
        "--no-input",
    ]
    _run(name, [*pip, *requirements])
    (place / "made-for").write_text(wanted)


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


def _digest(*texts: str) -> str:
    return hashlib.sha256("\n".join((sys.version, sys.base_prefix, *texts)).encode()).hexdigest()


def _fault(python: Path, peer: Peer) -> str:
    """Returns why a Python cannot import what a peer needs; empty where it can."""
    command = [str(python), "-c", f"import {', '.join(peer.modules)}"]
    done = subprocess.run(command, env=environment(), stdin=subprocess.DEVNULL, capture_output=True, text=True)
    return done.stderr.strip().rpartition("\n")[2] if done.returncode else ""


def _run(name: str, command: list[str]) -> None:
    done = subprocess.run(command, env=environment(), stdin=subprocess.DEVNULL, stdout=sys.stderr)
    if done.returncode:
        raise PeerMissing(f"{name} could not be installed: `{' '.join(command)}` ended with {done.returncode}")
