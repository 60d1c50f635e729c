"""One rule for all verbs: what loses something asks on a terminal, and elsewhere it needs --force."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from pancakes.errors import ControlRefused

if TYPE_CHECKING:
    from pancakes.client import Client
    from pancakes.control import Reply

force_option = click.option("--force", is_flag=True, help="Do it without asking. Needed if this is no terminal.")
"""The option `--force` of verbs that lose something; its parameter is `force`."""


def must_be_meant(meaning: str, force: bool, dry_run: bool = False) -> None:
    """Goes on only if a person means it: with `--force`, or after they were asked on the terminal.

    Args:
        meaning: what is lost, as a sentence without its full stop.
        force: whether `--force` was given.
        dry_run: whether nothing is done anyway.

    Raises:
        ControlRefused: they do not, or nobody can be asked.
    """
    if force or dry_run:
        return
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise ControlRefused(f"{meaning}. With --force it is done, with --dry-run only shown. Nothing was done")
    if not click.confirm(f"{meaning}. Do it?", err=True):
        raise ControlRefused("nothing was done")


def accepted_if_meant(
    client: Client, agent: str, body: Callable[[bool, bool], Any], force: bool, dry_run: bool
) -> Reply:
    """Has an agent do what it refuses without force; its refusal, which says what that would mean, is the question.

    Args:
        client: asks the agent.
        agent: the agent.
        body: makes the control packet's body, given whether it is forced and whether it is a dry run.
        force: whether `--force` was given.
        dry_run: whether `--dry-run` was given.

    Raises:
        ControlRefused: the agent refuses it in any case, or it is not meant.
        Unreachable: the agent does not answer.
    """
    from pancakes.tools.cli.asking import accepted  # only now: many a verb that asks needs no client

    if force or dry_run or not (sys.stdin.isatty() and sys.stderr.isatty()):
        return accepted(client, agent, body(force, dry_run))
    accepted(client, agent, body(True, True))
    unforced = client.request(agent, body(False, False))
    if unforced.ok:
        return unforced
    must_be_meant(unforced.reason.removesuffix(". Nothing was done"), force)
    return accepted(client, agent, body(True, False))
