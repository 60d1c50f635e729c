"""`pancakes` within the process of the test: for what needs no signal, no terminal and no process of its own."""

from __future__ import annotations

from click.testing import CliRunner, Result

from pancakes.tools.cli.main import pancakes


def invoked(*arguments: str, typed: str = "") -> Result:
    """Runs a command to its end; `typed` is its standard input."""
    return CliRunner().invoke(pancakes, arguments, input=typed)
