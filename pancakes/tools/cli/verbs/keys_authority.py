"""Find and open the folder of a fleet that was founded here, and pass its signed roster to agents."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pancakes.errors import PancakesError, needing_extra
from pancakes.security import key_store
from pancakes.tools.cli.output import Printer, show_text
from pancakes.tools.cli.password_prompt import ask_password

if TYPE_CHECKING:
    from pancakes.client import Client
    from pancakes.security.authority import Authority


LOOK_S: Final = 0.2


def founded(name: str) -> Path:
    """Return the folder of a fleet that was founded here.

    Raises:
        PancakesError: no fleet of this name was founded here; or, without a name, none or several were.
    """
    from pancakes.security.key_store import REGISTER

    base = key_store.fleets()
    here = sorted(it.parent.name for it in base.glob(f"*/{REGISTER}"))
    if name and name in here:
        return base / name
    if name or not here:
        which = f"the fleet {name} was not" if name else "no fleet was"
        raise PancakesError(f"{which} founded here ({base}). To found it: pancakes keys init {name or 'NAME'}")
    if len(here) > 1:
        raise PancakesError(f"several fleets were founded here: choose one with --fleet ({', '.join(here)})")
    return base / here[0]


def opened(name: str) -> Authority:
    """Open the folder of a fleet that was founded here, and ask for its password if it has one.

    Raises:
        PancakesError: the folder does not exist, or the password is wrong.
    """
    folder = founded(name)
    with needing_extra("no certificate can be given out"):
        from pancakes.security.authority import Authority, is_locked
    password = ask_password(f"Password of the fleet {folder.name}") if is_locked(folder) else None
    return Authority(folder, password.encode() if password else None)


def spread(
    authority: Authority, addresses: Sequence[str], timeout_s: float, printer: Printer, must_be_heard: bool = False
) -> None:
    """Pass the newest roster to agents, and print which of them have it now.

    Args:
        authority: the fleet.
        addresses: where to find agents; empty: on this machine.
        timeout_s: how long agents may take to apply it.
        must_be_heard: whether it is an error if no agent runs that could take it.
        printer: prints the result, to standard error if standard output is JSON.

    Raises:
        PancakesError: an agent does not apply the roster, or none could be reached; the sentences say why.
    """
    from pancakes.client import Client, Target
    from pancakes.security.roster import read_signed

    number = read_signed((authority.folder / "roster.json").read_bytes())[1].number
    try:
        if key_store.keys_of_person(authority.fleet) is None:
            raise PancakesError(f"you have no keys of the fleet {authority.fleet}, so you cannot reach its agents")
        with Client(Target.of(Target(tuple(addresses), authority.fleet)), timeout_s) as client:
            have_it, problems, silent = _wait_for_roster(client, number, timeout_s)
        if not have_it and not problems:
            raise PancakesError("\n".join(silent) or "no agent that answers has keys of the fleet")
    except PancakesError as error:
        sentence = f"no agent has the roster {number} yet: {error}"
        if not addresses:
            sentence += "\nTo pass it to agents elsewhere: pancakes keys sign --at HOST:PORT"
        if must_be_heard or addresses or _runs_here(authority.fleet):
            raise PancakesError(sentence) from None
        show_text(sentence, err=True)
        return
    printer.note(f"The roster {number} is known to {', '.join(have_it) or 'no agent yet'}.")
    for sentence in silent:
        show_text(f"{sentence}. It gets the roster when it is linked again", err=True)
    if problems:
        raise PancakesError("\n".join(problems))


def _runs_here(fleet: str) -> bool:
    """Return whether an agent of a fleet runs on this machine, which should then have the roster."""
    from pancakes.util.runtime_dir import entries

    return any(it.fleet == fleet and it.role != "client" for it in entries())


def _wait_for_roster(client: Client, number: int, timeout_s: float) -> tuple[list[str], list[str], list[str]]:
    """Wait, at most `timeout_s`, until all agents have a roster, which this terminal passes to them.

    Returns:
        The agents that have it, a sentence for each that does not apply it or cannot store it, and one for each member
        that did not answer.
    """
    until_s = client.now() + timeout_s
    while True:
        survey = client.describe()
        found = [agent for agent in survey.agents if agent["roster"] is not None]  # an agent without keys has no roster
        if later := [agent for agent in found if agent["roster"] > number]:
            raise PancakesError(
                f"{later[0]['agent']} has the roster {later[0]['roster']} already, and refuses lower numbers: this"
                " folder is an old copy (docs/security.md, Backup)"
            )
        have_it = [agent["agent"] for agent in found if agent["roster"] == number]
        waiting = [agent for agent in found if agent["roster"] != number and not _fault(agent, 0, number)]
        if not waiting or client.now() > until_s:
            silent = [sentence for sentence in survey.silent if "certificate was revoked" not in sentence]
            return have_it, [problem for agent in found if (problem := _problem(agent, number, timeout_s))], silent
        time.sleep(LOOK_S)


def _fault(agent: dict[str, Any], *numbers: int) -> str:
    """Return why an agent does not apply or store a roster of one of these numbers; empty: no such fault."""
    fault = agent.get("roster_fault")
    return str(fault["text"]) if fault is not None and fault["number"] in numbers else ""


def _problem(agent: dict[str, Any], number: int, timeout_s: float) -> str:
    name = agent["agent"]
    if agent["roster"] == number:
        fault = _fault(agent, number)
        return (
            f"{name} applies the roster {number}, but cannot store it and loses it when it ends: {fault}"
            if fault
            else ""
        )
    why = (
        _fault(agent, 0, number)
        or f"it gave no reason within {timeout_s:g} s (see pancakes log --from {name} --level warning)"
    )
    return f"{name} does not apply the roster {number}: {why}"
