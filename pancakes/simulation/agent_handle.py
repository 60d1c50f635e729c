"""Ask one agent of this process: publish, wait for packets and replies, read its tasks, its events and its log.

`Probe` is an actor in the agent that records every packet it receives. `AgentHandle` is what programs and tests use.
Both work in virtual time, where a wait runs all actors, and on threads, where a wait blocks the caller.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Mapping
from typing import Any, Final, Self

from pancakes.agent.agent import Agent
from pancakes.control import Reply
from pancakes.durable.bidding_messages import MIGRATOR
from pancakes.errors import PancakesError
from pancakes.events import Event, LogLine, line_of, record_of
from pancakes.kernel.actor import ActorCore
from pancakes.kernel.handlers import Subscription, drop_oldest
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Mailbox
from pancakes.packet import LOG, SYSCTRL, Packet, covers, join, type_name
from pancakes.supervision.service_core import ServiceCore
from pancakes.supervision.slots import Slot, describe_task

KEEP = drop_oldest(1_000_000)
LOOK_S = 0.02
"""How often, in host time, a wait on threads checks its condition if no packet comes."""

BodyTest = Callable[[Any], bool]
"""Return whether a packet's body is the one that is meant."""


class Probe(ActorCore):
    """Listen to channels as an actor, and record every packet in the order in which it came.

    Any thread may read the recorded packets, and publish.

    Args:
        kernel: the kernel that it belongs to.
        address: its address.
        mailbox: None for one of its own.
        channels: what to listen to; by default all channels, including those that are opened later.
    """

    def __init__(
        self, kernel: Kernel, address: str, mailbox: Mailbox | None = None, *, channels: tuple[str, ...] = ()
    ) -> None:
        super().__init__(kernel, address, mailbox)
        self._channels = channels
        self._news = threading.Condition()
        self._received: list[Packet] = []
        self._listens = False
        self._followed: set[str] = set()

    def on_start(self) -> None:
        for channel in self._channels:
            self.follow(channel)
        if not self._channels:
            self.kernel.stream.each_channel(self.follow)
        with self._news:
            self._listens = True
            self._news.notify_all()

    def listening(self) -> bool:
        """Return whether it has started: it receives whatever is published from then on."""
        return self._listens

    def follow(self, channel: str) -> None:
        """Listen to one more channel. Any thread."""
        with self._news:
            known = channel in self._followed
            self._followed.add(channel)
        if known:  # it was closed, and is there again
            self.kernel.stream.subscribe(self.address, self.actor_inbox, Subscription(channel, None, KEEP))
        else:
            self.subscribe(channel, None, self._receive, queue=KEEP)

    def _receive(self, packet: Packet) -> None:
        with self._news:
            self._received.append(packet)
            self._news.notify_all()

    def packets(
        self, body: type | None = None, where: BodyTest | None = None, *, channel: str = "", source: str = ""
    ) -> list[Packet]:
        """Return the packets so far.

        Args:
            body: only packets of this type.
            where: only those for whose body it returns True.
            channel: only those on this channel.
            source: only those of this publisher.
        """
        name = type_name(body) if body is not None else ""
        with self._news:
            received = list(self._received)
        return [
            packet
            for packet in received
            if (not name or packet.type == name)
            and (not channel or packet.channel == channel)
            and (not source or packet.source == source)
            and (where is None or where(packet.body))
        ]

    def forget(self) -> None:
        """Drop the packets so far."""
        with self._news:
            self._received.clear()

    def wait(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Wait until a condition is true; actors must not call it.

        In virtual time it runs all actors meanwhile. On threads it checks the condition with each packet, and every
        `LOOK_S`.

        Args:
            condition: is called in this thread.
            timeout_s: how long to wait: virtual seconds, or seconds of the host.

        Returns:
            Whether it became true in time.
        """
        virtual = self.kernel.virtual
        if virtual is not None:
            return virtual.run_until(virtual.clock.now() + timeout_s, condition)
        host = self.kernel.host
        until_s = host.now() + timeout_s
        with self._news:
            while not condition():
                left_s = until_s - host.now()
                if left_s <= 0.0:
                    return False
                self._news.wait(min(left_s, LOOK_S))
        return True


PATIENCE_S = 10.0
"""How long, in the time of the agent, to wait for something before that fails."""
OWN_ACTORS: Final = ("client", "device", "log", "network", MIGRATOR)
"""Pancakes' own actors, by their addresses on an agent, besides those at `kernel` and below it."""


class SimulationError(PancakesError):
    """A simulation cannot do what it is asked."""


class NotInTimeError(SimulationError, AssertionError):
    """What was waited for did not come in time, or is not there. In a test it is a failure, as any `AssertionError`."""


class AgentHandle:
    """Control and observe one agent of this process.

    Attributes:
        agent: the agent itself.
        may_fail: those of Pancakes' own actors that a test makes fail on purpose: `client`, `kernel/Courier`. If
            another one of them fails, the test fails at the end of its `Fleet` or `threaded_agent`.
    """

    def __init__(self, agent: Agent, probe: Probe | None = None) -> None:
        self.agent = agent
        self.may_fail: set[str] = set()
        self._probe = probe
        self._outcomes: list[BaseException] = []
        agent.kernel.unraised = self._outcomes.append

    @classmethod
    def with_probe(cls, agent: Agent, channels: tuple[str, ...] = ()) -> Self:
        """Add a probe to an agent that has not been started yet.

        Args:
            agent: the agent.
            channels: what the probe listens to; empty: everything.
        """
        probe = agent.kernel.spawn(Probe, join(agent.name, "test", "Probe"), channels=channels)
        assert isinstance(probe, Probe)
        return cls(agent, probe)

    @property
    def probe(self) -> Probe:
        """The actor that records what is published on the agent, from its start on."""
        if self._probe is None:
            raise SimulationError(f"{self.name} was started without a probe: start it with one")
        return self._probe

    @property
    def name(self) -> str:
        """The agent's name."""
        return self.agent.name

    @property
    def kernel(self) -> Kernel:
        """The agent's kernel."""
        return self.agent.kernel

    def component(self, path: str) -> Any:
        """Return the core of the service or task at `service` or `service/task`; None: it does not run."""
        return self.kernel.registry.get(join(self.name, path))

    def task(self, name: str, service: str = "client") -> Any:
        """Return the actor of a running task.

        In virtual time nothing else runs meanwhile: read its `state` and `settings`, and change nothing.
        """
        found = self.component(join(service, name))
        if found is None:
            raise NotInTimeError(f"{name} does not run on {self.name}, only {self.running()}")
        return found.facade

    def running(self, service: str = "client") -> list[str]:
        """Return the names of the tasks of a service that have an actor."""
        prefix = join(self.name, service) + "/"
        return [
            component.name for component in self.kernel.registry.components() if component.address.startswith(prefix)
        ]

    def tasks(self) -> list[dict[str, Any]]:
        """Return a description of each of its tasks, as `pancakes task list --json` prints it."""
        return [describe_task(self.kernel, entry) for entry in self.kernel.tasks.all()]

    def publish(self, channel: str, body: Any, to: str = "") -> Packet:
        """Publish a packet in the probe's name; see `Component.publish`."""
        return self.probe.publish(channel, body, to)

    def ask(self, body: Any, to: str = "", timeout_s: float = PATIENCE_S) -> Reply:
        """Publish a control packet, and wait for the reply.

        Args:
            body: the control packet's body.
            to: the agent that it is for; empty: this one.
            timeout_s: how long to wait.
        """
        asked = self.publish(SYSCTRL, body, to)
        return self.reply_to(asked, timeout_s)

    def reply_to(self, asked: Packet, timeout_s: float = PATIENCE_S) -> Reply:
        """Wait for the reply to a control packet that the probe has published."""
        cause = (asked.source, asked.seq)

        def replies() -> list[Packet]:
            return [packet for packet in self.probe.packets(Reply) if packet.cause == cause]

        self.wait_until(lambda: bool(replies()), timeout_s, f"a reply to {asked.body}")
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
        timeout_s: float = PATIENCE_S,
    ) -> Packet:
        """Wait until a packet is published, and return the first that fits; see `Probe.packets`."""

        def found() -> list[Packet]:
            return self.probe.packets(body, where, channel=channel, source=source)

        self.wait_until(lambda: bool(found()), timeout_s, f"a packet of the type {type_name(body)!r}")
        return found()[0]

    def wait_for_event(self, kind: str, timeout_s: float = PATIENCE_S, **fields: Any) -> Mapping[str, Any]:
        """Wait for an event with these fields, and return all of its fields."""
        fits = _event(kind, fields)
        packet = self.wait_for(Event, fits, channel=LOG, timeout_s=timeout_s)
        assert isinstance(packet.body, Event)
        return packet.body.fields

    def wait_until(self, condition: Callable[[], bool], timeout_s: float = PATIENCE_S, what: str = "") -> None:
        """Run the agent, or wait for it, until a condition is true.

        Raises:
            NotInTimeError: it did not become true; the message ends with the last lines of the log.
        """
        if not self.probe.wait(condition, timeout_s):
            raise NotInTimeError(
                f"{self.name}: {what or 'it'} did not come within {timeout_s:g} s; last on log:\n{self.log_tail(15)}"
            )

    def events(self, kind: str = "", **fields: Any) -> list[Mapping[str, Any]]:
        """Return the events so far, each as its fields with its `kind`, in order."""
        return [
            {"kind": packet.body.kind, **packet.body.fields}
            for packet in self.probe.packets(Event, _event(kind, fields), channel=LOG)
        ]

    def lines(self, level: str = "") -> list[str]:
        """Return the lines on `log` so far."""
        return [
            packet.body.text for packet in self.probe.packets(LogLine, lambda body: not level or body.level == level)
        ]

    def log_tail(self, count: int = 30) -> str:
        """Return the last lines and events on its `log`, one a line, as its log file has them."""
        return "\n".join(line_of(record_of(packet)) for packet in self.probe.packets(channel=LOG)[-count:])

    def slot(self, name: str, service: str = "client") -> Slot:
        """Return the slot of a task in its service."""
        owner = self.component(service)
        assert isinstance(owner, ServiceCore), f"{self.name} has no service {service}"
        return owner.slots[name]

    def stop(self) -> None:
        """Stop the agent gracefully."""
        self.agent.stop()

    # At the end of a test --------------------------------------------------------------------------------------

    def raise_outcome(self) -> None:
        """End the test if a task on a thread has asked for that, by `pytest.fail` or `pytest.skip`."""
        outcomes = sys.modules.get("_pytest.outcomes")  # the tests may be run by something else
        for error in self._outcomes:
            if outcomes is not None and isinstance(error, outcomes.OutcomeException):
                raise error

    def failures(self) -> list[str]:
        """Return how Pancakes' own actors on this agent have failed, without `may_fail`.

        Tasks and a user's services may fail.
        """
        own, kernel = [join(self.name, actor) for actor in OWN_ACTORS], join(self.name, "kernel")
        may = {join(self.name, actor) for actor in self.may_fail}
        failures = []
        for packet in self.probe.packets(LogLine, lambda line: bool(line.traceback)):
            address = packet.body.text.partition(" ")[0]
            if address not in may and (address in own or covers(kernel, address)):
                failures.append(packet.body.text)
        return failures

    def still_running(self) -> list[str]:
        """Return the addresses of the services and tasks that still run although the agent has ended."""
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
