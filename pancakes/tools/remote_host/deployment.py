"""Do a host's part of a deployment: store wheels, make environments of them, switch agents between versions.

wheels/DIGEST/FILE                   the wheels, kept as long as a version uses them
environments/NAME/                   a virtual environment with these wheels
agents/FLEET/NAME/versions/VERSION/  agent.toml, version.json, environment -> the environment that it runs in
agents/FLEET/NAME/current            -> the version in use
agents/FLEET/NAME/last               -> the version that was in use before
"""

from __future__ import annotations

import base64
import contextlib
import csv
import fcntl
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from pancakes.tools.remote_host.host_folders import (
    COMPLETE,
    HostError,
    agent_folder,
    data_folder,
    has_keys,
    write_whole,
)
from pancakes.tools.remote_host.service_managers import manager_of, tail_of

BUILD: Final = "pancakes-build"
"""The file of an environment that names its build of Pancakes and its plug-ins."""
PIP: Final = "pip-"
"""The beginning of the file name of pip's wheel. Pip runs from its wheel, so a host needs no pip."""
INSTALL: Final = (
    *("--no-index", "--no-deps", "--no-compile", "--no-input", "--no-cache-dir"),
    *("--quiet", "--disable-pip-version-check", "--isolated", "--no-warn-script-location"),
)
MOST_DAMAGED: Final = 5
"""At most this many damaged files are named."""
NO_ROOM: Final = "No space left on device"


