"""Networks for two real agents: a TCP proxy between them, or two network namespaces with a wire."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from torture.live import LiveFleet, free_ports
from torture.namespaces import Namespaces
from torture.proxy import Proxy

PORT = 7401  # in a namespace, all ports are free


class Cuttable(Protocol):
    """The link between two agents, which can be cut.

    Attributes:
        cut: set once the link has been cut.
    """

    cut: threading.Event

    def cut_at(self, word: str) -> None:
        """Cut the link when the next packet of this type is on its way; neither it nor anything after it arrives."""
        ...

    def heal(self) -> None:
        """Restore the link."""
        ...


@dataclass
class Ground:
    """Two agents' addresses.

    Attributes:
        names: the names of the agents; the first one dials the other.
        listen: where each listens.
        dialled: the address at which the first one dials the other.
        link: the link that can be cut; None: they are connected directly.
        commands: the prefix of the command of each.
        tells_losses: whether data on their way are lost for good when the link is cut, as by a reset of a connection;
            otherwise TCP sends them again after the cut, unless the connection has been closed by then.
        close: removes the network.
    """

    names: tuple[str, str]
    listen: Mapping[str, str]
    dialled: str
    link: Cuttable | None
    commands: Mapping[str, Sequence[str]]
    tells_losses: bool
    close: Callable[[], None]

    def fleet(self, directory: Path, rest: Mapping[str, str]) -> LiveFleet:
        """Return the two agents, not started yet; `rest` is the part after `[agent]` of each configuration."""
        peers = {self.names[0]: [self.dialled], self.names[1]: []}
        return LiveFleet(directory, self.names, rest, self.listen, peers, self.commands)


Survey = Callable[[tuple[str, str]], Ground]
"""Makes the network for two agents of these names."""


def on_loopback(names: tuple[str, str]) -> Ground:
    """Connect them directly."""
    listen = _loopback(names)
    return Ground(names, listen, listen[names[1]], None, {}, True, lambda: None)


def by_proxy(names: tuple[str, str]) -> Ground:
    """Put a TCP proxy of our own between them; this works on any machine."""
    listen = _loopback(names)
    proxy = Proxy(listen[names[1]])
    return Ground(names, listen, proxy.address, proxy, {}, True, proxy.close)


def in_namespaces(spaces: Namespaces, delay_s: float = 0.0, loss: float = 0.0) -> Survey:
    """Put each in a network namespace of its own.

    Args:
        spaces: makes the namespaces, and removes them at the end.
        delay_s: how much later each IP packet arrives, each way.
        loss: the share of them that is lost.
    """

    def survey(names: tuple[str, str]) -> Ground:
        places = {name: spaces.add() for name in names}
        link = spaces.link(*places.values())
        link.delay_s, link.loss = delay_s, loss
        listen = {name: f"tcp://{place.host}:{PORT}" for name, place in places.items()}
        commands = {name: place.command for name, place in places.items()}
        return Ground(names, listen, listen[names[1]], link, commands, False, lambda: None)

    return survey


def _loopback(names: tuple[str, str]) -> dict[str, str]:
    return {name: f"tcp://127.0.0.1:{port}" for name, port in zip(names, free_ports(2), strict=True)}
