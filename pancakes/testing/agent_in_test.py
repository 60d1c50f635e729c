"""One agent in a test, in virtual time or on threads."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, cast

from msgspec.structs import replace

from pancakes.control import Reply
from pancakes.events import Event, LogLine
from pancakes.mesh.address import LOCAL
from pancakes.packet import LOG, SYSCTRL, Packet, covers, join, type_name
from pancakes.runtime.agent import Agent
from pancakes.runtime.config import Config
from pancakes.runtime.kernel.component import Component
from pancakes.runtime.kernel.kernel import Kernel
from pancakes.runtime.supervision.slot import Slot
from pancakes.service import Service
from pancakes.testing.configuration import parts, registered
from pancakes.testing.probe import BodyTest, Probe

PATIENCE_S = 10.0
"""How long, in the time of the agent under test, a test waits for something before it fails."""


class AgentInTest:
    """One agent, and what a test asks of it.

    Attributes:
        agent: the agent itself.
        probe: hears everything on it, from its start on.
    """

    def __init__(self, agent: Agent, probe: Probe) -> None:
        self.agent = agent
        self.probe = probe

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
        return cast("Component | None", self.kernel.registry.get(join(self.name, path)))  # a test looks inside

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
        where: BodyTest | None = None,
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
        """Runs the agent, or waits for it, until a condition is true; fails where it is not in time."""
        if not self.probe.wait(condition, at_most_s):
            raise AssertionError(
                f"{self.name}: {what or 'it'} did not come within {at_most_s:g} s; last on log:\n{self.log_tail(15)}"
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

    def log_tail(self, count: int = 30) -> str:
        """Returns the last lines and events on its `log`, one a line, as `pancakes log` shows them."""
        from click import unstyle  # only where something went wrong

        from pancakes.runtime.services.log import record_of
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


def _event(kind: str, fields: Mapping[str, Any]) -> BodyTest:
    def fits(event: Event) -> bool:
        return (not kind or event.kind == kind) and all(event.fields.get(key) == fields[key] for key in fields)

    return fits


def with_probe(agent: Agent) -> AgentInTest:
    """Lets a probe listen on an agent that has not been started yet."""
    probe = agent.kernel.spawn(Probe, join(agent.name, "test", "Probe"))
    assert isinstance(probe, Probe)
    return AgentInTest(agent, probe)


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
        found = with_probe(Agent(_apart(made.config), registered({**(classes or {}), **made.classes})))
        found.agent.start()
        try:
            assert found.agent.ready.wait(PATIENCE_S), f"{name} was not ready within {PATIENCE_S:g} s"
            yield found
        finally:
            found.stop()


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
