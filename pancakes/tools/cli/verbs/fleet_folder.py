"""The folder of a fleet that was founded here, and how its agents hear of what is signed there."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from pancakes.errors import PancakesError, needing_extra
from pancakes.mesh.security import key_folders
from pancakes.tools.cli.output import show_text

if TYPE_CHECKING:
    from pancakes.client import Client
    from pancakes.mesh.security.fleet_office import FleetOffice

TOLD_S: Final = 5.0
"""So long a command waits for agents to hear of a roster."""
LOOK_S: Final = 0.2


def founded(name: str) -> Path:
    """Returns the folder of a fleet that was founded here.

    Raises:
        PancakesError: there is none of this name, or none, or several.
    """
    from pancakes.mesh.security.register import REGISTER

    base = key_folders.fleets()
    here = sorted(it.parent.name for it in base.glob(f"*/{REGISTER}"))
    if name and name in here:
        return base / name
    if name or not here:
        which = f"the fleet {name} was not" if name else "no fleet was"
        raise PancakesError(f"{which} founded here ({base}): pancakes fleet init {name or 'NAME'}")
    if len(here) > 1:
        raise PancakesError(f"several fleets were founded here: say which with --fleet ({', '.join(here)})")
    return base / here[0]


def opened(name: str) -> FleetOffice:
    """Opens the folder of a fleet that was founded here, and asks for its password where it has one.

    Raises:
        PancakesError: there is none, or the password does not fit.
    """
    folder = founded(name)
    with needing_extra("no certificate can be given out"):
        from pancakes.mesh.security.authority import is_locked
        from pancakes.mesh.security.fleet_office import FleetOffice
    password = click.prompt(f"Password of the fleet {folder.name}", hide_input=True) if is_locked(folder) else None
    return FleetOffice.opened(folder, password.encode() if password else None)


def spread(office: FleetOffice, addresses: Sequence[str]) -> None:
    """Tells agents of the last roster, and says which know it now."""
    from pancakes.client import Client, Where
    from pancakes.mesh.security.roster import read_signed

    number = read_signed((office.folder / "roster.json").read_bytes())[1].number
    if key_folders.keys_of_person(office.fleet) is None:
        show_text(f"You have no keys of the fleet {office.fleet}, so no agent can be told from here.", err=True)
        return
    try:
        with Client(Where.of(Where(tuple(addresses), office.fleet)), TOLD_S) as client:
            know = _told(client, number)
    except PancakesError as error:
        show_text(f"No agent has heard of the roster {number} yet: {error}", err=True)
        if not addresses:
            show_text("Agents elsewhere hear of it with: pancakes fleet sign --tell HOST:PORT", err=True)
        return
    show_text(f"The roster {number} is known to {', '.join(know) or 'no agent yet'}.")


def _told(client: Client, number: int) -> list[str]:
    """Waits until all agents know a roster, which this terminal gives to them; returns those that do."""
    until_s = client.now() + TOLD_S
    while True:
        found = client.survey().agents
        if later := [agent for agent in found if (agent["roster"] or 0) > number]:
            raise PancakesError(
                f"{later[0]['agent']} knows the roster {later[0]['roster']} already, and takes none with a lower"
                " number: this folder is an old copy (docs/security.md, Backup)"
            )
        know = [agent["agent"] for agent in found if agent["roster"] == number]
        if len(know) == len(found) or client.now() > until_s:
            return know
        time.sleep(LOOK_S)
