"""`pancakes` in the process of the test, for commands that need no signal, no terminal and no own process."""

from __future__ import annotations

from click.testing import CliRunner, Result

from pancakes.tools.cli.main import pancakes


def invoked(*arguments: str, typed: str = "") -> Result:
    """Run a command to its end; `typed` is its standard input."""
    return CliRunner().invoke(pancakes, arguments, input=typed)
