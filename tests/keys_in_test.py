"""Keys of agents and of a person, where they look for them."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from unittest import mock

from pancakes.security.authority import Authority
from pancakes.security.roster import CertifiedRole


class KeysInTest:
    """Fleets, each founded when it is first asked for.

    Args:
        directory: where all keys lie.

    Attributes:
        environment: what processes need in order to find them.
    """

    def __init__(self, directory: Path) -> None:
        self._config = directory / "config"
        self._data = directory / "data"
        self._authorities: dict[str, Authority] = {}
        self.environment = {"XDG_CONFIG_HOME": str(self._config), "XDG_DATA_HOME": str(self._data)}

    def authority(self, fleet: str) -> Authority:
        """Returns the authority of a fleet, of which the person alice is an operator."""
        made = self._authorities.get(fleet)
        if made is None:
            folder = self._config / "pancakes" / "fleets" / fleet
            made = self._authorities[fleet] = Authority.founded(fleet, folder)
            made.enrol_with_key("operator", "alice").write(folder / "me")
        return made

    def offered(self) -> AbstractContextManager[Any]:
        """Lets clients in this process find them, until the end of the block."""
        return mock.patch.dict(os.environ, self.environment)

    def of_agent(self, fleet: str, name: str, role: CertifiedRole = "agent") -> Path:
        """Makes the keys of an agent, where it has none; returns their folder."""
        folder = self._data / "pancakes" / "keys" / fleet / name
        if not folder.exists():
            self.authority(fleet).enrol_with_key(role, name).write(folder)
        return folder
