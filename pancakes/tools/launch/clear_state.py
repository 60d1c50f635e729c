"""Clear the state directories of agents before a launch (`--fresh`).

All agents of the fleet must be stopped: a task may have migrated to one that still runs, and would then run twice.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from pancakes.client import Client, Target
from pancakes.config import Config
from pancakes.config.state_dir import state_dir_of
from pancakes.errors import PancakesError, UnreachableError
from pancakes.journal import empty
from pancakes.util.runtime_dir import entries

ASK_S: Final = 2.0
"""How long peers have to answer, in seconds."""


def check_alone(configs: Iterable[Config]) -> None:
    """Check that no other agent of these fleets runs, as far as this machine can see.

    A task may have migrated there. With its state cleared, its former agent would start it a second time.

    Args:
        configs: the configurations of the agents whose state will be cleared; none of them runs yet.

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
                f"{name} of the fleet {fleet} runs outside this launch ({where}), and tasks may have migrated there:"
                f" with empty state they would run twice. Stop it first: pancakes down {name}"
                for (fleet, name), where in sorted(others.items())
            )
        )


def saved_state(config: Config) -> Path | None:
    """Return the state directory of an agent; None if it contains nothing, or the agent has none."""
    directory = state_dir_of(config)
    if directory is None or not directory.is_dir() or not any(directory.iterdir()):
        return None
    return directory.absolute()


def empty_state(config: Config) -> Path | None:
    """Empty the state directory of an agent that does not run.

    Returns:
        The state directory; None if it was empty, or the agent has none.

    Raises:
        JournalError: the directory is in use, or cannot be changed.
    """
    directory = state_dir_of(config)
    return directory.absolute() if directory is not None and empty(directory) else None


def _at(fleet: str, addresses: Sequence[str]) -> list[tuple[str, str]]:
    """Return name and address of the agents of a fleet that answer at `addresses`, and of the peers that they know."""
    if not addresses:
        return []
    try:
        with Client(Target(tuple(addresses), fleet), ASK_S) as client:
            found = client.describe()
    except UnreachableError:
        return []
    return [(it["agent"], it["listen"][-1]) for it in found.agents if it["role"] == "agent"]
