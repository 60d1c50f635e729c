"""`pancakes completion`: the script with which a shell completes what is typed after `pancakes`."""

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
    """Print the script that completes verbs, options and the names of agents, tasks, services and channels.

    The names come from the agents that run, at that moment; with --at HOST:PORT before the name, from those there.

    \b
    For the shell that is open, bash or zsh or fish:
        eval "$(pancakes completion bash)"
        eval "$(pancakes completion zsh)"
        pancakes completion fish | source

    \b
    For all shells from now on:
        bash  pancakes completion bash > ~/.local/share/bash-completion/completions/pancakes
              (which needs the package bash-completion; else put the line above into ~/.bashrc)
        zsh   the line above in ~/.zshrc, after compinit
        fish  pancakes completion fish > ~/.config/fish/completions/pancakes.fish

    \b
    Example:
        eval "$(pancakes completion bash)"
    """
    made = get_completion_class(shell)
    assert made is not None
    script = made(click.get_current_context().find_root().command, {}, PROGRAM, VARIABLE).source().rstrip()
    printer.emit([{"shell": shell, "script": script}], script)


class WordsOfBash(BashComplete):
    """Bash breaks a word at each colon and equals sign (`--at 127.0.0.1:7401`); this puts them together again."""

    def get_completion_args(self) -> tuple[list[str], str]:
        """See `click.shell_completion.ShellComplete`."""
        pieces = split_arg_string(os.environ["COMP_WORDS"])
        before = int(os.environ["COMP_CWORD"])
        # A word that is not begun yet is not among the pieces.
        pieces = pieces[: before + 1] if before < len(pieces) else [*pieces[:before], ""]
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
    """Answer a shell that asks, by the environment, how the line may go on. Exits."""
    add_completion_class(WordsOfBash)
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # a warning would stand between the words
            pancakes(prog_name=PROGRAM, complete_var=VARIABLE)
    except Exception:  # no error of ours may disturb a user who types
        if os.environ.get(TRACEBACK):
            raise
        sys.exit(REFUSED)
