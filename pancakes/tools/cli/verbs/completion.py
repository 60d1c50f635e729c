"""`pancakes completion`: print the script with which a shell completes the arguments of `pancakes`."""

from __future__ import annotations

import contextlib
import io
import os
import sys

import click
from click.shell_completion import BashComplete, add_completion_class, get_completion_class, split_arg_string

from pancakes.tools.cli.exit_codes import REFUSED, TRACEBACK
from pancakes.tools.cli.options import format_option
from pancakes.tools.cli.output import Printer
from pancakes.tools.cli.version import PROGRAM, VARIABLE


@click.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@format_option
def completion(shell: str, printer: Printer) -> None:
    """Print a script that completes verbs, options and the names of agents, tasks, services and channels.

    The names come from the agents that run on this machine, or with --at HOST:PORT before the name, from those there.

    \b
    For the present shell, bash or zsh or fish:
        eval "$(pancakes completion bash)"
        eval "$(pancakes completion zsh)"
        pancakes completion fish | source

    \b
    For all shells from now on:
        bash  pancakes completion bash > ~/.local/share/bash-completion/completions/pancakes
              (needs the package bash-completion; without it, put the line above into ~/.bashrc)
        zsh   the line above in ~/.zshrc, after compinit
        fish  pancakes completion fish > ~/.config/fish/completions/pancakes.fish

    \b
    Example:
        eval "$(pancakes completion bash)"
    """
    completion_class = get_completion_class(shell)
    assert completion_class is not None
    script = completion_class(click.get_current_context().find_root().command, {}, PROGRAM, VARIABLE).source().rstrip()
    printer.emit([{"shell": shell, "script": script}], script)


class WordsOfBash(BashComplete):
    """Join the words that bash splits at each colon and equals sign (`--at 127.0.0.1:7401`)."""

    def get_completion_args(self) -> tuple[list[str], str]:
        """See `click.shell_completion.ShellComplete`."""
        pieces = split_arg_string(os.environ["COMP_WORDS"])
        index = int(os.environ["COMP_CWORD"])
        # The pieces lack the word to complete if it is still empty.
        pieces = pieces[: index + 1] if index < len(pieces) else [*pieces[:index], ""]
        words: list[str] = []
        joined = False
        for piece in pieces[1:]:
            joins = piece[:1] in (":", "=") and set(piece) <= {":", "="}
            if words and (joins or joined):
                words[-1] += piece
            else:
                words.append(piece)
            joined = joins
        return words[:-1], words[-1] if words else ""


def answer_shell(pancakes: click.Command) -> None:
    """Answer a shell that asks for completions by environment variables, and exit."""
    add_completion_class(WordsOfBash)
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # a warning would mix with the completions
            pancakes(prog_name=PROGRAM, complete_var=VARIABLE)
    except Exception:  # an error must not print into the line that the user types
        if os.environ.get(TRACEBACK):
            raise
        sys.exit(REFUSED)
