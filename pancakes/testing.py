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
too: `Fleet` runs any number of agents in virtual time on one thread; `threaded_agent` runs one agent as it runs
on a robot. Both return an `AgentHandle`, so one test can cover both. No shipped module imports this one.
"""

from __future__ import annotations

import gc
import os
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from pancakes.agent.agent import Agent
from pancakes.config import Config
from pancakes.mesh.address import LOCAL
from pancakes.mesh.memory_network import Quality
from pancakes.packet import Packet, type_name
from pancakes.simulation.agent_handle import PATIENCE_S, AgentHandle, BodyTest, Probe
from pancakes.simulation.fleet import Faults, Fleet, assert_none_failed, build_config, config_of, registered
from pancakes.util.clock import MonotonicClock, VirtualClock

__all__ = [
    "AgentHandle",
    "Faults",
    "Fleet",
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


@contextmanager
def threaded_agent(
    name: str = "a",
    text: str = "",
    *,
    state_dir: Path | None = None,
    **parts: Any,
) -> Iterator[AgentHandle]:
    """Run an agent on threads and in real time, as on a robot, and stop it at the end of the `with`.

    Args:
        name: its name. It listens at `local://NAME` as well, where the other agents of this process find it.
        text: its configuration as TOML; `schema` and `[agent]` may be left out.
        state_dir: its state directory; None: one that is removed afterwards.
        parts: `tasks`, `devices`, `services`, `classes` and keys of `[agent]` and `[clock]`, as for `Fleet.start`.
    """
    with tempfile.TemporaryDirectory(prefix="pancakes-test-") as directory:
        made = build_config(name, text, state_dir=str(state_dir or Path(directory) / name), **parts)
        found = AgentHandle.with_probe(Agent(_apart(made.config), registered(made.classes)))
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
    """Return the folder in which only agents of this process find each other."""
    return tempfile.TemporaryDirectory(prefix="pancakes-test-")


def _apart(config: Config) -> Config:
    network = config.services["network"]
    transports = network.settings.get("transports", {})
    local = {"directory": _sockets().name, **transports.get(LOCAL, {})}
    settings = {**network.settings, "transports": {**transports, LOCAL: local}}
    return replace(config, services={**config.services, "network": replace(network, settings=settings)})


LEAK_PATIENCE_S = 2.0
"""How long, in seconds of the host, threads and actors may take to end."""
LOOK_S = 0.01
DESCRIPTORS = "/proc/self/fd"


class Leaks:
    """Find threads, actors and open files that were not there when this object was made.

    Threads and open files count for the whole process; actors only for the agents that it watches.
    """

    def __init__(self) -> None:
        self._threads = threading.enumerate()
        self._open = _open_descriptors()
        self._agents: list[Callable[[], Iterable[AgentHandle]]] = []

    def watch(self, agents: Callable[[], Iterable[AgentHandle]]) -> None:
        """Check agents that should have ended as well; `agents` is called for them each time."""
        self._agents.append(agents)

    def agents(self) -> list[AgentHandle]:
        """Return the agents that it watches."""
        return [agent for ask in self._agents for agent in ask()]

    def left(self, timeout_s: float = LEAK_PATIENCE_S, *, only_threads: bool = False) -> str:
        """Wait until nothing is left, or the time is up; return a sentence about what is left, empty if nothing is."""
        clock = MonotonicClock()
        until_s = clock.now() + timeout_s
        collected = False
        pause = threading.Event()
        while True:
            left = self._left(only_threads)
            if not left or clock.now() >= until_s:
                return left
            if not collected:
                # Slow, and therefore not for tests that are clean: objects without a reference are closed.
                gc.collect()
                collected = True
                continue
            pause.wait(LOOK_S)

    def _left(self, only_threads: bool) -> str:
        threads = [thread.name for thread in threading.enumerate() if thread not in self._threads]
        if only_threads:
            return f"threads are left: {', '.join(threads)}" if threads else ""
        actors = [address for agent in self.agents() for address in agent.still_running()]
        before = set(self._open)
        files = [
            f"{target} (descriptor {number})"
            for number, target in _open_descriptors()
            if (number, target) not in before
        ]
        kinds = (("threads", threads), ("actors", actors), ("sockets and files", files))
        return "; ".join(f"{kind} are left: {', '.join(names)}" for kind, names in kinds if names)


def _open_descriptors() -> list[tuple[int, str]]:
    """Return the open file descriptors of this process, and their targets; none if `/proc` is missing."""
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
def no_leak(timeout_s: float = LEAK_PATIENCE_S) -> Iterator[Leaks]:
    """Fail if threads, sockets or files that were made inside of the `with` are still there shortly after it.

    Agents that the `Leaks` watches must have ended too, with all of their actors.

    Args:
        timeout_s: how long, in seconds of the host, they may take to end.

    Raises:
        AssertionError: names what is left.
    """
    leaks = Leaks()
    yield leaks
    left = leaks.left(timeout_s)
    assert not left, left


@contextmanager
def no_thread_left(timeout_s: float = LEAK_PATIENCE_S) -> Iterator[None]:
    """Fail if threads that began inside of the `with` have not ended shortly after it; see `no_leak`."""
    leaks = Leaks()
    yield
    left = leaks.left(timeout_s, only_threads=True)
    assert not left, left


MOST_SHOWN = 20


def assert_published(
    probe: Probe | AgentHandle,
    body: type,
    where: BodyTest | None = None,
    *,
    channel: str = "",
    source: str = "",
    times: int | None = None,
    within_s: float | None = None,
) -> Packet:
    """Assert that a packet is published, and return the last one that fits.

    Without `times` it waits for the first packet that fits, if there is none yet. With `times` it looks at what there
    is at the end of `within_s`: all that was received so far counts.

    Args:
        probe: the probe that listens, or the agent that has it.
        body: its type.
        where: returns whether its body fits.
        channel: the channel on which it is published.
        source: the address of its publisher.
        times: how many there must be, neither more nor fewer; None: one or more.
        within_s: how long to wait, in virtual time or, on threads, in seconds of the host; None: 10 s, and with
            `times` not at all.

    Returns:
        The packet; one without a body if `times` is 0.

    Raises:
        AssertionError: names what was published instead.
    """
    listener = probe.probe if isinstance(probe, AgentHandle) else probe

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
    """Return what was published instead: packets of the same type, else what there was of each type."""
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
    """Return a packet as `pancakes channel echo` shows it, under a line with its channel and destination."""
    from pancakes.tools.cli.verbs.channel import record_of, text_of  # only for a test that fails

    to = f" to {packet.destination}" if packet.destination else ""
    try:
        text = text_of(record_of(agent, packet))
    except (TypeError, ValueError):  # what is published within one agent may contain anything
        text = (
            f"type: {packet.type}\nsource: {packet.source}\nstamp_s: {packet.stamp_s:.9g}\nbody: {packet.body!r}\n---"
        )
    return f"# {before}on {packet.channel}{to}\n{text}"