class HostDeployment:
    """The requests of a deployment.

    Attributes:
        calls: the function for each request, by name.
    """

    def __init__(self) -> None:
        self._lock: int | None = None
        self.calls: Mapping[str, Callable[..., Any]] = {
            "lock": self.lock,
            "missing": missing,
            "damaged": damaged,
            "put": put,
            "libraries": make_libraries,
            "environment": make_environment,
            "version": write_version,
            "check": check,
            "switch": switch,
            "put_keys": put_keys,
            "clean": clean,
            "install_service": lambda fleet, name: manager_of(fleet, name).install(),
            "start_service": lambda fleet, name: manager_of(fleet, name).start(),
            "stop_service": lambda fleet, name: manager_of(fleet, name).stop(),
            "forget_service": lambda fleet, name: manager_of(fleet, name).forget(),
            "service": lambda fleet, name: manager_of(fleet, name).status(),
        }

    def lock(self, within: float = 0.0) -> None:
        """Lock this host against other deployments, as long as this program runs.

        Args:
            within: how long to wait for another deployment to end, in seconds.
        """
        until_s = time.monotonic() + within
        data_folder().mkdir(mode=0o700, parents=True, exist_ok=True)
        self._lock = os.open(data_folder() / "deployment.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        while True:
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:
                if time.monotonic() >= until_s:
                    raise HostError("is busy with another deployment: wait until it has ended") from None
                time.sleep(0.1)


def missing(wheels: Mapping[str, str]) -> list[str]:
    """Return the wheels that this host lacks, of wheels by name with their digests."""
    return [name for name, digest in wheels.items() if not _wheel(name, digest).exists()]


def damaged(folder: str, name: str) -> list[str]:
    """Return the first files of an environment, or of libraries, that differ from what was installed.

    Args:
        folder: `environments`, whose files are compared byte by byte, or `libraries`, whose file sizes are compared.
        name: the name of the environment or libraries.
    """
    place = data_folder() / folder / name
    found = []
    for record in sorted(
        (*place.glob("*.dist-info/RECORD"), *place.glob("lib/python*/site-packages/*.dist-info/RECORD"))
    ):
        site = record.parent.parent
        try:
            rows = list(csv.reader(record.read_text().splitlines()))
        except OSError:
            rows = []
        if not rows:
            found.append(str(record.relative_to(place)))
        for row in rows:
            path, digest, size = row if len(row) == 3 else (*row, "", "", "")[:3]
            if size and not path.startswith("..") and not _is_as_made(site / path, digest, int(size), folder):
                found.append(path)
        if len(found) >= MOST_DAMAGED:
            break
    return found[:MOST_DAMAGED]


def _is_as_made(path: Path, digest: str, size: int, folder: str) -> bool:
    try:
        if folder == "libraries":
            return path.stat().st_size == size
        kind, _, wanted = digest.partition("=")
        made = hashlib.new(kind, path.read_bytes()).digest()
        return base64.urlsafe_b64encode(made).rstrip(b"=").decode() == wanted
    except (OSError, ValueError):
        return False


def put(name: str, digest: str, data: str, last: bool) -> None:
    """Store a piece of a wheel, given in base64; the last piece completes it."""
    path = _wheel(name, digest)
    part = path.with_name(f".{name}.part")
    part.parent.mkdir(parents=True, exist_ok=True)
    with open(part, "ab") as file:
        file.write(base64.b64decode(data))
    if last:
        os.replace(part, path)


def make_libraries(name: str, wheels: Mapping[str, str]) -> bool:
    """Unpack the wheels that Pancakes and its plug-ins need; return False if they were already unpacked.

    Args:
        name: the name of the folder.
        wheels: the digest of each wheel, by file; they include pip, which installs the others.
    """
    place = data_folder() / "libraries" / name
    if (place / COMPLETE).exists():
        return False
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    others = [str(_wheel(it, digest)) for it, digest in wheels.items() if not it.startswith(PIP)]
    _run(
        [sys.executable, *_pip(wheels), "install", *INSTALL, "--target", str(place), *others],
        "cannot unpack the wheels",
    )
    write_whole(place / COMPLETE, b"")
    return True


def make_environment(name: str, libraries: str, wheels: Mapping[str, str], build: str) -> bool:
    """Make an environment of wheels on this host; return False if it existed already.

    Args:
        name: its name.
        libraries: the name of a folder made by `make_libraries`.
        wheels: the wheels of Pancakes and its plug-ins, and that of pip, as above.
        build: the build of Pancakes and its plug-ins.
    """
    place = data_folder() / "environments" / name
    if (place / COMPLETE).exists():
        return False
    shutil.rmtree(place, ignore_errors=True)
    _run([sys.executable, "-m", "venv", "--without-pip", str(place)], "cannot make an environment")
    python = str(place / "bin" / "python")
    (site,) = place.glob("lib/python*/site-packages")
    write_whole(site / "libraries.pth", f"{data_folder() / 'libraries' / libraries}\n".encode())
    own = [str(_wheel(it, digest)) for it, digest in wheels.items() if not it.startswith(PIP)]
    _run([python, *_pip(wheels), "install", *INSTALL, *own], "cannot install the wheels")
    _run([python, *_pip(wheels), "check", "--disable-pip-version-check"], "lacks what these wheels need")
    write_whole(place / BUILD, build.encode())
    write_whole(place / COMPLETE, b"")
    return True


def write_version(fleet: str, name: str, version: str, environment: str, config: str, about: dict[str, Any]) -> None:
    """Write a version of an agent beside the others, without using it yet.

    Args:
        fleet: the agent's fleet.
        name: its name.
        version: the name of the version.
        environment: the environment in which it runs.
        config: its configuration, as TOML.
        about: the content of `version.json`; its `wheels` and `libraries` are kept as long as the version.
    """
    place = agent_folder(fleet, name) / "versions" / version
    with contextlib.suppress(OSError):
        if (place / "agent.toml").read_bytes() == config.encode():
            return
    shutil.rmtree(place, ignore_errors=True)  # a version with another configuration, or without one
    made = place.with_name(f".{version}.new")
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir(mode=0o700, parents=True)
    write_whole(made / "agent.toml", config.encode())
    write_whole(made / "version.json", json.dumps(about).encode())
    (made / "environment").symlink_to(data_folder() / "environments" / environment)
    os.replace(made, place)


def check(fleet: str, name: str, version: str) -> dict[str, Any]:
    """Check the configuration of a version, in its environment.

    Returns:
        Whether it is valid (`sound`), and its errors or warnings (`said`).
    """
    place = agent_folder(fleet, name) / "versions" / version
    python = str(place / "environment" / "bin" / "python")
    command = [python, "-m", "pancakes.tools.cli.agent_command", "--check", "--config", str(place / "agent.toml")]
    checked = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    said = tail_of(checked.stderr).replace(f"{place}/", "") if checked.stderr.strip() else ""
    return {"sound": checked.returncode == 0, "said": said}


def put_keys(fleet: str, name: str, files: Mapping[str, str]) -> None:
    """Write the keys of an agent that has none here.

    Args:
        fleet: the agent's fleet.
        name: its name.
        files: the contents by file, in base64; the private key comes last, because its file means that all are there.
    """
    if has_keys(fleet, name):
        raise HostError(f"already has keys of {name}")
    folder = data_folder() / "keys" / fleet / name
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    folder.chmod(0o700)
    for file, data in files.items():
        made = folder / f".{file}.new"
        with open(os.open(made, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600), "wb") as written:
            written.write(base64.b64decode(data))
            written.flush()
            os.fsync(written.fileno())
        os.replace(made, folder / file)


def switch(fleet: str, name: str, version: str, last: str) -> None:
    """Set the version that an agent uses from its next start.

    Args:
        fleet: the agent's fleet.
        name: its name.
        version: the version; empty: none.
        last: the version that a rollback returns to; empty: none.
    """
    folder = agent_folder(fleet, name)
    for link, wanted in ((folder / "last", last), (folder / "current", version)):
        if wanted:
            _link(link, f"versions/{wanted}")
        else:
            link.unlink(missing_ok=True)


def clean() -> None:
    """Remove all versions except the current and the last ones, and everything that only removed versions used."""
    used: set[Path] = set()
    wheels: set[str] = set()
    libraries: set[str] = set()
    for folder in _folders(data_folder() / "agents", "*/*"):
        links = [folder / "current", folder / "last"] if (folder / "current").is_symlink() else []
        kept = {os.path.realpath(link) for link in links}
        for version in _folders(folder / "versions", "*"):
            if str(version.resolve()) not in kept:
                shutil.rmtree(version, ignore_errors=True)
                continue
            used.add((version / "environment").resolve())
            with contextlib.suppress(OSError, ValueError):
                about = json.loads((version / "version.json").read_text())
                wheels |= set(about["wheels"].values())
                libraries.add(about["libraries"])
        if not kept:
            shutil.rmtree(folder, ignore_errors=True)
    for environment in _folders(data_folder() / "environments", "*"):
        if environment.resolve() not in used:
            shutil.rmtree(environment, ignore_errors=True)
    for unpacked in _folders(data_folder() / "libraries", "*"):
        if unpacked.name not in libraries:
            shutil.rmtree(unpacked, ignore_errors=True)
    for wheel in _folders(data_folder() / "wheels", "*"):
        if wheel.name not in wheels:
            shutil.rmtree(wheel, ignore_errors=True)
    for empty in (*_folders(data_folder() / "agents", "*"), *_folders(data_folder(), "*")):
        with contextlib.suppress(OSError):
            empty.rmdir()


def _folders(place: Path, pattern: str) -> Sequence[Path]:
    return [it for it in sorted(place.glob(pattern)) if it.is_dir() and not it.is_symlink()]


def _wheel(name: str, digest: str) -> Path:
    return data_folder() / "wheels" / digest / name


def _pip(wheels: Mapping[str, str]) -> list[str]:
    """Return the arguments that make Python run pip from its wheel."""
    return [str(next(_wheel(it, digest) for it, digest in wheels.items() if it.startswith(PIP)) / "pip")]


def _link(link: Path, target: str) -> None:
    """Set a link atomically."""
    made = link.with_name(f".{link.name}.new")
    made.unlink(missing_ok=True)
    made.symlink_to(target)
    os.replace(made, link)


def _run(command: Sequence[str], fault: str) -> None:
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL, env=environment)
    if done.returncode:
        output = done.stderr or done.stdout
        if NO_ROOM in output:
            raise HostError(f"has no room left on its disk ({data_folder()}): make room there")
        raise HostError(f"{fault}: {tail_of(output)}")
