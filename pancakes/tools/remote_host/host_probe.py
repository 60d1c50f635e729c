"""Probe a host before anything is done there: user, Python, platform, disk, running and deployed agents. Read-only."""

from __future__ import annotations

import getpass
import hashlib
import json
import os
import platform
import shutil
import sys
import sysconfig
from pathlib import Path
from typing import Any

from pancakes.tools.remote_host.host_folders import (
    COMPLETE,
    agent_folder,
    current_python,
    data_folder,
    has_keys,
    interpreter_for,
    running,
    socket_of,
)
from pancakes.tools.remote_host.service_managers import manager_of, runs_systemd


def probe_host(fleet_of: dict[str, str]) -> dict[str, Any]:
    """Return the facts about this host, and about some agents on it.

    Args:
        fleet_of: the fleet of each agent that will run here, by agent.
    """
    return {
        "user": _user(),
        "python": list(sys.version_info[:3]),
        "executable": sys.executable,
        "platform": sysconfig.get_platform(),
        "libc": list(platform.libc_ver()),
        "free_bytes": shutil.disk_usage(_existing(data_folder())).free,
        "data": str(data_folder()),
        "systemd": runs_systemd(),
        "environments": _complete("environments"),
        "libraries": _complete("libraries"),
        "running": running(),
        "agents": {name: _look_at(fleet, name) for name, fleet in fleet_of.items()},
    }


def _complete(folder: str) -> list[str]:
    return sorted(it.parent.name for it in data_folder().glob(f"{folder}/*/{COMPLETE}"))


def _look_at(fleet: str, name: str) -> dict[str, Any]:
    folder = agent_folder(fleet, name)
    current = folder / "current"
    return {
        "keys": has_keys(fleet, name),
        "python": interpreter_for(fleet, name),
        "socket": socket_of(fleet, name),
        "version": _version_at(current),
        "last": _version_at(folder / "last"),
        "config": _digest_at(current / "agent.toml"),
        "environment": _version_at(current / "environment"),
        "versions": {it.parent.name: _digest_at(it) for it in sorted(folder.glob("versions/*/agent.toml"))},
        "about": _about(current / "version.json"),
        "service": manager_of(fleet, name).status() if current_python(fleet, name).exists() else None,
    }


def _version_at(link: Path) -> str:
    return os.path.basename(os.readlink(link)) if link.is_symlink() else ""


def _digest_at(path: Path) -> str:
    """Return the digest of a file; empty if it cannot be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""


def _about(path: Path) -> dict[str, Any]:
    try:
        found: dict[str, Any] = json.loads(path.read_text())
        return found
    except (OSError, ValueError):
        return {}


def _existing(path: Path) -> Path:
    while not path.exists():
        path = path.parent
    return path


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())
