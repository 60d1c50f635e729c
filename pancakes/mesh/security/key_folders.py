"""Where keys are: an agent's and a person's, each in a folder of its own by its fleet.

No configuration names a key: the fleet and the name of an agent say which it has.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from pancakes.mesh.security.key_files import KEY, ROSTER, number_of

_OF_SERVICES: Final = Path("/etc/pancakes/keys")


def folder_of_agent(fleet: str, name: str) -> Path:
    """Returns where the keys of an agent belong, for this user."""
    base = os.environ.get("XDG_DATA_HOME")
    return (Path(base) if base else Path.home() / ".local" / "share") / "pancakes" / "keys" / fleet / name


def keys_of_agent(fleet: str, name: str) -> Path | None:
    """Returns the folder with the keys of an agent, of this user or else of the machine; None where it has none."""
    places = (folder_of_agent(fleet, name), _OF_SERVICES / fleet / name)
    return next((it for it in places if os.path.lexists(it / KEY)), None)


def fleets() -> Path:
    """Returns the directory of this person's fleets: own keys, and the authorities of those that were founded here."""
    base = os.environ.get("XDG_CONFIG_HOME")
    return (Path(base) if base else Path.home() / ".config") / "pancakes" / "fleets"


def folder_of_person(fleet: str) -> Path:
    """Returns where this person's own keys for a fleet belong."""
    return fleets() / fleet / "me"


def keys_of_person(fleet: str) -> Path | None:
    """Returns the folder with this person's own keys for a fleet; None where there are none."""
    own = folder_of_person(fleet)
    return own if os.path.lexists(own / KEY) else None


def fleets_of_person() -> list[str]:
    """Returns the fleets for which this person has keys, by name."""
    try:
        return sorted(it.name for it in fleets().iterdir() if keys_of_person(it.name))
    except OSError:
        return []


def rosters_here() -> dict[str, int]:
    """Returns the number of the last roster that this person's folders have of each fleet."""
    try:
        folders = sorted(it for it in fleets().iterdir() if it.is_dir())
    except OSError:
        return {}
    return {it.name: max(number_of(it / ROSTER), number_of(it / "me" / ROSTER)) for it in folders}
