"""What tests of tasks, services and drivers need: agents made in code, virtual time, and a probe that listens.

    class Blink(Task):
        @every(hz=2)
        def blink(self, tick):
            self.publish("system", Load(0.5))

    def test_it_blinks_twice_a_second():
        with FleetInTest() as fleet:
            agent = fleet.start("a", tasks={"Blink": Blink})
            fleet.run_for(10.0)
            assert len(agent.probe.packets(Load)) == 20
            assert agent.ask(Stop("Blink")).ok

`FleetInTest` runs any number of agents in virtual time, on one thread; `threaded_agent` runs one as it runs on a
robot. Both hand out an `AgentInTest`, so a test may be written once for both. `VirtualClock` is the clock to give to
whatever wants one. Nothing here sleeps, and no shipped module imports this one.
"""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from pancakes.agent import Agent
from pancakes.clock import MonotonicClock, VirtualClock
from pancakes.config import Config, DeviceConfig, ServiceConfig, TaskConfig, parse
from pancakes.control import Reply
from pancakes.devices.driver import Driver
from pancakes.events import Event, LogLine
from pancakes.fleet import VirtualFleet
from pancakes.kernel.component import Component
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Mailbox, queue
from pancakes.net.memory import Quality
from pancakes.packet import LOG, SYSCTRL, Packet, join, type_name
from pancakes.plugins import Plugins
from pancakes.service import Service
from pancakes.slot import Slot
from pancakes.task import Task

__all__ = [
    "AgentInTest",
    "FleetInTest",
    "Probe",
    "VirtualClock",
    "assert_published",
    "config_of",
    "no_thread_left",
    "registered",
    "threaded_agent",
]

PATIENCE_S = 10.0
"""How long, in the time of the agent under test, a test waits for something before it fails."""
KEEP = queue(1_000_000)

Where = Callable[[Any], bool]
"""Says of a packet's body whether it is the one that is meant."""


class Probe(Component):
    """An actor that listens to channels and remembers every packet in the order in which it came.

    What it remembers may be asked for from any thread, and it may publish from any thread.

    Args:
        kernel: the kernel that it belongs to.
        address: its address.
        mailbox: None for one of its own.
        channels: what to listen to; the default are all channels that there are when it starts.
    """

    def __init__(
        self, kernel: Kernel, address: str, mailbox: Mailbox | None = None, *, channels: tuple[str, ...] = ()
    ) -> None:
        super().__init__(kernel, address, mailbox)
        self._channels = channels
        self._news = threading.Condition()
        self._heard: list[Packet] = []

    def on_start(self) -> None:
        for channel in self._channels or self.kernel.stream.channels():
            self.follow(channel)

    def follow(self, channel: str) -> None:
        """Listens to one more channel."""
        self.subscribe(channel, None, self._hear, keep=KEEP)

    def _hear(self, packet: Packet) -> None:
        with self._news:
            self._heard.append(packet)
            self._news.notify_all()

    def packets(
        self, body: type | None = None, where: Where | None = None, *, channel: str = "", source: str = ""
    ) -> list[Packet]:
        """Returns what has been heard so far.

        Args:
            body: only packets of this type.
            where: only those whose body it says yes to.
            channel: only those on this channel.
            source: only those of this publisher.
        """
        name = type_name(body) if body is not None else ""
        with self._news:
            heard = list(self._heard)
        return [
            packet
            for packet in heard
            if (not name or packet.type == name)
            and (not channel or packet.channel == channel)
            and (not source or packet.source == source)
            and (where is None or where(packet.body))
        ]

    def forget(self) -> None:
        """Forgets what has been heard so far."""
        with self._news:
            self._heard.clear()

    def wait(self, condition: Callable[[], bool], at_most_s: float) -> bool:
        """Waits in the calling thread until a condition holds; it is looked at with each packet. Not in virtual time.

        Returns:
            Whether it came to hold in time, in seconds of the host.
        """
        with self._news:
            return self._news.wait_for(condition, at_most_s)


