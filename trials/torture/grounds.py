"""Where two real agents stand, and what is between them: a TCP proxy, or the wire between two network namespaces."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from torture.live import LiveFleet, free_ports
from torture.namespaces import Namespaces
from torture.proxy import Proxy

PORT = 7401  # in a namespace all are free


class Cuttable(Protocol):
    """What is between two agents.

    Attributes:
        cut: set once the link has been cut.
    """

    cut: threading.Event

    def cut_at(self, word: str) -> None:
        """Cuts the link when the next packet of this type is on its way; it does not arrive, and nothing after it."""
        ...

    def heal(self) -> None:
        """Lets the two reach each other again."""
        ...


@dataclass
class Ground:
    """Two agents' addresses.

    Attributes:
        names: theirs; the first one dials the other.
        listen: where each listens.
        dialled: where the first one finds the other.
        link: what is between them; None: nothing is.
        commands: what stands before the command of each.
        tells_losses: whether what was on its way is lost for good when the link is cut, as by a reset of a
            connection; else TCP sends it again once the link heals, where nobody has given the connection up by then.
        close: ends what is between them.
    """

    names: tuple[str, str]
    listen: Mapping[str, str]
    dialled: str
    link: Cuttable | None
    commands: Mapping[str, Sequence[str]]
    tells_losses: bool
    close: Callable[[], None]

    def fleet(self, directory: Path, rest: Mapping[str, str]) -> LiveFleet:
        """Returns the two, not started yet; `rest` is what follows `[agent]` in the configuration of each."""
        peers = {self.names[0]: [self.dialled], self.names[1]: []}
        return LiveFleet(directory, self.names, rest, self.listen, peers, self.commands)


Survey = Callable[[tuple[str, str]], Ground]
"""Makes the ground for two agents of these names."""


def on_loopback(names: tuple[str, str]) -> Ground:
    """Nothing is between them."""
    listen = _loopback(names)
    return Ground(names, listen, listen[names[1]], None, {}, True, lambda: None)


def by_proxy(names: tuple[str, str]) -> Ground:
    """A TCP proxy of our own is between them; any machine can do that."""
    listen = _loopback(names)
    proxy = Proxy(listen[names[1]])
    return Ground(names, listen, proxy.address, proxy, {}, True, proxy.close)


def in_namespaces(spaces: Namespaces, delay_s: float = 0.0, loss: float = 0.0) -> Survey:
    """Each is in a network namespace of its own.

    Args:
        spaces: makes them, and removes them in the end.
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
