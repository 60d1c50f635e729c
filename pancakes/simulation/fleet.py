"""Run agents in virtual time, in one process: `Fleet`, and `Faults` that go wrong on demand.

One thread, one network in memory, one clock; the classes of the agents are the same as anywhere else. The same seed and
the same calls give the same run. The demos, the replay, `Simulation` and tests stand on `Fleet`.

An agent is configured by classes, TOML text or a file; `config_of` builds such a configuration.
"""

from __future__ import annotations

import math
import random
import tempfile
import uuid
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from dataclasses import replace as changed
from os import PathLike
from typing import Any, Self

from msgspec.structs import replace

from pancakes.agent.agent import Agent, Virtual
from pancakes.config import Config, DeviceConfig, FilterConfig, ServiceConfig, TaskConfig, load, parse
from pancakes.devices.driver import Driver
from pancakes.errors import ConfigError, Fault
from pancakes.filters.filter import Filter
from pancakes.journal import MemoryJournal
from pancakes.kernel.virtual_time import VirtualDispatcher
from pancakes.mesh.memory_network import MemoryNetwork, Quality
from pancakes.migration import Cost
from pancakes.packet import NETWORK, SYSCTRL, Packet, covers, type_name
from pancakes.service import Service
from pancakes.settings import known_keys
from pancakes.simulation.agent_handle import PATIENCE_S, AgentHandle, NotInTimeError
from pancakes.task import Task
from pancakes.util import codecs
from pancakes.util.clock import SkewedClock
from pancakes.util.plugins import Plugins
from pancakes.util.text import suggestion

_HEAD = 'schema = 1\n[agent]\nname = "{name}"\n'
_TABLE_OF = {TaskConfig: "task", DeviceConfig: "device", FilterConfig: "filter", ServiceConfig: "service"}
_QUIET = ServiceConfig("log", "log", {"console": False})


@dataclass(frozen=True)
class BuiltConfig:
    """A configuration, and the classes that it names.

    Attributes:
        config: the configuration.
        classes: the classes, by the name that the configuration uses.
    """

    config: Config
    classes: dict[str, type] = field(default_factory=dict)


def config_of(name: str, text: str = "", **parts: Any) -> Config:
    """Return the configuration of an agent in a test.

    Args:
        name: its name.
        text: its configuration as TOML; `schema` and `[agent]` may be left out.
        parts: `tasks`, `devices`, `filters`, `services`, `classes` and keys of `[agent]` and `[clock]`, as for
            `Fleet.start`.
    """
    return build_config(name, text, **parts).config


def build_config(
    name: str,
    text: str = "",
    *,
    tasks: Mapping[str, Any] | None = None,
    devices: Mapping[str, Any] | None = None,
    filters: Mapping[str, Any] | None = None,
    services: Mapping[str, Any] | None = None,
    classes: Mapping[str, type] | None = None,
    **agent: Any,
) -> BuiltConfig:
    """Build a configuration from text and classes; see `Fleet.start` for the arguments."""
    config = parse(text if "[agent]" in text else _HEAD.format(name=name) + text, f"{name}.toml")
    named: dict[str, type] = dict(classes or {})

    def tables(given: Mapping[str, Any] | None, kind: Any, key: str) -> dict[str, Any]:
        made = {}
        for table, what in (given or {}).items():
            fields = {"type": what} if isinstance(what, (type, str)) else dict(what)
            cls = fields.pop("type", "" if kind is ServiceConfig else None)
            if isinstance(cls, type):
                named[f"test.{cls.__qualname__.rpartition('.')[2]}"] = cls
                cls = f"test.{cls.__qualname__.rpartition('.')[2]}"
            if unknown := [key for key in fields if key not in known_keys(kind)]:
                near = suggestion(unknown[0], known_keys(kind))
                raise ConfigError([Fault(name, f"[{_TABLE_OF[kind]}.{table}] {unknown[0]}", "unknown key", near)])
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
        filters={**config.filters, **tables(filters, FilterConfig, "type")},
        services={**config.services, **tables(services, ServiceConfig, "type")},
    )
    return BuiltConfig(config if "log" in (services or {}) else silent(config), named)


