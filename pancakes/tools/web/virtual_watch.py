"""Watch a fleet in virtual time from outside: the watch sends no packets, so the run does not change."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from typing import Any, Final

from pancakes.agent.agent import Agent
from pancakes.client.rates import RateMeter
from pancakes.control import Describe, Refusal, Reply
from pancakes.errors import ControlRefusedError, PancakesError, UnreachableError
from pancakes.kernel.stream import InformationStream
from pancakes.packet import CORE_CHANNELS, CTRL, LOG, SYSCTRL, SYSTEM, Cause, Packet, agent_of
from pancakes.recording.causal_chains import ActuatorCommand, CommandChains
from pancakes.recording.records import NANOSECONDS, RecordedPacket
from pancakes.services.root import Root
from pancakes.simulation.fleet import Fleet
from pancakes.supervision.lifecycle import State
from pancakes.supervision.service_core import ServiceCore
from pancakes.supervision.task_core import TaskCore
from pancakes.tools.web.command_causes import CommandExplainer
from pancakes.tools.web.feed import Feed
from pancakes.tools.web.watch import DETAIL_S, FOLLOWED, POSES
from pancakes.util.clock import MonotonicClock

HOST = MonotonicClock()
"""A person watches in host time, whatever the mission clock does."""

LOOK_S: Final = 1.0
"""How often the descriptions of the agents are read, in seconds of mission time."""
SLICE_S: Final = 0.05
"""How often the mission waits for the viewer's clock, in seconds of the viewer's time."""


class _OwnChannels:
    """Tap the channels that the tasks of an agent make; their packets can be plotted."""

    def __init__(self, stream: InformationStream, hear: Callable[[Packet], None]) -> None:
        self._stream = stream
        self._hear = hear
        self._tapped: set[str] = set()

    def tap(self) -> None:
        """Tap the channels that are new."""
        present = set(self._stream.channels()).difference(CORE_CHANNELS)
        for channel in sorted(present - self._tapped):
            self._stream.tap(channel, self._hear)
        self._tapped = present


class VirtualWatch:
    """Fill a feed with what a fleet in virtual time does, at a speed that a person can watch.

    It taps the packets in the agents' streams, and reads the agents' descriptions between two turns. Call its methods
    in the thread of the fleet, unless they say otherwise.

    Args:
        speed: mission seconds per second of the viewer.
        stopping: ends the waiting.
    """

    def __init__(self, speed: float, stopping: threading.Event) -> None:
        self.speed = speed
        self.feed = Feed(self._now)
        self._stopping = stopping
        self._fleet: Fleet | None = None
        self._time_s = 0.0
        self._began_s = HOST.now()
        self._over = False
        self._rates = RateMeter()
        self._looked_s = -LOOK_S
        self._detailed_s: dict[tuple[str, str, str], float] = {}
        self._stale: set[tuple[str, str, str]] = set()
        self._own_channels: dict[str, _OwnChannels] = {}
        self._questions: deque[tuple[str, Describe, Future[Reply]]] = deque()
        self._chains = CommandChains()
        self._explainer = CommandExplainer()

    def begin(self, fleet: Fleet) -> None:
        """Watch the agents of a fleet. Call this before anything runs."""
        self._fleet = fleet
        for handle in fleet.agents.values():
            self.joined(handle.agent)

    def joined(self, agent: Agent) -> None:
        """Watch an agent that was killed and is started again. Call this before it runs."""
        self._tap(agent)

    def slice_s(self) -> float:
        """Return how much virtual time may pass until the next `pace`."""
        return SLICE_S * self.speed

    def pace(self) -> None:
        """Show what has happened, and wait for the viewer's clock."""
        assert self._fleet is not None
        self._time_s = self._fleet.now()
        self._look()
        self._answer()
        self.feed.record()
        self._stopping.wait(max(0.0, self._began_s + self._now() - HOST.now()))

    def end(self) -> None:
        """End the watch at the end of the mission: the stop of the agents is not part of it."""
        self._over = True
        self._answer()
        with self.feed.lock:
            self._explain(self._chains.close())

    def explain(
        self, agent: str, type_: str = "", t: float | None = None, command: Cause | None = None, step: int = 0
    ) -> dict[str, Any] | None:
        """Return why an agent's actuator was commanded, see `CommandExplainer.explain`. Any thread."""
        with self.feed.lock:
            return self._explainer.explain(agent, type_, t, command, step)

    def look(self, agent: str, body: Describe, timeout_s: float) -> Future[Reply]:
        """Describe a task between two turns, see `Watch.order`. Any thread.

        Args:
            agent: the agent's name.
            body: the question; its target is `service/task`.
            timeout_s: not used: the mission runs in this process, and the next `pace` gives the answer.
        """
        answer: Future[Reply] = Future()
        self._questions.append((agent, body, answer))
        if self._over:  # `pace` is not called any more
            self._answer()
        return answer

    def _answer(self) -> None:
        while True:
            try:
                agent, body, answer = self._questions.popleft()
            except IndexError:
                return
            try:
                answer.set_result(Reply(None, self._described(agent, body)))
            except ControlRefusedError as error:
                answer.set_result(Reply(Refusal.of(error)))
            except PancakesError as error:
                answer.set_exception(error)

    def _described(self, agent: str, body: Describe) -> dict[str, Any]:
        """Return the description of a task, with its state if `body` asks for it.

        Raises:
            ControlRefusedError: the task does not exist, does not run and so has no state, or its state cannot be
                encoded.
            UnreachableError: the mission is over, or the agent was killed.
        """
        if self._over:
            raise UnreachableError("the mission is over: its agents no longer answer")
        assert self._fleet is not None
        if agent not in self._fleet.agents:
            raise UnreachableError(f"{agent} cannot be reached")
        service, _, name = body.target.partition("/")
        owner = self._fleet.agents[agent].kernel.registry.get(f"{agent}/{service}")
        if not isinstance(owner, ServiceCore) or name not in owner.slots:
            raise ControlRefusedError(f"{agent} has no task {body.target!r}")
        slot = owner.slots[name]
        described = owner.describe_in_detail(slot)
        if not body.state:
            return described
        if not isinstance(slot.task, TaskCore) or slot.life.state is not State.RUNNING:
            raise ControlRefusedError(f"{slot.address} is {slot.life.word}, not running")
        return {**described, **slot.task.describe_state(body)}

    def _now(self) -> float:
        return self._time_s / self.speed

    def _tap(self, agent: Agent) -> None:
        name, stream = agent.name, agent.kernel.stream

        def trace(packet: Packet) -> None:
            if packet.channel not in (LOG, SYSCTRL):
                self._explain(
                    self._chains.add(RecordedPacket(int(agent.kernel.host.now() * NANOSECONDS), name, packet))
                )

        def leaves(packet: Packet) -> None:
            if not self._over:
                with self.feed.lock:
                    trace(packet)

        def hear(packet: Packet) -> None:
            if self._over:
                return
            own = agent_of(packet.source) == name
            t = agent.kernel.host.now() / self.speed
            with self.feed.lock:
                trace(packet)
                if own and (packet.channel == LOG or packet.type in FOLLOWED + POSES):
                    self.feed.model.hear(name, packet, t)
                    if packet.type == "event":
                        self._notice(packet)
                elif packet.channel != LOG:
                    self.feed.model.series.take(packet, t)

        def plot(packet: Packet) -> None:
            if not self._over:
                with self.feed.lock:
                    self.feed.model.series.take(packet, agent.kernel.host.now() / self.speed)

        for channel in (LOG, SYSTEM, CTRL):
            stream.tap(channel, hear)
        self._own_channels[name] = _OwnChannels(stream, plot)
        # A packet that leaves for another agent is not on a channel here.
        stream.tap_outgoing(leaves)

    def _explain(self, commands: Iterable[ActuatorCommand]) -> None:
        new = self._explainer.add((it.time_ns / NANOSECONDS / self.speed, it) for it in commands)
        for agent in new:
            self.feed.model.commanded(agent, self._explainer.actuators(agent))

    def _notice(self, packet: Packet) -> None:
        agent, service, task = (*packet.source.split("/"), "", "")[:3]
        self._stale.add((agent, service, task or str(packet.body.fields.get("task", ""))))

    def _look(self) -> None:
        assert self._fleet is not None
        if self._time_s - self._looked_s < LOOK_S:
            return
        self._looked_s = self._time_s
        for own in self._own_channels.values():
            own.tap()
        described = []
        for agent in (handle.agent for handle in self._fleet.agents.values()):
            root = agent.kernel.registry.get(f"{agent.name}/kernel")
            if isinstance(root, Root) and agent.config.agent.role != "client":
                description = root.describe()
                # The speed of mission time as the viewer sees it.
                described.append({**description, "speed": description["speed"] * self.speed})
        with self.feed.lock:
            self.feed.model.describe(self._rates.update(described), described, self._now())
            running = self.feed.model.running()
        for key in running:
            if key in self._stale or self._time_s - self._detailed_s.get(key, -DETAIL_S) >= DETAIL_S:
                self._detailed_s[key] = self._time_s
                self._detail(*key)
        self._stale.clear()

    def _detail(self, agent: str, service: str, task: str) -> None:
        for state in (True, False):  # a state can contain anything; without it, the rest is shown
            try:
                self.feed.take_detail(agent, self._described(agent, Describe(f"{service}/{task}", state)))
                return
            except PancakesError:  # the state cannot be encoded, or the agent was killed
                continue
