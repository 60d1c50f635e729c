"""The options that all verbs share which speak to agents, and how those speak."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

_F = TypeVar("_F", bound=Callable[..., Any])


class AgentAddress(click.ParamType):
    """`HOST:PORT` or `tcp://HOST:PORT`."""

    name = "address"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        from pancakes.config.address import parse_address

        text = str(value)
        if "://" not in text:
            text = f"tcp://{text}"
        try:
            if parse_address(text).port == 0:
                self.fail(f"{value!r} has the port 0, at which nobody can be reached", param, ctx)
        except ValueError as error:
            self.fail(str(error), param, ctx)
        return text


def asks_agents(function: _F) -> _F:
    """Gives a verb the options `--at`, `--timeout` and `--format`; its parameters are `at`, `timeout`, `format_`."""
    options = (
        click.option(
            "--format",
            "format_",
            type=click.Choice(["table", "json"]),
            default="table",
            show_default=True,
            help="How to print the answer.",
        ),
        click.option(
            "--at",
            metavar="HOST:PORT",
            type=AgentAddress(),
            multiple=True,
            help="Ask the agent at this address and its fleet, instead of those of this machine. Repeatable.",
        ),
        click.option(
            "--timeout",
            metavar="SECONDS",
            type=click.FloatRange(min=0.0, min_open=True, max=3600.0),
            default=3.0,
            show_default=True,
            help="How long to wait for answers.",
        ),
    )
    for option in reversed(options):
        function = option(function)
    return function
