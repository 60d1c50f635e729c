"""What the verbs that only look have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import click

from pancakes.cli.client import Client


def survey(at: Sequence[str], timeout_s: float, agent: str = "") -> list[dict[str, Any]]:
    """Returns what the agents (or only `agent`) say of themselves; names on standard error who said nothing.

    Raises:
        PancakesError: nobody answers, ...
    """
    with Client(at, timeout_s) as client:
        found = client.survey(agent)
    for sentence in found.silent:
        click.echo(sentence, err=True)
    return found.agents
