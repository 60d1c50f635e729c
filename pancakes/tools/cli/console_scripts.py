"""The entry points of the programs. It is imported first, so that an early SIGINT is handled quietly."""

from __future__ import annotations

from pancakes.tools.cli import quiet_interrupt  # noqa: F401 - a SIGINT ends the program quietly


def pancakes() -> None:
    """The console script `pancakes`."""
    from pancakes.tools.cli.main import main

    main()


def agent() -> None:
    """The console script `pancakes-agent`."""
    from pancakes.tools.cli.agent_command import agent
    from pancakes.tools.cli.standard_files import fill_standard_files

    fill_standard_files()
    agent()
