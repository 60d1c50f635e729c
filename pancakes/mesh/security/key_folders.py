"""Where keys are: an agent's and a person's, each in a folder of its own by its fleet.

No configuration names a key: the fleet and the name of an agent say which it has.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Final

from pancakes.mesh.security.key_files import KEY, ROSTER, number_of
from pancakes.runtime.foundation.user_folders import NoHome, user_folder

_OF_SERVICES: Final = Path("/etc/pancakes/keys")


def folder_of_agent(fleet: str, name: str) -> Path:
    """Returns where the keys of an agent belong, for this user.

    Raises:
        NoHome: nothing says where.
    """
    base = user_folder("XDG_DATA_HOME", ".local/share", f"the key of {name}")
    return base / "pancakes" / "keys" / fleet / name


def keys_of_agent(fleet: str, name: str) -> Path | None:
    """Returns the folder with the keys of an agent, of this user or else of the machine; None where it has none."""
    places = [_OF_SERVICES / fleet / name]
    with suppress(NoHome):  # then this user has none
        places.insert(0, folder_of_agent(fleet, name))
    return next((it for it in places if os.path.lexists(it / KEY)), None)


def fleets() -> Path:
    """Returns the directory of this person's fleets: own keys, and the authorities of those that were founded here.

    Raises:
        NoHome: nothing says where it is.
    """
    return user_folder("XDG_CONFIG_HOME", ".config", "what this person has of fleets") / "pancakes" / "fleets"


def folder_of_person(fleet: str) -> Path:
    """Returns where this person's own keys for a fleet belong.

    Raises:
        NoHome: nothing says where.
    """
    return fleets() / fleet / "me"


def keys_of_person(fleet: str) -> Path | None:
    """Returns the folder with this person's own keys for a fleet; None where there are none."""
    try:
        own = folder_of_person(fleet)
    except NoHome:
        return None
    return own if os.path.lexists(own / KEY) else None


def fleets_of_person() -> list[str]:
    """Returns the fleets for which this person has keys, by name."""
    try:
        return sorted(it.name for it in fleets().iterdir() if keys_of_person(it.name))
    except (OSError, NoHome):
        return []


def rosters_here() -> dict[str, int]:
    """Returns the number of the last roster that this person's folders have of each fleet."""
    try:
        folders = sorted(it for it in fleets().iterdir() if it.is_dir())
    except (OSError, NoHome):
        return {}
    return {it.name: max(number_of(it / ROSTER), number_of(it / "me" / ROSTER)) for it in folders}