def assert_published(
    probe: Probe | AgentInTest,
    body: type,
    where: Where | None = None,
    *,
    channel: str = "",
    source: str = "",
    times: int | None = None,
) -> Packet:
    """Asserts that a packet has been published, and returns the last one that fits.

    Args:
        probe: who listened, or the agent whose probe did.
        body: its type.
        where: says yes to its body.
        channel: where it was published.
        source: who published it.
        times: how many there must be; None: one or more.

    Raises:
        AssertionError: names what there was instead.
    """
    listener = probe.probe if isinstance(probe, AgentInTest) else probe
    found = listener.packets(body, where, channel=channel, source=source)
    if (times is None and found) or (times is not None and len(found) == times):
        return found[-1] if found else Packet("", "", "", "", 0.0, 0, None)
    others = listener.packets(body)[-20:]
    heard = "\n".join(f"  {packet.stamp:.3f} {packet.channel} {packet.source}: {packet.body}" for packet in others)
    wanted = "at least one" if times is None else str(times)
    raise AssertionError(
        f"{len(found)} packets of the type {type_name(body)!r} fit, {wanted} wanted; of this type there were\n"
        + (heard or "  none")
    )


def registered(classes: Mapping[str, type], extra: Mapping[tuple[str, str], Any] | None = None) -> Plugins:
    """Returns plug-ins that know classes under names of a test's own, besides all that is installed.

    Args:
        classes: tasks, services and drivers, by the name that a configuration uses.
        extra: anything else, by (entry point group, name).
    """
    found: dict[tuple[str, str], Any] = {(_group_of(cls), name): cls for name, cls in classes.items()}
    return Plugins({**found, **(extra or {})})


def _group_of(cls: type) -> str:
    for base, group in ((Task, "tasks"), (Service, "services"), (Driver, "drivers")):
        if issubclass(cls, base):
            return f"pancakes.{group}"
    raise TypeError(f"{cls.__qualname__} is no task, service or driver")


_HEAD = 'schema = 1\n[agent]\nname = "{name}"\n'
_QUIET = ServiceConfig("log", "log", {"console": False})


@dataclass(frozen=True)
class _Parts:
    """What `config_of` makes of its keyword arguments: a configuration, and the classes that it names."""

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
    return _parts(name, text, tasks, devices, services, agent).config


def _parts(
    name: str,
    text: str,
    tasks: Mapping[str, Any] | None,
    devices: Mapping[str, Any] | None,
    services: Mapping[str, Any] | None,
    agent: Mapping[str, Any],
) -> _Parts:
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
            made[table] = msgspec.convert({"name": table, key: cls or table, **fields}, kind)
        return made

    clock = {key: agent[key] for key in ("speed", "hold") if key in agent}
    others = {key: value for key, value in agent.items() if key not in clock}
    config = replace(
        config,
        agent=replace(config.agent, **{"seed": 1 if config.agent.seed is None else config.agent.seed, **others}),
        clock=replace(config.clock, **clock),
        tasks={**config.tasks, **tables(tasks, TaskConfig, "type")},
        devices={**config.devices, **tables(devices, DeviceConfig, "driver")},
        services={**config.services, **tables(services, ServiceConfig, "type")},
    )
    if not config.services["log"].settings and "log" not in (services or {}):
        config = replace(config, services={**config.services, "log": _QUIET})
    return _Parts(config, classes)


