"""Where an agent keeps what must outlive its process."""

from __future__ import annotations

import os
from pathlib import Path

from pancakes.runtime.config import Config


def default_state_dir(fleet: str, name: str) -> Path:
    """Returns the state directory of an agent whose configuration does not name one.

    A service of the system has the one that systemd made for it (`StateDirectory=`).
    """
    of_service = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if of_service:
        return Path(of_service)
    base = os.environ.get("XDG_STATE_HOME") or str(Path.home() / ".local" / "state")
    return Path(base) / "pancakes" / fleet / name


def state_dir_of(config: Config) -> Path | None:
    """Returns the state directory of an agent; None where its role has none.

    A world or a terminal owns no task that could move, so nothing of it has to outlive the process.
    """
    agent = config.agent
    if agent.role != "agent":
        return None
    return Path(agent.state_dir) if agent.state_dir else default_state_dir(agent.fleet, agent.name)
