"""Ask one agent of this process: publish, wait for packets and replies, read its tasks, its events and its log.

`Probe` is an actor in the agent that records every packet it hears. `AgentHandle` is the front that programs and tests
use. Both work in virtual time, where a wait runs all actors, and on threads, where a wait blocks the caller.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Self, cast

from pancakes.agent.agent import Agent
from pancakes.control import Reply
from pancakes.errors import PancakesError
from pancakes.events import Event, LogLine, line_of, record_of
from pancakes.kernel.actor import Component
from pancakes.kernel.handlers import Subscription, queue
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Mailbox
from pancakes.packet import LOG, SYSCTRL, Packet, join, type_name
from pancakes.supervision.slots import describe_task

KEEP = queue(1_000_000)
LOOK_S = 0.02
"""How often, in host time, a wait on threads looks at its condition where no packet comes."""

BodyTest = Callable[[Any], bool]
"""Says of a packet's body whether it is the one that is meant."""


class Probe(Component):
    """An actor that listens to channels and remembers every packet in the order in which it came.

    What it remembers may be asked for from any thread, and it may publish from any thread.

    Args:
        kernel: the kernel that it belongs to.
        address: its address.
        mailbox: None for one of its own.
        channels: what to listen to; the default are all channels, those too that are opened later.
    """

    def __init__(
        self, kernel: Kernel, address: str, mailbox: Mailbox | None = None, *, channels: tuple[str, ...] = ()
    ) -> None:
        super().__init__(kernel, address, mailbox)
        self._channels = channels
        self._news = threading.Condition()
        self._heard: list[Packet] = []
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
        """Returns whether it has started: whatever is published from then on, it hears."""
        return self._listens

    def follow(self, channel: str) -> None:
        """Listens to one more channel. Any thread."""
        with self._news:
            known = channel in self._followed
            self._followed.add(channel)
        if known:  # it was closed, and is there again
            self.kernel.stream.subscribe(self.address, self.actor_inbox, Subscription(channel, None, KEEP))
        else:
            self.subscribe(channel, None, self._hear, keep=KEEP)

    def _hear(self, packet: Packet) -> None:
        with self._news:
            self._heard.append(packet)
            self._news.notify_all()

    def packets(
        self, body: type | None = None, where: BodyTest | None = None, *, channel: str = "", source: str = ""
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
        """Waits until a condition is true; not to be called from an actor.

        In virtual time it runs all actors meanwhile. On threads it looks at the condition with each packet, and every
        now and then.

        Args:
            condition: is called in this thread.
            at_most_s: how long to wait: virtual seconds, or seconds of the host.

        Returns:
            Whether it became true in time.
        """
        virtual = self.kernel.virtual
        if virtual is not None:
            return virtual.run_while(lambda: not condition(), virtual.clock.now() + at_most_s)
        host = self.kernel.host
        until_s = host.now() + at_most_s
        with self._news:
            while not condition():
                left_s = until_s - host.now()
                if left_s <= 0.0:
                    return False
                self._news.wait(min(left_s, LOOK_S))
        return True


PATIENCE_S = 10.0
"""How long, in the time of the agent, a program waits for something before that fails."""


class SimulationError(PancakesError):
    """A simulation cannot do what it is asked, or what is waited for did not come in time."""


class AgentHandle:
    """One agent, and what a program asks of it.

    Attributes:
        agent: the agent itself.
        probe: hears what is published on it, from its start on.
    """

    failure: ClassVar[type[Exception]] = SimulationError
    """What is raised where something does not come in time, or is not there."""

    def __init__(self, agent: Agent, probe: Probe) -> None:
        self.agent = agent
        self.probe = probe

    @classmethod
    def on(cls, agent: Agent, channels: tuple[str, ...] = ()) -> Self:
        """Lets a probe listen on an agent that has not been started yet.

        Args:
            agent: the agent.
            channels: what the probe listens to; empty: everything.
        """
        probe = agent.kernel.spawn(Probe, join(agent.name, "test", "Probe"), channels=channels)
        assert isinstance(probe, Probe)
        return cls(agent, probe)

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
        return cast("Component | None", self.kernel.registry.get(join(self.name, path)))  # it looks inside

    def task(self, name: str, service: str = "client") -> Any:
        """Returns the actor of a task that runs; fails where it does not.

        In virtual time nothing else runs meanwhile: its `state` and `settings` may be read, and nothing be changed.
        """
        found = self.component(join(service, name))
        if found is None:
            raise self.failure(f"{name} does not run on {self.name}, only {self.running()}")
        return found

    def running(self, service: str = "client") -> list[str]:
        """Returns the names of the tasks of a service that have an actor."""
        prefix = join(self.name, service) + "/"
        return [
            component.name for component in self.kernel.registry.components() if component.address.startswith(prefix)
        ]

    def tasks(self) -> list[dict[str, Any]]:
        """Returns what is to be known about each of its tasks, as `pancakes task list --json` tells it."""
        return [describe_task(self.kernel, entry) for entry in self.kernel.tasks.all()]

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
            raise self.failure(
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
        """Returns the last lines and events on its `log`, one a line, as its log file has them."""
        return "\n".join(line_of(record_of(packet)) for packet in self.probe.packets(channel=LOG)[-count:])


def _event(kind: str, fields: Mapping[str, Any]) -> BodyTest:
    def fits(event: Event) -> bool:
        return (not kind or event.kind == kind) and all(event.fields.get(key) == fields[key] for key in fields)

    return fits
