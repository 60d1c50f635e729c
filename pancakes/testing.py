"""Test tasks, services and drivers: agents built in code, virtual time, faults, and a probe that listens.

    from pancakes.testing import assert_published

    class Blink(Task):
        @every(hz=2)
        def blink(self, tick):
            self.publish("system", Load(0.5))

    def test_it_blinks_twice_a_second(virtual_agent):
        agent = virtual_agent(tasks={"Blink": Blink})
        assert_published(agent, Load, times=20, within_s=10.0)
        assert agent.ask(Stop("Blink")).ok

pytest finds the fixtures (docs/testing.md) by the entry point `pancakes.pytest_plugin`. Everything works without pytest
too: `FleetInTest` runs any number of agents in virtual time on one thread; `threaded_agent` runs one agent as it runs
on a robot. Both hand out an `AgentInTest`, so one test can cover both. No shipped module imports this one.
"""

from __future__ import annotations

import gc
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Final

from msgspec.structs import replace

from pancakes.agent.agent import Agent
from pancakes.config import Config
from pancakes.durable.bidding_messages import MIGRATOR
from pancakes.events import LogLine
from pancakes.fleet import Faults
from pancakes.mesh.address import LOCAL
from pancakes.mesh.memory_network import Quality
from pancakes.packet import LOG, Packet, covers, join, type_name
from pancakes.service import Service
from pancakes.simulation.agent_handle import PATIENCE_S, AgentHandle, BodyTest, Probe
from pancakes.simulation.fleet_builder import BuiltFleet, config_of, parts, registered
from pancakes.supervision.slots import Slot
from pancakes.util.clock import MonotonicClock, VirtualClock

__all__ = [
    "AgentInTest",
    "Faults",
    "FleetInTest",
    "Probe",
    "Quality",
    "VirtualClock",
    "assert_published",
    "config_of",
    "no_leak",
    "no_thread_left",
    "registered",
    "threaded_agent",
]


OWN: Final = ("client", "device", "log", "network", MIGRATOR)
"""Pancakes' own actors, by their addresses on an agent, besides those at `kernel` and below it."""


class AgentInTest(AgentHandle):
    """One agent, and what a test asks of it; what does not come in time fails the test.

    Attributes:
        may_fail: those of Pancakes' own actors that the test itself makes fail: `client`, `kernel/Courier`. Where
            another one of these fails, `FleetInTest` and `threaded_agent` fail the test at its end.
    """

    failure: ClassVar[type[Exception]] = AssertionError

    def __init__(self, agent: Agent, probe: Probe) -> None:
        super().__init__(agent, probe)
        self.may_fail: set[str] = set()
        self._outcomes: list[BaseException] = []
        agent.kernel.unraised = self._outcomes.append

    def raise_outcome(self) -> None:
        """Ends the test as a task on a thread has asked for, by `pytest.fail` or `pytest.skip`."""
        outcomes = sys.modules.get("_pytest.outcomes")  # the tests may be run by something else
        for error in self._outcomes:
            if outcomes is not None and isinstance(error, outcomes.OutcomeException):
                raise error

    def failures(self) -> list[str]:
        """Returns how Pancakes' own actors on this agent have failed that may not. Tasks and a user's services may."""
        own, kernel = [join(self.name, actor) for actor in OWN], join(self.name, "kernel")
        may = {join(self.name, actor) for actor in self.may_fail}
        failures = []
        for packet in self.probe.packets(LogLine, lambda line: bool(line.traceback)):
            address = packet.body.text.partition(" ")[0]
            if address not in may and (address in own or covers(kernel, address)):
                failures.append(packet.body.text)
        return failures

    def slot(self, name: str, service: str = "client") -> Slot:
        """Returns the place of a task in its service."""
        owner = self.component(service)
        assert isinstance(owner, Service), f"{self.name} has no service {service}"
        return owner.slots[name]

    def log_tail(self, count: int = 30) -> str:
        """Returns the last lines and events on its `log`, one a line, as `pancakes log` shows them."""
        from click import unstyle  # only where something went wrong

        from pancakes.services.log import record_of
        from pancakes.tools.cli.verbs.log import text_of

        return "\n".join(unstyle(text_of(record_of(packet))) for packet in self.probe.packets(channel=LOG)[-count:])

    def stop(self) -> None:
        """Stops the agent in good order."""
        self.agent.stop()

    def left(self) -> list[str]:
        """Returns the addresses of the services and tasks that still run although the agent has ended."""
        if not self.agent.stopping.is_set():
            return [f"{self.name} (the whole agent)"]
        own = (join(self.name, "kernel"), join(self.name, "test"))  # these end with the kernel's threads
        return [
            component.address
            for component in self.kernel.registry.components()
            if not component.actor_stopped.is_set() and not any(covers(place, component.address) for place in own)
        ]


