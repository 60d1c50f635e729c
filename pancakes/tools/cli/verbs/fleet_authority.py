"""The folder of a fleet that was founded here, and how its agents get what is signed there."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from pancakes.errors import PancakesError, needing_extra
from pancakes.security import key_store
from pancakes.tools.cli.output import Printer, show_text

if TYPE_CHECKING:
    from pancakes.client import Client
    from pancakes.security.authority import Authority


TOLD_S: Final = 15.0
"""A command waits at most this long for agents to hear of a roster; a small computer takes seconds to check one."""
LOOK_S: Final = 0.2


def founded(name: str) -> Path:
    """Return the folder of a fleet that was founded here.

    Raises:
        PancakesError: there is none of this name, or none, or several.
    """
    from pancakes.security.key_store import REGISTER

    base = key_store.fleets()
    here = sorted(it.parent.name for it in base.glob(f"*/{REGISTER}"))
    if name and name in here:
        return base / name
    if name or not here:
        which = f"the fleet {name} was not" if name else "no fleet was"
        raise PancakesError(f"{which} founded here ({base}): pancakes fleet init {name or 'NAME'}")
    if len(here) > 1:
        raise PancakesError(f"several fleets were founded here: say which with --fleet ({', '.join(here)})")
    return base / here[0]


def opened(name: str) -> Authority:
    """Open the folder of a fleet that was founded here, and ask for its password if it has one.

    Raises:
        PancakesError: there is none, or the password does not fit.
    """
    folder = founded(name)
    with needing_extra("no certificate can be given out"):
        from pancakes.security.authority import Authority, is_locked
    password = click.prompt(f"Password of the fleet {folder.name}", hide_input=True) if is_locked(folder) else None
    return Authority(folder, password.encode() if password else None)


def spread(authority: Authority, addresses: Sequence[str], printer: Printer, must_be_heard: bool = False) -> None:
    """Tell agents of the last roster, and say which know it now.

    Args:
        authority: the fleet.
        addresses: where to find agents; none: on this machine.
        must_be_heard: whether it is an error if no agent runs that could hear of it.
        printer: prints it; with JSON on standard output, this goes to standard error.

    Raises:
        PancakesError: an agent does not go by it, or none could be told; the sentences say why.
    """
    from pancakes.client import Client, Where
    from pancakes.security.roster import read_signed

    number = read_signed((authority.folder / "roster.json").read_bytes())[1].number
    try:
        if key_store.keys_of_person(authority.fleet) is None:
            raise PancakesError(f"you have no keys of the fleet {authority.fleet}, so no agent can be told from here")
        with Client(Where.of(Where(tuple(addresses), authority.fleet)), TOLD_S) as client:
            know, problems, silent = _told(client, number)
        if not know and not problems:
            raise PancakesError("\n".join(silent) or "no agent that answers has keys of the fleet")
    except PancakesError as error:
        sentence = f"no agent has heard of the roster {number} yet: {error}"
        if not addresses:
            sentence += "\nAgents elsewhere hear of it with: pancakes fleet sign --tell HOST:PORT"
        if must_be_heard or addresses or _runs_here(authority.fleet):
            raise PancakesError(sentence) from None
        show_text(sentence, err=True)
        return
    printer.note(f"The roster {number} is known to {', '.join(know) or 'no agent yet'}.")
    for sentence in silent:
        show_text(f"{sentence}. It hears of the roster when it is linked again", err=True)
    if problems:
        raise PancakesError("\n".join(problems))


def _runs_here(fleet: str) -> bool:
    """Return whether an agent of a fleet runs on this machine, so that it should have heard."""
    from pancakes.util.runtime_dir import entries

    return any(it.fleet == fleet and it.role != "client" for it in entries())


def _told(client: Client, number: int) -> tuple[list[str], list[str], list[str]]:
    """Wait until all agents know a roster, which this terminal gives to them.

    Returns:
        Those that go by it, a sentence for each that does not or cannot keep it, and one for each that did not answer
        although it is a member.
    """
    until_s = client.now() + TOLD_S
    while True:
        survey = client.survey()
        found = [agent for agent in survey.agents if agent["roster"] is not None]  # the others have no keys
        if later := [agent for agent in found if agent["roster"] > number]:
            raise PancakesError(
                f"{later[0]['agent']} knows the roster {later[0]['roster']} already, and takes none with a lower"
                " number: this folder is an old copy (docs/security.md, Backup)"
            )
        know = [agent["agent"] for agent in found if agent["roster"] == number]
        waiting = [agent for agent in found if agent["roster"] != number and not _fault(agent, 0, number)]
        if not waiting or client.now() > until_s:
            silent = [sentence for sentence in survey.silent if "certificate was revoked" not in sentence]
            return know, [problem for agent in found if (problem := _problem(agent, number))], silent
        time.sleep(LOOK_S)


def _fault(agent: dict[str, Any], *numbers: int) -> str:
    """Return what an agent says of a roster that it does not take or keep; empty: nothing of these numbers."""
    told = agent.get("roster_fault")
    return str(told["text"]) if told is not None and told["number"] in numbers else ""


def _problem(agent: dict[str, Any], number: int) -> str:
    name = agent["agent"]
    if agent["roster"] == number:
        fault = _fault(agent, number)
        return f"{name} goes by the roster {number} until it ends, and would forget it: {fault}" if fault else ""
    why = (
        _fault(agent, 0, number)
        or f"it does not say why within {TOLD_S:g} s (pancakes log --from {name} --level warning)"
    )
    return f"{name} does not go by the roster {number}: {why}"
