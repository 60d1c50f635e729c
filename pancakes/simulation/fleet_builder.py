"""Build a fleet in virtual time from classes, TOML text or files: the configuration builder, and `BuiltFleet`.

`pancakes.testing.FleetInTest` and `Simulation` both stand on `BuiltFleet`. It starts each agent with a probe, keeps its
configuration, clock and disk for a restart, and injects the faults of `pancakes.fleet.Faults`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import Any, ClassVar, Generic, Self, TypeVar

from msgspec.structs import replace

from pancakes.agent.agent import Agent, Virtual
from pancakes.config import Config, DeviceConfig, ServiceConfig, TaskConfig, load, parse
from pancakes.devices.driver import Driver
from pancakes.durable.rules import Cost
from pancakes.fleet import Faults, VirtualFleet
from pancakes.mesh.memory_network import Quality
from pancakes.packet import Packet
from pancakes.service import Service
from pancakes.simulation.agent_handle import PATIENCE_S, AgentHandle
from pancakes.task import Task
from pancakes.util import codecs
from pancakes.util.plugins import Plugins

_HEAD = 'schema = 1\n[agent]\nname = "{name}"\n'
_QUIET = ServiceConfig("log", "log", {"console": False})


@dataclass(frozen=True)
class AgentParts:
    """A configuration, and the classes that it names: what `parts` makes of its arguments."""

    config: Config
    classes: dict[str, type] = field(default_factory=dict)


def config_of(
    name: str,
    text: str = "",
    *,
    tasks: Mapping[str, Any] | None = None,
    devices: Mapping[str, Any] | None = None,
    services: Mapping[str, Any] | None = None,
    **agent: Any,
) -> Config:
    """Returns the configuration of an agent in a test; see `FleetInTest.start` for the arguments."""
    return parts(name, text, tasks, devices, services, agent).config


def parts(
    name: str,
    text: str,
    tasks: Mapping[str, Any] | None,
    devices: Mapping[str, Any] | None,
    services: Mapping[str, Any] | None,
    agent: Mapping[str, Any],
) -> AgentParts:
    """Returns a configuration made of text and of classes; see `FleetInTest.start` for the arguments."""
    config = parse(text if "[agent]" in text else _HEAD.format(name=name) + text, f"{name}.toml")
    classes: dict[str, type] = {}

    def tables(given: Mapping[str, Any] | None, kind: Any, key: str) -> dict[str, Any]:
        made = {}
        for table, what in (given or {}).items():
            fields = {"type": what} if isinstance(what, (type, str)) else dict(what)
            cls = fields.pop("type", "" if kind is ServiceConfig else None)
            if isinstance(cls, type):
                classes[f"test.{cls.__qualname__.rpartition('.')[2]}"] = cls
                cls = f"test.{cls.__qualname__.rpartition('.')[2]}"
            made[table] = codecs.convert({"name": table, key: cls or table, **fields}, kind)
        return made

    clock = {key: agent[key] for key in ("speed", "hold", "join_s") if key in agent}
    others = {key: value for key, value in agent.items() if key not in clock}
    if isinstance(at := others.get("listen"), str):
        others["listen"] = (at,) if at else ()
    others.setdefault("folders", config.agent.folders or (tempfile.gettempdir(),))  # where pytest's tmp_path lies
    config = replace(
        config,
        agent=replace(config.agent, **{"seed": 1 if config.agent.seed is None else config.agent.seed, **others}),
        clock=replace(config.clock, **clock),
        tasks={**config.tasks, **tables(tasks, TaskConfig, "type")},
        devices={**config.devices, **tables(devices, DeviceConfig, "driver")},
        services={**config.services, **tables(services, ServiceConfig, "type")},
    )
    return AgentParts(config if "log" in (services or {}) else silent(config), classes)


def silent(config: Config) -> Config:
    """Returns a configuration whose Log Service writes nothing, unless it says itself what that should do."""
    if config.services["log"].settings:
        return config
    return replace(config, services={**config.services, "log": _QUIET})


def registered(classes: Mapping[str, type], extra: Mapping[tuple[str, str], Any] | None = None) -> Plugins:
    """Returns plug-ins that know classes under names of a test's own, besides all that is installed.

    Args:
        classes: tasks, services, drivers and cost functions, by the name that a configuration uses.
        extra: anything else, by (entry point group, name).
    """
    found: dict[tuple[str, str], Any] = {(_group_of(cls), name): cls for name, cls in classes.items()}
    return Plugins({**found, **(extra or {})})


def _group_of(cls: type) -> str:
    for base, group in ((Task, "tasks"), (Service, "services"), (Driver, "drivers"), (Cost, "costs")):
        if issubclass(cls, base):
            return f"pancakes.{group}"
    raise TypeError(f"{cls.__qualname__} is no task, service, driver or cost function")


HandleT = TypeVar("HandleT", bound=AgentHandle)


class _Faulty(Agent):
    """An agent to which packets may come never or twice."""

    def __init__(self, config: Config, plugins: Plugins, virtual: Virtual, faults: Faults) -> None:
        self._faults = faults
        super().__init__(config, plugins, virtual)

    def receive(self, peer: str, packets: Sequence[Packet], size: int) -> None:
        came = [packet for packet in packets for _ in range(self._faults.copies(self.name, packet))]
        if came:
            super().receive(peer, came, size * len(came) // len(packets))


def meeting(name: str, known: Iterable[Config], links: int | None = None) -> dict[str, Any]:
    """Returns the keys of `[agent]` by which an agent meets those that are known, and waits for no others.

    Args:
        name: the agent.
        known: the configurations of the others.
        links: as in `[agent]`: with a few links it dials one of them, and hears of the others.
    """
    peers = tuple(config.agent.addresses[-1] for config in known if config.agent.name != name)
    if links is not None:
        peers = peers[:1]
    return {"listen": f"tcp://{name}:7400", "peers": peers, "birth_wait_s": 0.0}


def has_met(links: int | None, met: int, others: int) -> bool:
    """Returns whether an agent that is linked to `met` of all others is linked to as many as it keeps links to."""
    return met >= (others if links is None else min(links, others))


class BuiltFleet(Generic[HandleT]):
    """Agents in virtual time, on one thread and on a network in memory, twice the same for the same seed.

    Args:
        seed: draws the order of the actors, jitter, faults, and the journals' identities.
        quality: how well agents hear each other.
        classes: tasks, services, drivers and cost functions that configurations may name, by name; those that are
            passed to `start` are added under `test.ClassName`, for every agent of the fleet.
        channels: what the probe of each agent listens to; empty: everything.

    Attributes:
        fleet: the fleet itself.
        network: the network; `faults` is its friendly side.
        faults: what may be let go wrong.
        agents: the agents that run, by name.
        started: all agents that were ever started, in order.
    """

    handle: ClassVar[type[Any]] = AgentHandle
    """What is handed out for each agent: the class that `HandleT` stands for."""

    def __init__(
        self,
        seed: int = 0,
        quality: Quality | None = None,
        classes: Mapping[str, type] | None = None,
        channels: tuple[str, ...] = (),
    ) -> None:
        self._classes = dict(classes or {})
        self.fleet = VirtualFleet(seed, quality)
        self.network = self.fleet.network
        self.faults = Faults(self.fleet, quality)
        self.agents: dict[str, HandleT] = {}
        self.started: list[HandleT] = []
        self._channels = channels
        self._configs: dict[str, Config] = {}
        self._clocks: dict[str, tuple[float, float]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()

    def now(self) -> float:
        """Returns the virtual time in seconds."""
        return self.fleet.now()

    def start(
        self,
        name: str,
        text: str = "",
        *,
        tasks: Mapping[str, Any] | None = None,
        devices: Mapping[str, Any] | None = None,
        services: Mapping[str, Any] | None = None,
        classes: Mapping[str, type] | None = None,
        settle: bool = True,
        clock_rate: float = 1.0,
        clock_ahead_s: float = 0.0,
        **agent: Any,
    ) -> HandleT:
        """Starts an agent, and waits until all that should run at its start does.

        It listens at `tcp://NAME:7400` and knows all agents that the fleet ever had. Its tasks begin at once, whatever
        these know of them, unless `birth_wait_s` is given, and its mission at 0, unless `join_s` is.

        Args:
            name: its name.
            text: its configuration as TOML; `schema` and `[agent]` may be left out.
            tasks: tasks by name, besides those of `text`: a class, or a mapping with a class or entry point name as
                `type` and the other keys of `[task.NAME]`.
            devices: devices by name, likewise with drivers.
            services: services by name, likewise; a default service may be given with its settings alone.
            classes: classes that `text` names, by name.
            settle: whether to wait until it is ready.
            clock_rate: how fast its clock runs, now and when it is started again: its seconds for each virtual second.
            clock_ahead_s: what its clock says at 0 of virtual time.
            agent: keys of `[agent]` and `[clock]`. Without `folders` a command may have files
                written below the system's temporary directory, where pytest's `tmp_path` lies.
        """
        agent = {**meeting(name, self._configs.values(), agent.get("links")), "join_s": 0.0, **agent}
        made = parts(name, text, tasks, devices, services, agent)
        self._clocks[name] = clock_rate, clock_ahead_s
        return self.start_as(made.config, {**(classes or {}), **made.classes}, settle)

    def load(
        self,
        path: str | PathLike[str],
        sets: Sequence[str] = (),
        *,
        classes: Mapping[str, type] | None = None,
        settle: bool = True,
    ) -> HandleT:
        """Starts the agent of a configuration file as `pancakes-agent` would, with its own address and its own peers.

        As with `start`, its tasks and its mission begin at once, unless `sets` give `agent.birth_wait_s` and
        `clock.join_s`.

        Args:
            path: the file.
            sets: changes of it, each as `table.key=value`.
            classes: classes that it names, by name, where they are not installed.
            settle: whether to wait until it is ready.

        Raises:
            ConfigError: the file is not sound; the message names every fault.
        """
        self._classes.update(classes or {})
        config = silent(load(path, ["agent.birth_wait_s=0", "clock.join_s=0", *sets], registered(self._classes)))
        return self.start_as(config, settle=settle)

    def start_as(self, config: Config, classes: Mapping[str, type] | None = None, settle: bool = True) -> HandleT:
        """Starts an agent as it is configured.

        Args:
            config: its configuration.
            classes: classes that it names, by name, where they are not installed.
            settle: whether to wait until it is ready.
        """
        self._classes.update(classes or {})
        self._configs[config.agent.name] = config
        return self._start(config, settle)

    def restart(self, name: str, settle: bool = True) -> HandleT:
        """Starts an agent again that was stopped or has crashed, with the configuration, clock and disk that it had.

        It knows all agents that the fleet ever had; with a few links, one that runs.
        """
        config = self._configs[name]
        links = config.agent.links
        known = [it for it in self._configs.values() if links is None or it.agent.name in self.agents]
        peers = meeting(name, known, links)["peers"]
        return self._start(replace(config, agent=replace(config.agent, peers=peers)), settle)

    def _start(self, config: Config, settle: bool) -> HandleT:
        plugins = registered(self._classes)
        made: list[HandleT] = []

        def make(virtual: Virtual) -> Agent:
            made.append(self.handle.on(_Faulty(config, plugins, virtual, self.faults), self._channels))
            self.fleet.dispatcher.settle()  # it listens before the agent says anything
            return made[0].agent

        self.fleet.add(config.agent.name, make, *self._clocks.get(config.agent.name, (1.0, 0.0)))
        (found,) = made
        self.agents[found.name] = found
        self.started.append(found)
        if settle:
            found.wait_until(found.agent.ready.is_set, what="readiness")
        return found

    def stop(self, name: str) -> None:
        """Stops an agent in good order."""
        self.agents.pop(name)
        self.fleet.stop(name)

    def crash(self, name: str) -> None:
        """Ends an agent as a power cut does; what its disk has not yet got is lost."""
        self.agents.pop(name)
        self.fleet.crash(name)

    def run_for(self, duration_s: float) -> None:
        """Runs all agents for so many seconds of virtual time."""
        self.fleet.run_for(duration_s)

    def run_until(self, condition: Callable[[], bool], at_most_s: float = PATIENCE_S) -> bool:
        """Runs all agents until a condition is true; returns whether it became true."""
        return self.fleet.run_while(lambda: not condition(), at_most_s)

    def connect(self, at_most_s: float = PATIENCE_S) -> None:
        """Runs until every agent has a link to every other, or to as many as it keeps."""

        def meshed() -> bool:
            return all(
                has_met(agent.agent.config.agent.links, len(agent.agent.mesh.connected()), len(self.agents) - 1)
                for agent in self.agents.values()
            )

        if not self.run_until(meshed, at_most_s):
            raise self.handle.failure(f"no full mesh within {at_most_s:g} s")

    def close(self) -> None:
        """Stops all agents."""
        self.fleet.close()
        self.agents.clear()