def silent(config: Config) -> Config:
    """Return a configuration whose Log Service writes nothing, unless it has settings of its own."""
    if config.services["log"].settings:
        return config
    return replace(config, services={**config.services, "log": _QUIET})


def registered(classes: Mapping[str, type], extra: Mapping[tuple[str, str], Any] | None = None) -> Plugins:
    """Return plug-ins that know these classes by name, besides all that is installed.

    Args:
        classes: tasks, services, drivers, filters and cost functions, by the name that a configuration uses.
        extra: anything else, by (entry point group, name).
    """
    found: dict[tuple[str, str], Any] = {(_group_of(cls), name): cls for name, cls in classes.items()}
    return Plugins({**found, **(extra or {})})


def _group_of(cls: type) -> str:
    for base, group in (
        *((Task, "tasks"), (Service, "services")),
        *((Driver, "drivers"), (Filter, "filters"), (Cost, "costs")),
    ):
        if issubclass(cls, base):
            return f"pancakes.{group}"
    raise TypeError(f"{cls.__qualname__} is no task, service, driver, filter or cost function")


def meeting(name: str, known: Iterable[Config], links: int | None = None) -> dict[str, Any]:
    """Return the keys of `[agent]` by which an agent meets those that are known, and waits for no others.

    Args:
        name: the agent.
        known: the configurations of the others.
        links: as in `[agent]`: with a few links it dials one of them, and learns of the others.
    """
    peers = tuple(config.agent.addresses[-1] for config in known if config.agent.name != name)
    if links is not None:
        peers = peers[:1]
    return {"listen": f"tcp://{name}:7400", "peers": peers, "birth_wait_s": 0.0}


def has_met(links: int | None, met: int, others: int) -> bool:
    """Return whether an agent that is linked to `met` of all others has as many links as it keeps."""
    return met >= (others if links is None else min(links, others))