class AgentInTest:
    """One agent, and what a test asks of it.

    Attributes:
        agent: the agent itself.
        probe: hears everything on it, from its start on.
    """

    def __init__(self, agent: Agent, probe: Probe, wait: Callable[[Callable[[], bool], float], bool]) -> None:
        self.agent = agent
        self.probe = probe
        self._wait = wait

    @property
    def name(self) -> str:
        """The agent's name."""
        return self.agent.name

    @property
    def kernel(self) -> Kernel:
        """The agent's kernel."""
        return self.agent.kernel

    def component(self, path: str) -> Component | None:
        """Returns the actor that runs at `service` or `service/task`."""
        return self.kernel.registry.get(join(self.name, path))

    def task(self, name: str, service: str = "client") -> Any:
        """Returns the actor of a task that runs; fails where it does not."""
        found = self.component(join(service, name))
        assert found is not None, f"{name} does not run on {self.name}, only {self.running()}"
        return found

    def slot(self, name: str, service: str = "client") -> Slot:
        """Returns the place of a task in its service."""
        owner = self.component(service)
        assert isinstance(owner, Service), f"{self.name} has no service {service}"
        return owner.slots[name]

    def running(self, service: str = "client") -> list[str]:
        """Returns the names of the tasks of a service that have an actor."""
        prefix = join(self.name, service) + "/"
        return [
            component.name for component in self.kernel.registry.components() if component.address.startswith(prefix)
        ]

    def publish(self, channel: str, body: Any, to: str = "") -> Packet:
        """Publishes a packet in the probe's name; see `Component.publish`."""
        return self.probe.publish(channel, body, to)

    def ask(self, body: Any, to: str = "", at_most_s: float = PATIENCE_S) -> Reply:
        """Publishes a control packet, and waits for the reply to it.

        Args:
            body: the control packet's body.
            to: the agent that it is for; empty: this one.
            at_most_s: how long to wait.
        """
        asked = self.publish(SYSCTRL, body, to)
        return self.reply_to(asked, at_most_s)

    def reply_to(self, asked: Packet, at_most_s: float = PATIENCE_S) -> Reply:
        """Waits for the reply to a control packet that the probe has published."""
        cause = (asked.source, asked.seq)

        def replies() -> list[Packet]:
            return [packet for packet in self.probe.packets(Reply) if packet.cause == cause]

        self.wait_until(lambda: bool(replies()), at_most_s, f"a reply to {asked.body}")
        reply = replies()[0].body
        assert isinstance(reply, Reply)
        return reply

    def wait_for(
        self,
        body: type,
        where: Where | None = None,
        *,
        channel: str = "",
        source: str = "",
        at_most_s: float = PATIENCE_S,
    ) -> Packet:
        """Waits until a packet has been published, and returns the first that fits; see `Probe.packets`."""

        def found() -> list[Packet]:
            return self.probe.packets(body, where, channel=channel, source=source)

        self.wait_until(lambda: bool(found()), at_most_s, f"a packet of the type {type_name(body)!r}")
        return found()[0]

    def wait_for_event(self, kind: str, at_most_s: float = PATIENCE_S, **fields: Any) -> Mapping[str, Any]:
        """Waits for an event with these fields, and returns all of its fields."""
        fits = _event(kind, fields)
        packet = self.wait_for(Event, fits, channel=LOG, at_most_s=at_most_s)
        assert isinstance(packet.body, Event)
        return packet.body.fields

    def wait_until(self, condition: Callable[[], bool], at_most_s: float = PATIENCE_S, what: str = "") -> None:
        """Runs the agent, or waits for it, until a condition holds; fails where it does not in time."""
        if not self._wait(condition, at_most_s):
            recent = "\n".join(f"  {p.stamp:.3f} {p.source}: {p.body}" for p in self.probe.packets(channel=LOG)[-15:])
            raise AssertionError(
                f"{self.name}: {what or 'it'} did not come within {at_most_s:g} s; last on log:\n{recent}"
            )

    def events(self, kind: str = "", **fields: Any) -> list[Mapping[str, Any]]:
        """Returns the events so far, each as its fields with its `kind`, in order."""
        return [
            {"kind": packet.body.kind, **packet.body.fields}
            for packet in self.probe.packets(Event, _event(kind, fields), channel=LOG)
        ]

    def lines(self, level: str = "") -> list[str]:
        """Returns the lines on `log` so far."""
        return [
            packet.body.text for packet in self.probe.packets(LogLine, lambda body: not level or body.level == level)
        ]

    def stop(self) -> None:
        """Stops the agent in good order."""
        self.agent.stop()


def _event(kind: str, fields: Mapping[str, Any]) -> Where:
    def fits(event: Event) -> bool:
        return (not kind or event.kind == kind) and all(event.fields.get(key) == fields[key] for key in fields)

    return fits


def _with_probe(agent: Agent) -> Probe:
    probe = agent.kernel.spawn(Probe, join(agent.name, "test", "Probe"))
    assert isinstance(probe, Probe)
    return probe


