"""Ask a person for a password."""

from __future__ import annotations

import os
import sys

import click

from pancakes.errors import PancakesError


def ask_password(question: str, again: bool = False) -> str:
    """Ask for a password on the terminal, without showing it. Without a terminal, read a line of standard input.

    Args:
        question: what it is the password of.
        again: whether it must be typed twice; a second line of standard input, if there is one, must be the same.

    Raises:
        PancakesError: there is no terminal, and standard input has no password, or two that differ.
    """
    if _has_terminal():
        return str(click.prompt(question, hide_input=True, confirmation_prompt=again, err=True))
    line = sys.stdin.readline().rstrip("\r\n")
    if not line:
        raise PancakesError(f"{question}: there is no terminal to ask on. Give it as a line of standard input")
    if again and sys.stdin.readline().rstrip("\r\n") not in ("", line):
        raise PancakesError(f"{question}: the two lines of standard input differ. Give the same password twice")
    return line


def _has_terminal() -> bool:
    """Return whether a password can be typed: at the terminal of the session, or at standard input."""
    try:
        os.close(os.open("/dev/tty", os.O_RDWR | os.O_NOCTTY))
    except OSError:
        return sys.stdin.isatty()
    return True
