"""What `pancakes doctor` looks at in what peers have left on an agent."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from pancakes.tools.cli.verbs.finding import Finding

IN_DOUBT: Final = "in doubt"
NEAR: Final = 0.9
"""A peer that takes such a share of its room is named before the agent refuses it."""
_STORIES: Final = {
    IN_DOUBT: "tasks that {peer} has brought and not handed over",
    "taken back": "marks of tasks that {peer} has brought and taken back",
    "guarded": "tasks of {peer} as a guardian",
    "removed": "marks of guarded tasks of {peer} that were removed",
}


def check_kept(agent: dict[str, Any]) -> Iterator[Finding]:
    """Looks for peers that are at a bound, and for what those have left that are away.

    Args:
        agent: what an agent says of itself.
    """
    name = agent["agent"]
    for row in agent.get("kept_of_peers", ()):
        peer, kind = row["peer"], row["kind"]
        away = kind == IN_DOUBT and peer not in agent["neighbours"]
        if row["share"] < NEAR and not away:
            continue
        story = _STORIES[kind].format(peer=peer)
        text = f"keeps {row['count']} {story} ({row['bytes'] / 2**20:.1f} MiB), {row['share']:.0%} of the room for them"
        if away:
            text += f", and {peer} is away"
        yield Finding("warning", name, text, _advice(name, peer, kind))


def _advice(name: str, peer: str, kind: str) -> str:
    if kind == IN_DOUBT:
        return f"start {peer}; if it is gone for good: pancakes task forget-peer {name} {peer} --dry-run"
    return f"see whether {peer} makes up tasks, and revoke it then: pancakes fleet revoke {peer} WHY"
