"""What a deployment changes of one agent: pure, from what is wanted and what its host says."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pancakes.runtime.config.override import apply_set
from pancakes.runtime.config.toml_source import tables_of, text_of
from pancakes.runtime.config.toml_text import document_text
from pancakes.tools.launch.member import Member


@dataclass(frozen=True)
class AgentChange:
    """One agent, as it is and as it is to be.

    Attributes:
        name, fleet, host: which it is, and where.
        version: the version that it is to have.
        environment: the environment of that.
        config: the configuration of that, as TOML.
        was: the version that it has; empty: none.
        last: the one that it had before that; empty: none.
        ran: whether it runs, kept so by a manager.
    """

    name: str
    fleet: str
    host: str
    version: str
    environment: str
    config: str
    was: str
    last: str
    ran: bool

    @property
    def what(self) -> str:
        """What is done: `nothing`, `start`, `switch`, or `new`."""
        if self.was == self.version:
            return "nothing" if self.ran else "start"
        return "switch" if self.was else "new"


def change_of(member: Member, told: Mapping[str, Any], build: str, environment: str) -> AgentChange:
    """Returns what is to be changed of an agent.

    Args:
        member: the agent.
        told: what its host says of it (`pancakes.tools.there.looking`).
        build: the build of Pancakes and its plug-ins that it is to have.
        environment: the environment that it is to run in.
    """
    config = effective_config(member.path, member.sets)
    digest = hashlib.sha256(f"{environment}\n{config}".encode()).hexdigest()[:12]
    service = told["service"]
    return AgentChange(
        member.name,
        member.config.agent.fleet,
        member.host,
        f"{build.partition('-')[0]}-{digest}",
        environment,
        config,
        told["version"],
        told["last"],
        service is not None and service["state"] in ("active", "starting"),
    )


def effective_config(path: Path, sets: tuple[str, ...]) -> str:
    """Returns an agent's file as TOML, with what a fleet file and the command line change of it.

    Raises:
        ConfigError: it cannot be read.
    """
    tables, places = tables_of(text_of(str(path)), str(path))
    if not sets:
        return text_of(str(path))
    for change in sets:
        apply_set(change, tables, places)
    return document_text(tables)
