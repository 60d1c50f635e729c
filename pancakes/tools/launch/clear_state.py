"""Clear the state of agents before a launch (`--fresh`): what they remember of their tasks is removed.

Every agent of the fleet must be stopped: a task may have migrated to one that still runs, and would run twice.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from pancakes.client import Client, Where
from pancakes.config import Config
from pancakes.config.state_dir import state_dir_of
from pancakes.errors import PancakesError, Unreachable
from pancakes.journal import empty
from pancakes.util.runtime_dir import entries

ASK_S: Final = 2.0
"""How long the peers of a fleet have to name themselves."""


def check_alone(configs: Iterable[Config]) -> None:
    """See to it that no other agent of a fleet runs, as far as can be seen from here.

    A task may have moved there. Its agent of old would start it a second time, once that has forgotten it.

    Args:
        configs: the configurations of the agents that are to begin from empty state; none of them runs yet.

    Raises:
        PancakesError: another agent of their fleets runs on this machine, or answers at the address of a peer.
    """
    agents = [config.agent for config in configs]
    fleets = {agent.fleet for agent in agents}
    others = {
        (entry.fleet, entry.name): f"process {entry.pid}"
        for entry in entries()
        if entry.fleet in fleets and entry.role == "agent"
    }
    own = {address for agent in agents for address in agent.addresses}
    for fleet in fleets:
        peers = [peer for agent in agents if agent.fleet == fleet for peer in agent.peers if peer not in own]
        for name, address in _at(fleet, peers):
            others.setdefault((fleet, name), address)
    if others:
        raise PancakesError(
            "\n".join(
                f"{name} of the fleet {fleet} runs outside this launch ({where}), and may have tasks that moved there:"
                f" begun from empty state, they would run twice. Stop it first: pancakes down {name}"
                for (fleet, name), where in sorted(others.items())
            )
        )


def remembers(config: Config) -> bool:
    """Return whether an agent has something in its state directory."""
    directory = state_dir_of(config)
    return directory is not None and directory.is_dir() and any(directory.iterdir())


def empty_state(config: Config) -> Path | None:
    """Remove what an agent that does not run remembers.

    Returns:
        Its state directory; None if there was nothing in it, or it has none.

    Raises:
        JournalError: the directory is in use, or cannot be changed.
    """
    directory = state_dir_of(config)
    return directory.absolute() if directory is not None and empty(directory) else None


def _at(fleet: str, addresses: Sequence[str]) -> list[tuple[str, str]]:
    """Return name and address of the agents of a fleet that answer at addresses, and of those that these know."""
    if not addresses:
        return []
    try:
        with Client(Where(tuple(addresses), fleet), ASK_S) as client:
            found = client.survey()
    except Unreachable:
        return []
    return [(it["agent"], it["listen"][-1]) for it in found.agents if it["role"] == "agent"]