class FleetInTest:
    """Agents in virtual time, on one thread and on a network in memory, twice the same for the same seed.

    Args:
        seed: draws the order of the actors, jitter, and the journals' identities.
        quality: how well agents hear each other.
        classes: tasks, services and drivers that configurations may name, by name; those that are passed to `start`
            are added under `test.ClassName`, for every agent of the fleet.

    Attributes:
        fleet: the fleet itself.
        agents: the agents that run, by name.
    """

    def __init__(
        self, seed: int = 0, quality: Quality | None = None, classes: Mapping[str, type] | None = None
    ) -> None:
        self._classes = dict(classes or {})
        self._plugins: dict[str, Plugins] = {}
        self.fleet = VirtualFleet(seed, quality)
        self.network = self.fleet.network
        self.agents: dict[str, AgentInTest] = {}
        self._configs: dict[str, Config] = {}

    def __enter__(self) -> FleetInTest:
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
        settle: bool = True,
        **agent: Any,
    ) -> AgentInTest:
        """Starts an agent, and waits until all that should run at its start does.

        It listens at `tcp://NAME:7400` and knows all agents that the fleet ever had.

        Args:
            name: its name.
            text: its configuration as TOML; `schema` and `[agent]` may be left out.
            tasks: tasks by name, besides those of `text`: a class, or a mapping with a class or entry point name as
                `type` and the other keys of `[task.NAME]`.
            devices: devices by name, likewise with drivers.
            services: services by name, likewise; a default service may be given with its settings alone.
            settle: whether to wait until it is ready.
            agent: keys of `[agent]`, and `speed` and `hold` of `[clock]`.
        """
        addresses = [config.agent.listen for other, config in self._configs.items() if other != name]
        agent = {"listen": f"tcp://{name}:7400", "peers": tuple(addresses), **agent}
        parts = _parts(name, text, tasks, devices, services, agent)
        self._classes.update(parts.classes)
        self._configs[name] = parts.config
        return self._start(parts.config, settle)

    def restart(self, name: str, settle: bool = True) -> AgentInTest:
        """Starts an agent again that was stopped or has crashed, with the configuration and the disk that it had."""
        config = self._configs[name]
        addresses = [other.agent.listen for known, other in self._configs.items() if known != name]
        return self._start(replace(config, agent=replace(config.agent, peers=tuple(addresses))), settle)

    def _start(self, config: Config, settle: bool) -> AgentInTest:
        probes: list[Probe] = []
        plugins = registered(self._classes)
        self._plugins[config.agent.name] = plugins

        def make(virtual: Any) -> Agent:
            agent = Agent(config, plugins, virtual)
            probes.append(_with_probe(agent))
            self.fleet.dispatcher.settle()  # it listens before the agent says anything
            return agent

        made = self.fleet.add(config.agent.name, make)
        found = AgentInTest(made, probes[0], lambda condition, at_most_s: self.run_until(condition, at_most_s))
        self.agents[config.agent.name] = found
        if settle:
            found.wait_until(made.ready.is_set, what="readiness")
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
        """Runs all agents until a condition holds; returns whether it came to hold."""
        return self.fleet.run_while(lambda: not condition(), at_most_s)

    def connect(self, at_most_s: float = PATIENCE_S) -> None:
        """Runs until every agent has a link to every other."""

        def meshed() -> bool:
            return all(len(agent.agent.mesh.connected()) == len(self.agents) - 1 for agent in self.agents.values())

        assert self.run_until(meshed, at_most_s), f"no full mesh within {at_most_s:g} s"

    def close(self) -> None:
        """Stops all agents."""
        self.fleet.close()
        self.agents.clear()


@contextmanager
def threaded_agent(
    name: str = "a",
    text: str = "",
    *,
    tasks: Mapping[str, Any] | None = None,
    devices: Mapping[str, Any] | None = None,
    services: Mapping[str, Any] | None = None,
    classes: Mapping[str, type] | None = None,
    state_dir: Path | None = None,
    **agent: Any,
) -> Iterator[AgentInTest]:
    """Runs an agent on threads and in real time, as on a robot, and stops it at the end of the `with`.

    Args:
        name, text, tasks, devices, services, agent: as for `FleetInTest.start`; it listens nowhere unless it is told.
        classes: classes that `text` names, by name.
        state_dir: its state directory; None: one that is removed afterwards.
    """
    with tempfile.TemporaryDirectory(prefix="pancakes-test-") as directory:
        agent = {"state_dir": str(state_dir or Path(directory) / name), **agent}
        parts = _parts(name, text, tasks, devices, services, agent)
        made = Agent(parts.config, registered({**(classes or {}), **parts.classes}))
        probe = _with_probe(made)
        found = AgentInTest(made, probe, probe.wait)
        made.start()
        try:
            assert made.ready.wait(PATIENCE_S), f"{name} was not ready within {PATIENCE_S:g} s"
            yield found
        finally:
            made.stop()


@contextmanager
def no_thread_left(at_most_s: float = 5.0) -> Iterator[None]:
    """Fails where threads that began inside of the `with` have not ended at its end, or shortly after."""
    before = threading.enumerate()
    yield
    clock = MonotonicClock()
    until_s = clock.now() + at_most_s
    left = [thread for thread in threading.enumerate() if thread not in before]
    for thread in left:
        thread.join(max(0.0, until_s - clock.now()))
    names = [thread.name for thread in left if thread.is_alive()]
    assert not names, f"threads are left: {', '.join(names)}"