def assert_none_failed(agents: Iterable[AgentInTest]) -> None:
    """Fails a test in which actors of Pancakes' own have failed that may not."""
    failures = [failure for agent in agents for failure in agent.failures()]
    assert not failures, "\n".join(["actors of Pancakes' own have failed, and are not in `may_fail`:", *failures])


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
        name, text, tasks, devices, services, agent: as for `FleetInTest.start`. It listens at `local://NAME`
            as well, where the other agents of this process find it.
        classes: classes that `text` names, by name.
        state_dir: its state directory; None: one that is removed afterwards.
    """
    with tempfile.TemporaryDirectory(prefix="pancakes-test-") as directory:
        agent = {"state_dir": str(state_dir or Path(directory) / name), **agent}
        made = parts(name, text, tasks, devices, services, agent)
        found = AgentInTest.on(Agent(_apart(made.config), registered({**(classes or {}), **made.classes})))
        found.agent.start()
        try:
            assert found.agent.ready.wait(PATIENCE_S), f"{name} was not ready within {PATIENCE_S:g} s"
            yield found
        except AssertionError:  # often because the test waited for a task that has ended it
            found.raise_outcome()
            raise
        finally:
            found.stop()
        found.raise_outcome()
        assert_none_failed([found])


@cache
def _sockets() -> tempfile.TemporaryDirectory[str]:
    """Returns where agents of this process find each other, apart from all others of the machine."""
    return tempfile.TemporaryDirectory(prefix="pancakes-test-")


def _apart(config: Config) -> Config:
    network = config.services["network"]
    transports = network.settings.get("transports", {})
    local = {"directory": _sockets().name, **transports.get(LOCAL, {})}
    settings = {**network.settings, "transports": {**transports, LOCAL: local}}
    return replace(config, services={**config.services, "network": replace(network, settings=settings)})


class FleetInTest(BuiltFleet[AgentInTest]):
    """Agents in virtual time in a test: what does not come in time fails it.

    So does an actor of Pancakes' own that fails (see `AgentInTest.may_fail`): the end of the `with` raises an
    `AssertionError` then, unless it ends with another exception.
    """

    handle: ClassVar[type[Any]] = AgentInTest

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        if error[0] is None:
            assert_none_failed(self.started)


LEAK_PATIENCE_S = 2.0
"""How long, in seconds of the host, what was told to end may take for that."""
LOOK_S = 0.01
DESCRIPTORS = "/proc/self/fd"


class Leaks:
    """Compares what there is with what there was when this object was made.

    Threads and open files count for the whole process; actors only for the agents that it watches.
    """

    def __init__(self) -> None:
        self._threads = threading.enumerate()
        self._open = _open_descriptors()
        self._agents: list[Callable[[], Iterable[AgentInTest]]] = []

    def watch(self, agents: Callable[[], Iterable[AgentInTest]]) -> None:
        """Tells of agents that should have ended; `agents` is asked for them each time."""
        self._agents.append(agents)

    def agents(self) -> list[AgentInTest]:
        """Returns the agents that it watches."""
        return [agent for ask in self._agents for agent in ask()]

    def left(self, at_most_s: float = LEAK_PATIENCE_S) -> str:
        """Waits until nothing is left, or the time is up, and says what is left then; empty: nothing."""
        clock = MonotonicClock()
        until_s = clock.now() + at_most_s
        collected = False
        pause = threading.Event()
        while True:
            left = self._left()
            if not left or clock.now() >= until_s:
                return left
            if not collected:
                # Slow, and therefore not for tests that are clean: objects without a reference are closed.
                gc.collect()
                collected = True
                continue
            pause.wait(LOOK_S)

    def _left(self) -> str:
        threads = [thread.name for thread in threading.enumerate() if thread not in self._threads]
        actors = [address for agent in self.agents() for address in agent.left()]
        before = set(self._open)
        files = [
            f"{target} (descriptor {number})"
            for number, target in _open_descriptors()
            if (number, target) not in before
        ]
        kinds = (("threads", threads), ("actors", actors), ("sockets and files", files))
        return "; ".join(f"{kind} are left: {', '.join(names)}" for kind, names in kinds if names)


def _open_descriptors() -> list[tuple[int, str]]:
    """Returns the open file descriptors of this process, and what they lead to; nothing where Linux does not tell."""
    found = []
    try:
        numbers = sorted(int(name) for name in os.listdir(DESCRIPTORS))
    except OSError:
        return []
    for number in numbers:
        try:
            found.append((number, os.readlink(f"{DESCRIPTORS}/{number}")))
        except OSError:
            continue  # the one that the listing itself had open
    return found


@contextmanager
def no_leak(at_most_s: float = LEAK_PATIENCE_S) -> Iterator[Leaks]:
    """Fails where threads, sockets or files that came to be inside of the `with` are still there shortly after it.

    Agents that the `Leaks` watches must have ended too, with all of their actors.

    Args:
        at_most_s: how long, in seconds of the host, they may take to end.

    Raises:
        AssertionError: names what is left.
    """
    leaks = Leaks()
    yield leaks
    left = leaks.left(at_most_s)
    assert not left, left


@contextmanager
def no_thread_left(at_most_s: float = LEAK_PATIENCE_S) -> Iterator[None]:
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


MOST_SHOWN = 20


def assert_published(
    probe: Probe | AgentInTest,
    body: type,
    where: BodyTest | None = None,
    *,
    channel: str = "",
    source: str = "",
    times: int | None = None,
    within_s: float | None = None,
) -> Packet:
    """Asserts that a packet is published, and returns the last one that fits.

    Without `times` it waits for the first packet that fits, if there is none yet. With `times` it looks at what there
    is at the end of `within_s`: all that has been heard so far counts.

    Args:
        probe: the probe that listens, or the agent that has it.
        body: its type.
        where: says yes to its body.
        channel: where it is published.
        source: the address of its publisher.
        times: how many there must be, neither more nor fewer; None: one or more.
        within_s: how long to wait, in virtual time or, on threads, in seconds of the host; None: 10 s, and with
            `times` not at all.

    Returns:
        The packet; one without a body where `times` is 0.

    Raises:
        AssertionError: names what was published instead.
    """
    listener = probe.probe if isinstance(probe, AgentInTest) else probe

    def found() -> list[Packet]:
        return listener.packets(body, where, channel=channel, source=source)

    limit_s = within_s if within_s is not None else PATIENCE_S if times is None else 0.0
    if times is None:
        listener.wait(lambda: bool(found()), limit_s)
    elif limit_s > 0.0:
        listener.wait(lambda: len(found()) > times, limit_s)
    fitting = found()
    if (times is None and fitting) or len(fitting) == times:
        return fitting[-1] if fitting else Packet("", "", "", "", 0.0, 0, None)
    wanted = "at least one" if times is None else str(times)
    name = type_name(body)
    fits = "packet of the type {!r} fits" if len(fitting) == 1 else "packets of the type {!r} fit"
    limits = [f"on {channel}"] * bool(channel) + [f"of {source}"] * bool(source) + ["that `where` takes"] * bool(where)
    waited = f"within {limit_s:g} s " if limit_s > 0.0 else ""
    raise AssertionError(
        f"{len(fitting)} {fits.format(name)}, {wanted} wanted {waited}on {listener.agent}"
        + (f" ({', '.join(limits)})" if limits else "")
        + f"; {_instead(listener, name, listener.packets(body))}"
    )


def _instead(listener: Probe, name: str, same: Sequence[Packet]) -> str:
    """Says what was published instead: packets of the same type, or else what there was of each type."""
    if same:
        first = f"of the type {name!r} there were {len(same)}, the last of them:\n"
        return first + "\n".join(_document(listener.agent, packet) for packet in same[-MOST_SHOWN:])
    by_type: dict[tuple[str, str, str], list[Packet]] = {}
    for packet in listener.packets():
        by_type.setdefault((packet.type, packet.channel, packet.source), []).append(packet)
    if not by_type:
        return "nothing at all was published"
    shown = [
        _document(listener.agent, packets[-1], f"the last of {len(packets)} ")
        for packets in list(by_type.values())[:MOST_SHOWN]
    ]
    more = f"\nand {len(by_type) - MOST_SHOWN} more" if len(by_type) > MOST_SHOWN else ""
    return "none of this type; what was published instead:\n" + "\n".join(shown) + more


def _document(agent: str, packet: Packet, before: str = "") -> str:
    """Returns a packet as `pancakes channel echo` shows it, under a line that says where it went."""
    from pancakes.tools.cli.verbs.channel import record_of, text_of  # only where something went wrong

    to = f" to {packet.destination}" if packet.destination else ""
    try:
        text = text_of(record_of(agent, packet))
    except (TypeError, ValueError):  # what is published on one agent alone may contain anything
        text = f"type: {packet.type}\nsource: {packet.source}\nstamp: {packet.stamp:.9g}\nbody: {packet.body!r}\n---"
    return f"# {before}on {packet.channel}{to}\n{text}"
