"""What is sound in a configuration, and most likely not what was meant, as far as this machine can tell."""

from __future__ import annotations

from pancakes.errors import Fault
from pancakes.mesh.near_only import ADVICE, would_be_near_only
from pancakes.runtime.config.tables import Config


def doubts_of(config: Config) -> list[Fault]:
    """Returns sentences on a configuration that an agent of this machine would run, each with its place in the file.

    Names of hosts are looked up, which may take some seconds.
    """
    places = config.places
    return [
        places.fault(("agent", "listen"), f"{why}. {ADVICE.capitalize()}")
        for address in config.agent.listen
        if (why := would_be_near_only(address))
    ]
