"""Connections between agents that are killed: a proxy between each two, or Zenoh routers, which fail, too."""

from __future__ import annotations

import json
import os
import random
import signal
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cli.processes import INSECURE
from torture.live import free_ports
from torture.pipe import Pipe
from torture.proxy import Proxy, Watch
from torture.waits import Waits
from zenoh_links.routers import Router


class Roads(ABC):
    """The connections between agents.

    Attributes:
        listen: the address of each agent, by name.
        peers: the addresses that each dials, by name.
        network: the network settings of each, by name.
        faults: the faults of the connections themselves.
    """

    listen: Mapping[str, str]
    peers: Mapping[str, Sequence[str]]
    network: Mapping[str, str]
    faults: Sequence[str] = ()

    def strike(self, fault: str, draw: random.Random, waits: Waits) -> None:
        """Make one of the faults, and end it again."""
        raise NotImplementedError(fault)

    @abstractmethod
    def close(self) -> None:
        """Remove the connections."""


MakeRoads = Callable[[Sequence[str], Path, Watch], Roads]
"""Makes the connections between agents of these names, with files in a folder; shows each packet if possible."""


class Proxies(Roads):
    """A proxy between each two, which shows each packet.

    Args:
        listen: where each agent listens.
        watch: called with each packet.
    """

    def __init__(self, listen: Mapping[str, str], watch: Watch) -> None:
        self.listen = listen
        self.network = dict.fromkeys(listen, INSECURE)
        names = list(listen)
        peers: dict[str, list[str]] = {name: [] for name in names}
        self._proxies: list[Proxy] = []
        for number, dialled in enumerate(names):
            for dialler in names[:number]:
                self._proxies.append(Proxy(listen[dialled], watch))
                peers[dialler].append(self._proxies[-1].address)
        self.peers = peers

    def close(self) -> None:
        for proxy in self._proxies:
            proxy.close()


class Routers(Roads):
    """Two Zenoh routers, one of which joins the other through a pipe that can be cut.

    The first agent knows only one router, the second only the other one, all others both.

    Args:
        names: the names of the agents.
    """

    faults = ("a router killed", "both routers killed", "a router stopped", "routers parted")

    def __init__(self, names: Sequence[str]) -> None:
        one = Router()
        self._pipe = Pipe(int(one.address.rpartition(":")[2]))
        other = Router(at=f"tcp/127.0.0.1:{self._pipe.port}")
        self._routers = (one, other)
        addresses = (one.address, other.address)
        self.listen = {name: f"zenoh://{name}-{os.getpid()}-{self._pipe.port}:1" for name in names}
        self.peers = {name: [at for other, at in self.listen.items() if other != name] for name in names}
        self.network = {
            name: _network(addresses[number : number + 1] if number < 2 else addresses[:: -1 if number % 2 else 1])
            for number, name in enumerate(names)
        }
        # For the clients of this process, so it can have only one fleet behind routers at a time.
        os.environ["PANCAKES_ZENOH"] = ",".join(addresses)
        for router in self._routers:
            router.start()

    def strike(self, fault: str, draw: random.Random, waits: Waits) -> None:
        for_s = draw.uniform(0.1, 5.0)
        match fault:
            case "routers parted":
                self._pipe.cut()
                waits.let(for_s)
                self._pipe.heal()
            case "a router stopped":
                router = draw.choice(self._routers)
                router.send(signal.SIGSTOP)
                waits.let(for_s)
                router.send(signal.SIGCONT)
            case _:
                struck = self._routers if fault == "both routers killed" else (draw.choice(self._routers),)
                for router in struck:
                    router.kill()
                waits.let(for_s)
                for router in struck:
                    router.start()

    def close(self) -> None:
        os.environ.pop("PANCAKES_ZENOH", None)
        self._pipe.close()
        for router in self._routers:
            if router.process is not None:
                router.send(signal.SIGCONT)
            router.end()


def _network(routers: Sequence[str]) -> str:
    settings = f"[service.network.settings.transports.zenoh]\nrouters = {json.dumps(routers)}\ninsecure = true\n"
    return f"[service.network.settings]\ninsecure = true\n{settings}"


def over_tcp(names: Sequence[str], directory: Path, watch: Watch) -> Roads:
    """Connect the agents over TCP."""
    ports: list[Any] = free_ports(len(names))
    return Proxies({name: f"tcp://127.0.0.1:{port}" for name, port in zip(names, ports, strict=True)}, watch)


def over_local(names: Sequence[str], directory: Path, watch: Watch) -> Roads:
    """Connect the agents by sockets of the file system."""
    return Proxies({name: f"local://{directory}/{name}" for name in names}, watch)


def over_zenoh(names: Sequence[str], directory: Path, watch: Watch) -> Roads:
    """Connect the agents through routers; no packet is shown."""
    return Routers(names)


ROADS: Mapping[str, MakeRoads] = {"tcp": over_tcp, "local": over_local, "zenoh": over_zenoh}
"""The functions by the option of `scripts/torture kills`."""
