"""How a terminal reaches the agents of one fleet: as the person whose keys this user has, or without a name."""

from __future__ import annotations

import os
import secrets
from typing import TYPE_CHECKING, NamedTuple

from pancakes.errors import PancakesError
from pancakes.mesh.net.socket_transport import SocketTransport
from pancakes.mesh.security.key_folders import keys_of_person
from pancakes.runtime.clock import Clock
from pancakes.runtime.plugins import Plugins

if TYPE_CHECKING:
    from pancakes.mesh.security.keys import Keys


class FleetWay(NamedTuple):
    """How the agents of a fleet are reached.

    Attributes:
        name: the name of the terminal in that fleet.
        transport: how bytes travel.
        keys: those of this person; None: there are none.
    """

    name: str
    transport: SocketTransport
    keys: Keys | None = None

    @classmethod
    def to(cls, fleet: str, clock: Clock) -> FleetWay:
        """Makes the way to a fleet: with the keys of this person, where there are any, else in the clear.

        Raises:
            PancakesError: the keys cannot be used; the sentence says why.
        """
        folder = keys_of_person(fleet)
        if folder is None:
            name = f"cli-{os.getpid()}-{secrets.token_hex(3)}"
            return cls(name, SocketTransport(clock, name, Plugins(), insecure=True))
        from pancakes.mesh.security.keys import Keys  # and with it OpenSSL, which takes its time

        keys = Keys(folder)
        if fault := keys.fault_of(keys.own):
            raise PancakesError(f"your keys for the fleet {fleet} are of no use ({folder}): {fault}")
        name = f"{keys.own.name}.{secrets.token_hex(4)}"
        return cls(name, SocketTransport(clock, name, Plugins(), keys=keys), keys)
