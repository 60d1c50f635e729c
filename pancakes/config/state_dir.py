"""Where an agent keeps its state: `state_dir` of its configuration, systemd's, or the user's XDG folder."""

from __future__ import annotations

import os
from pathlib import Path

from pancakes.config import Config
from pancakes.util.files import at_home, user_folder


def default_state_dir(fleet: str, name: str) -> Path:
    """Return the state directory of an agent whose configuration does not name one.

    A system service has the one that systemd made for it (`StateDirectory=`).

    Raises:
        NoHome: it is not known where it would be.
    """
    of_service = os.environ.get("STATE_DIRECTORY", "").partition(":")[0]
    if of_service:
        return Path(of_service)
    base = user_folder("XDG_STATE_HOME", ".local/state", f"the state of {name}", "state_dir in [agent]")
    return base / "pancakes" / fleet / name


def state_dir_of(config: Config) -> Path | None:
    """Return the state directory of an agent; None if its role has none.

    A world or a terminal owns no task that could migrate, so it keeps nothing on disk.

    Raises:
        NoHome: it is not known where it would be.
    """
    agent = config.agent
    if agent.role != "agent":
        return None
    return Path(at_home(agent.state_dir)) if agent.state_dir else default_state_dir(agent.fleet, agent.name)