class Fleet:
    """Run agents on one thread, one network in memory and one virtual clock; the same seed gives the same run.

    The end of its `with` stops all agents. If one of Pancakes' own actors has failed that may not
    (`AgentHandle.may_fail`), it raises an `AssertionError`, unless it ends with another exception.

    Args:
        seed: draws the order of the actors, jitter, faults, and the journals' identities.
        quality: how well agents receive each other.
        classes: tasks, services, drivers and cost functions that configurations may name, by name; those that are
            passed to `start` are added under `test.ClassName`, for every agent of the fleet.
        channels: what the probe of each agent listens to; empty: everything.
        plugins: where the agents' classes are found; None: `classes`, and all that is installed.

    Attributes:
        seed: the same.
        dispatcher: runs everything.
        network: the network; `faults` is the simpler way to disturb it.
        faults: injects faults.
        agents: the agents that run, by name.
        started: all agents with a probe that were ever started, in order.
        journals: the journal of each agent, as it runs now or ran last, by name.
    """

    def __init__(
        self,
        seed: int = 0,
        quality: Quality | None = None,
        classes: Mapping[str, type] | None = None,
        channels: tuple[str, ...] = (),
        *,
        plugins: Plugins | None = None,
    ) -> None:
        self.seed = seed
        self.dispatcher = VirtualDispatcher(seed)
        self.network = MemoryNetwork(
            self.dispatcher.call_at, self.dispatcher.clock.now, random.Random(f"network/{seed}"), quality
        )
        self.faults = Faults(self, quality)
        self.agents: dict[str, AgentHandle] = {}
        self.started: list[AgentHandle] = []
        self.journals: dict[str, MemoryJournal] = {}
        self._plugins = plugins
        self._classes = dict(classes or {})
        self._channels = channels
        self._configs: dict[str, Config] = {}
        self._clocks: dict[str, tuple[float, float]] = {}
        self._disks: dict[str, dict[str, bytes]] = {}
        self._identities: dict[str, random.Random] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        self.close()
        if kind is None:
            assert_none_failed(self.started)

    def close(self) -> None:
        """Stop all agents, those that started last first."""
        for name in reversed(list(self.agents)):
            self.stop(name)

    # Starting and ending agents --------------------------------------------------------------------------------

    def start(
        self,
        name: str,
        text: str = "",
        *,
        tasks: Mapping[str, Any] | None = None,
        devices: Mapping[str, Any] | None = None,
        filters: Mapping[str, Any] | None = None,
        services: Mapping[str, Any] | None = None,
        classes: Mapping[str, type] | None = None,
        settle: bool = True,
        clock_rate: float = 1.0,
        clock_ahead_s: float = 0.0,
        **agent: Any,
    ) -> AgentHandle:
        """Start an agent, and wait until all that should run at its start does.

        It listens at `tcp://NAME:7400` and knows all agents that the fleet ever had. Its tasks begin at once, whatever
        these know of them, unless `birth_wait_s` is given, and its mission at 0, unless `join_s` is.

        Args:
            name: its name.
            text: its configuration as TOML; `schema` and `[agent]` may be left out.
            tasks: tasks by name, besides those of `text`: a class, or a mapping with a class or entry point name as
                `type` and the other keys of `[task.NAME]`.
            devices: devices by name, likewise with drivers.
            filters: filters of actuators by name, likewise; `device` names the actuator.
            services: services by name, likewise; a default service may be given with only its settings.
            classes: classes that `text` names, by name.
            settle: whether to wait until it is ready.
            clock_rate: how fast its clock runs, now and when it is started again: its seconds for each virtual second.
            clock_ahead_s: what its clock says at 0 of virtual time.
            agent: keys of `[agent]` and `[clock]`. Without `folders` a command may have files
                written below the system's temporary directory, where pytest's `tmp_path` lies.
        """
        agent = {**meeting(name, self._configs.values(), agent.get("links")), "join_s": 0.0, **agent}
        parts = {"tasks": tasks, "devices": devices, "filters": filters, "services": services, "classes": classes}
        made = build_config(name, text, **parts, **agent)
        self._clocks[name] = clock_rate, clock_ahead_s
        return self.start_config(made.config, made.classes, settle)

    def load(
        self,
        path: str | PathLike[str],
        sets: Sequence[str] = (),
        *,
        classes: Mapping[str, type] | None = None,
        settle: bool = True,
    ) -> AgentHandle:
        """Start the agent of a configuration file as `pancakes-agent` would, with its own address and its own peers.

        As with `start`, its tasks and its mission begin at once, unless `sets` give `agent.birth_wait_s` and
        `clock.join_s`.

        Args:
            path: the file.
            sets: changes of it, each as `table.key=value`.
            classes: classes that it names, by name, if they are not installed.
            settle: whether to wait until it is ready.

        Raises:
            ConfigError: the file has faults; the message names every one.
        """
        self._classes.update(classes or {})
        config = silent(load(path, ["agent.birth_wait_s=0", "clock.join_s=0", *sets], registered(self._classes)))
        return self.start_config(config, settle=settle)

    def start_config(
        self,
        config: Config,
        classes: Mapping[str, type] | None = None,
        settle: bool = True,
        *,
        probe: bool = True,
    ) -> AgentHandle:
        """Start an agent from its configuration. One that ran before under this name finds its disk as it left it.

        Args:
            config: its configuration.
            classes: classes that it names, by name, if they are not installed.
            settle: whether to wait until it is ready, which needs the probe.
            probe: whether it gets a probe. That is one more actor, so a run with probes differs from one without.

        Raises:
            PancakesError: its address is in use, a plug-in is missing, ...
        """
        self._classes.update(classes or {})
        self._configs[config.agent.name] = config
        return self._start(config, settle, probe)

    def restart(self, name: str, settle: bool = True) -> AgentHandle:
        """Start an agent again that was stopped or has crashed, with the configuration, clock and disk that it had.

        It knows all agents that the fleet ever had; with a few links, one that runs.
        """
        config = self._configs[name]
        links = config.agent.links
        known = [it for it in self._configs.values() if links is None or it.agent.name in self.agents]
        peers = meeting(name, known, links)["peers"]
        return self._start(replace(config, agent=replace(config.agent, peers=peers)), settle)

    def _start(self, config: Config, settle: bool, probe: bool = True) -> AgentHandle:
        plugins = self._plugins or registered(self._classes)
        name = config.agent.name

        def make(virtual: Virtual) -> AgentHandle:
            agent = _FaultyAgent(config, plugins, virtual, self.faults)
            if not probe:
                return AgentHandle(agent)
            handle = AgentHandle.with_probe(agent, self._channels)
            self.dispatcher.settle()  # it listens before the agent says anything
            return handle

        handle = self._add(name, make, *self._clocks.get(name, (1.0, 0.0)))
        if probe:
            self.started.append(handle)
        if settle:
            handle.wait_until(handle.agent.ready.is_set, what="readiness")
        return handle

    def add(self, name: str, make: Callable[[Virtual], Agent]) -> AgentHandle:
        """Start an agent that `make` makes of what it shares with the fleet, without a probe; see `start_config`."""
        return self._add(name, lambda virtual: AgentHandle(make(virtual)))

    def _add(
        self,
        name: str,
        make: Callable[[Virtual], AgentHandle],
        clock_rate: float = 1.0,
        clock_ahead_s: float = 0.0,
    ) -> AgentHandle:
        disk = self.disk(name)
        # Not the same one twice: an agent that has lost its identity is another one from then on.
        source = self._identities.setdefault(name, random.Random(f"journal/{self.seed}/{name}"))
        identity = uuid.UUID(int=source.getrandbits(128), version=4)
        journal = self.journals[name] = MemoryJournal(disk, str(identity), name)
        is_true = (clock_rate, clock_ahead_s) == (1.0, 0.0)
        clock = None if is_true else SkewedClock(self.dispatcher.clock, clock_rate, clock_ahead_s)
        transport = self.network.transport(name, clock.due_s if clock is not None else None)
        handle = make(Virtual(self.dispatcher, transport, journal, clock))
        handle.agent.start()
        self.agents[name] = handle
        return handle

    def stop(self, name: str) -> None:
        """Stop an agent gracefully."""
        self.agents.pop(name).agent.stop()
        self.run_for(0.0)

    def crash(self, name: str) -> None:
        """End an agent as a power cut does: nothing of it runs on, and what its disk has not yet got is lost."""
        self.agents.pop(name).agent.crash()
        self.run_for(0.0)

    def disk(self, name: str) -> dict[str, bytes]:
        """Return what an agent has on its disk; a change of it is a change of the disk."""
        return self._disks.setdefault(name, {})

    # Virtual time ----------------------------------------------------------------------------------------------

    def now(self) -> float:
        """Return the virtual time, in seconds; agents take it for the host's."""
        return self.dispatcher.clock.now()

    def run_to(self, time_s: float) -> None:
        """Run all agents until the virtual clock says `time_s`."""
        self.dispatcher.run_until(time_s)

    def run_for(self, duration_s: float) -> None:
        """Run all agents for this many seconds of virtual time."""
        self.run_to(self.now() + duration_s)

    def run_until(self, condition: Callable[[], bool], timeout_s: float = PATIENCE_S) -> bool:
        """Run all agents until a condition is true, which is checked after each event.

        Args:
            condition: returns whether it is true.
            timeout_s: how long at most, in virtual seconds.

        Returns:
            Whether it became true.
        """
        return self.dispatcher.run_until(self.now() + timeout_s, condition)

    def connect(self, timeout_s: float = PATIENCE_S) -> None:
        """Run until every agent has a link to every other, or to as many as it keeps."""

        def meshed() -> bool:
            return all(
                has_met(agent.agent.config.agent.links, len(agent.agent.mesh.connected()), len(self.agents) - 1)
                for agent in self.agents.values()
            )

        if not self.run_until(meshed, timeout_s):
            raise NotInTimeError(f"no full mesh within {timeout_s:g} s")


