"""Two releases of ROS 2, each in a virtual environment of its own outside the project.

They are made once and kept in the cache of this user. `pip` brings a real ROS 2: rcl, Fast DDS and generated messages.
The environment's Python runs itself anew with a changed `LD_LIBRARY_PATH`, which must not reach that of the other.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import subprocess
import sys
from configparser import ConfigParser
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pancakes-tests" / "ros2"
AGENTS = "kilted"
"""The release that agents run with."""
ROBOTS = "jazzy"
"""The release of the robots that they drive."""
WHEELS = (
    "rclpy",
    "rmw-fastrtps-cpp",
    "geometry-msgs",
    "sensor-msgs",
    "nav-msgs",
    "std-msgs",
    "lifecycle-msgs",
    "action-msgs",
    "test-msgs",
)
DEMO = ("cryptography>=43", "matplotlib>=3.8")
"""What a demo needs too, which runs there."""
MAKING_S = 900


def requirements() -> list[str]:
    """Returns what Pancakes requires; it is itself found in this clone."""
    options = ConfigParser()
    options.read(ROOT / "setup.cfg", encoding="utf-8")
    return [line for line in options["options"]["install_requires"].split("\n") if line.strip()]


def python_of(release: str) -> Path:
    """Returns the Python of an environment with a release of ROS 2, which is made where it is not there.

    The test is skipped where it cannot be made.
    """
    wanted = [*(f"ros-{release}-{wheel}" for wheel in WHEELS), *requirements()]
    if release == AGENTS:
        wanted += DEMO
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    key = hashlib.sha256("\n".join([version, *wanted]).encode()).hexdigest()[:12]
    place = CACHE / f"{release}-{key}"
    CACHE.mkdir(parents=True, exist_ok=True)
    with (CACHE / f"{release}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (place / "made").exists():
            _make(place, wanted, release)
    return place / "bin" / "python"


def _make(place: Path, wanted: list[str], release: str) -> None:
    python = str(place / "bin" / "python")
    quiet = ["--quiet", "--disable-pip-version-check", "--no-input"]
    for command in (
        [sys.executable, "-m", "venv", "--clear", str(place)],
        [python, "-m", "pip", "install", *quiet, *wanted],
    ):
        try:
            made = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=MAKING_S)
        except subprocess.TimeoutExpired:
            pytest.skip(f"an environment with ROS 2 {release} cannot be made within {MAKING_S} s")
        if made.returncode:
            said = made.stderr.strip().splitlines() or ["it said nothing"]
            pytest.skip(f"there is no ROS 2 {release} for this Python here: {said[-1]}")
    (place / "made").touch()


def environment(domain: int = 0) -> dict[str, str]:
    """Returns the environment of a process that runs in one of them.

    Args:
        domain: the DDS domain: processes of different ones do not hear each other.
    """
    left_out = ("LD_LIBRARY_PATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE", "PYTHONPATH", "AMENT_PREFIX_PATH", "VIRTUAL_ENV")
    kept = {key: value for key, value in os.environ.items() if key not in left_out}
    found = [
        ROOT,
        Path(__file__).with_name("installed"),
        *(path.parent for path in sorted(ROOT.glob("plugins/*/setup.cfg"))),
    ]
    return {
        **kept,
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "PYTHONPATH": os.pathsep.join(map(str, found)),
        "PYTHONWARNINGS": "ignore",
        "RCUTILS_LOGGING_USE_STDOUT": "0",
    }
