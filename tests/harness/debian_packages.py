"""Programs of Debian that tests use: a machine of its own gets them, elsewhere a test without them is skipped."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

PLACES = os.pathsep.join((os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"))
"""Where programs are looked for: daemons lie where the path of a user does not lead."""
INSTALL = ("apt-get", "install", "-y", "-qq", "--no-install-recommends")


def need(program: str, package: str) -> str:
    """Returns the path of a program, whose package is installed first where this machine may do that.

    Workers of one test run that need it at the same time wait for the first of them. A package that could not be
    installed is not asked for again on this machine until it is started again.

    Args:
        program: the program's name, such as `mosquitto`.
        package: the package of Debian that has it.
    """
    if (found := shutil.which(program, path=PLACES)) is not None:
        return found
    if not may_install():
        pytest.skip(f"there is no {program} here: apt install {package}")
    folder = Path(tempfile.gettempdir())
    with open(folder / f"pancakes-tests-apt-{os.getuid()}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        failed = folder / f"pancakes-tests-no-{package}-{boot()}"
        if shutil.which(program, path=PLACES) is None and not failed.exists():
            if not installs(package):
                failed.touch()
    found = shutil.which(program, path=PLACES)
    return found or pytest.skip(f"there is no {program} here, and apt-get could not install {package}")


def may_install() -> bool:
    """Whether packages of the system may be installed without a question: by root, where no person looks on."""
    return os.geteuid() == 0 and bool(os.environ.get("CI")) and shutil.which("apt-get") is not None


def installs(package: str) -> bool:
    """Installs a package, with the lists of packages renewed where it is not found, and returns whether it did."""
    if apt(*INSTALL, package):
        return True
    apt("apt-get", "update", "-qq")  # the lists may be old, or not there yet
    return apt(*INSTALL, package)


def apt(*command: str) -> bool:
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, env=environment)
    return done.returncode == 0


def boot() -> str:
    """Returns what tells one run of the machine from the next."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return "unknown"
