"""What a launcher changes of its agents' files, as `pancakes-agent --set` takes it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pancakes.errors import ConfigError, Fault
from pancakes.runtime.config.toml_text import key_text, leaves, value_text
from pancakes.runtime.foundation.suggestion import suggestion


def overrides(table: Mapping[str, Any]) -> Iterator[str]:
    """Yields `table.key=value` for each value in nested tables, so that keys beside it stay as the file has them."""
    for keys, value in leaves(table) if table else ():
        yield f"{key_text(keys)}={value_text(value)}"


def whose(change: str, agents: Sequence[str]) -> tuple[Sequence[str], str]:
    """Returns the agents that a change from the command line concerns, and what is left of it for them.

    Args:
        change: `AGENT:table.key=value`, or `table.key=value` for all agents.
        agents: the names of all agents.

    Raises:
        ConfigError: it names an agent that is none of these.
    """
    keys, equals, value = change.partition("=")
    agent, colon, rest = keys.partition(":")
    if not colon:
        return agents, change
    if agent not in agents:
        near = suggestion(agent, agents)
        raise ConfigError([Fault(f"--set {change}", agent, f"is none of the agents {', '.join(agents)}", near)])
    return (agent,), f"{rest}{equals}{value}"
