"""Processes whose clocks are other than those of the machine."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest

NAME = "libfaketime.so.1"
FETCH_S = 60.0


def monotonic_ahead(by_s: int) -> Sequence[str]:
    """Returns what stands before a command whose monotonic clock is ahead: it runs in a time namespace of its own.

    Skips the test where this user may make none.
    """
    command = ("unshare", "--time", "--monotonic", str(by_s))
    try:
        tried = subprocess.run([*command, "true"], capture_output=True, text=True)
    except FileNotFoundError:
        pytest.skip("unshare (util-linux) is not installed here, so that no time namespace can be made")
    if tried.returncode:
        pytest.skip(f"no time namespace can be made here: {tried.stderr.strip()} (it needs root)")
    return command


def day_ahead(by: str, directory: Path) -> dict[str, str]:
    """Returns the environment of a process whose time of day is another, such as by `-365d`, and no other clock.

    The library of libfaketime is taken where it is installed. Else its Debian package is fetched into the directory and
    unpacked there, which changes nothing on this machine. Skips the test where that cannot be done.
    """
    found = [*Path("/usr/lib").glob(f"*/faketime/{NAME}"), *Path("/usr/local/lib").glob(f"**/{NAME}")]
    if not found:
        found = _fetched(directory)
    never = {"DONT_FAKE_MONOTONIC": "1", "FAKETIME_DONT_FAKE_MONOTONIC": "1"}
    return {"LD_PRELOAD": str(found[0]), "FAKETIME": by, **never}


def _fetched(directory: Path) -> list[Path]:
    advice = "apt-get install faketime"
    try:
        command = ["apt-get", "download", "-q", "libfaketime"]
        ended = subprocess.run(command, cwd=directory, capture_output=True, text=True, timeout=FETCH_S)
        packages = sorted(directory.glob("libfaketime_*.deb"))
        if ended.returncode or not packages:
            pytest.skip(
                f"libfaketime is not installed, and cannot be fetched: {ended.stderr.strip()[-200:]} ({advice})"
            )
        subprocess.run(["dpkg-deb", "-x", packages[0].name, "."], cwd=directory, check=True, timeout=FETCH_S)
    except (FileNotFoundError, subprocess.TimeoutExpired) as error:
        pytest.skip(f"libfaketime is not installed, and cannot be fetched: {error} ({advice})")
    return sorted(directory.glob(f"usr/lib/*/faketime/{NAME}"))