def assert_none_failed(agents: Iterable[AgentHandle]) -> None:
    """Fail a test in which actors of Pancakes' own have failed that may not."""
    failures = [failure for agent in agents for failure in agent.failures()]
    if failures:
        raise AssertionError("\n".join(["actors of Pancakes' own have failed, and are not in `may_fail`:", *failures]))


class _FaultyAgent(Agent):
    """Be an agent to which packets may come never or twice."""

    def __init__(self, config: Config, plugins: Plugins, virtual: Virtual, faults: Faults) -> None:
        self._faults = faults
        super().__init__(config, plugins, virtual)

    def receive(self, peer: str, packets: Sequence[Packet], size: int) -> None:
        came = self._faults.delivered(self.name, packets)
        if came:
            super().receive(peer, came, size * len(came) // len(packets))


NEVER_LOST = (NETWORK, SYSCTRL)
"""Channels on which agents coordinate: links lose nothing of that unless they break."""
DISK_FULL = "no space left on device"
"""The error of a write to a full disk."""


@dataclass(eq=False, slots=True)
class _PacketFault:
    """Lose or double some of the packets that come to an agent."""

    share: float
    copies: int
    type: str
    source: str
    at: str
    channel: str

    def matches(self, agent: str, packet: Packet) -> bool:
        """Return whether a packet that comes to an agent is one of those."""
        return (
            packet.channel not in NEVER_LOST
            and self.type in ("", packet.type)
            and self.at in ("", agent)
            and self.channel in ("", packet.channel)
            and (not self.source or covers(self.source, packet.source))
        )


class Faults:
    """Inject delays, cuts, losses, duplicates and bad disks, drawn from the fleet's seed; `calm` ends them all.

    Agents are named by their names. Times are virtual seconds.

    Args:
        fleet: the fleet to disturb.
        quality: how well its agents receive each other without faults.
    """

    def __init__(self, fleet: Fleet, quality: Quality | None = None) -> None:
        self._fleet = fleet
        self._normal = quality or Quality()
        self._qualities: dict[tuple[str, str], Quality] = {}
        self._random = random.Random(f"faults/{fleet.seed}")
        self._packet_faults: list[_PacketFault] = []

    def delay(self, a: str, b: str, latency_s: float, jitter_s: float = 0.0) -> None:
        """Delay all that two agents send each other from now on.

        Args:
            a: one of the two.
            b: the other.
            latency_s: how long it travels.
            jitter_s: how much longer it may travel; the order is kept.
        """
        self._change(a, b, changed(self._quality(a, b), latency_s=latency_s, jitter_s=jitter_s))

    def slow(self, a: str, b: str, bytes_per_s: float) -> None:
        """Limit how fast two agents can send to each other from now on."""
        self._change(a, b, changed(self._quality(a, b), bytes_per_s=bytes_per_s))

    def _quality(self, a: str, b: str) -> Quality:
        return self._qualities.get((min(a, b), max(a, b)), self._normal)

    def _change(self, a: str, b: str, quality: Quality) -> None:
        self._qualities[(min(a, b), max(a, b))] = quality
        self._fleet.network.set_quality(a, b, quality)

    def cut(self, *agents: str, off: tuple[str, ...] | None = None, for_s: float | None = None) -> None:
        """Cut agents off from others for a while. Both sides only notice the silence; what is sent is lost.

        Args:
            agents: the agents on one side.
            off: those on the other; None: all others.
            for_s: how long; None: until `calm`.
        """
        until_s = math.inf if for_s is None else self._fleet.now() + for_s
        self._fleet.network.partition(agents, off, until_s=until_s)

    def break_link(self, a: str, b: str, noticed: bool = True) -> None:
        """Break the link of two agents once; what was on its way is lost. They connect again.

        Args:
            a: one of the two.
            b: the other.
            noticed: whether both see it break; otherwise they only notice the silence.
        """
        self._fleet.network.break_links(a, b, noticed)

    def break_links(self, count: int, within_s: float) -> None:
        """Break the links of pairs of agents at `count` points in time; pairs and times are drawn."""
        for at_s in sorted(self._random.uniform(0.0, within_s) for _ in range(count)):
            self._fleet.dispatcher.call_at(self._fleet.now() + at_s, self._break_one)

    def _break_one(self) -> None:
        if len(self._fleet.agents) > 1:
            one, other = self._random.sample(list(self._fleet.agents), 2)
            self.break_link(one, other)

    def lose(
        self, share: float, body: type | None = None, *, source: str = "", at: str = "", channel: str = ""
    ) -> Callable[[], None]:
        """Lose packets from other agents on their way.

        Links lose nothing unless they break, but a publisher drops packets if a peer is too slow or away. Packets
        on `network` and `sysctrl` are never lost; packets to tasks by `task_address` are among them.

        Args:
            share: which part of them, from 0 to 1; which ones is drawn.
            body: only packets of this type.
            source: only those of this agent, service or task.
            at: only those that come to this agent.
            channel: only those on this channel.

        Returns:
            A function that ends it.
        """
        return self._let(_PacketFault(share, 0, type_name(body) if body is not None else "", source, at, channel))

    def double(
        self, share: float, body: type | None = None, *, source: str = "", at: str = "", channel: str = ""
    ) -> Callable[[], None]:
        """Let packets from other agents come twice; see `lose` for the arguments and the result."""
        return self._let(_PacketFault(share, 2, type_name(body) if body is not None else "", source, at, channel))

    def _let(self, fault: _PacketFault) -> Callable[[], None]:
        if not 0.0 <= fault.share <= 1.0:
            raise ValueError(f"{fault.share} is no share of packets: it must be from 0 to 1")
        self._packet_faults.append(fault)
        return lambda: self._packet_faults.remove(fault) if fault in self._packet_faults else None

    def delivered(self, agent: str, packets: Sequence[Packet]) -> Sequence[Packet]:
        """Return the packets that arrive of those that come to an agent, each as often as it does."""
        if not self._packet_faults:
            return packets
        return [packet for packet in packets for _ in range(self._copies(agent, packet))]

    def _copies(self, agent: str, packet: Packet) -> int:
        for fault in self._packet_faults:
            if fault.matches(agent, packet) and self._random.random() < fault.share:
                return fault.copies
        return 1

    def fill_disk(self, agent: str) -> Callable[[], None]:
        """Let all writes of an agent to its disk fail, until it is started again.

        Args:
            agent: its name.

        Returns:
            A function that ends it.
        """
        journal = self._fleet.journals[agent]
        journal.fault = DISK_FULL

        def end() -> None:
            journal.fault = ""

        return end

    def slow_disk(self, agent: str, latency_s: float) -> None:
        """Let each write of an agent to its disk take this long, until the agent is started again."""
        self._fleet.journals[agent].latency_s = latency_s

    def calm(self) -> None:
        """End all faults, including cuts that are still to come."""
        for journal in self._fleet.journals.values():
            journal.fault, journal.latency_s = "", MemoryJournal.latency_s
        self._packet_faults.clear()
        self._fleet.network.heal()
        for one, other in self._qualities:
            self._fleet.network.set_quality(one, other, self._normal)
        self._qualities.clear()
