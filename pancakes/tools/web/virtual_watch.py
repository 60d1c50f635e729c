"""Watch a fleet in virtual time from outside: it sends no packets to the agents, so the run stays the same."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable
from concurrent.futures import Future
from typing import Any, Final

from pancakes.agent.agent import Agent
from pancakes.client.rates import RateMeter
from pancakes.control import Describe, Refusal, Reply
from pancakes.errors import ControlRefused, PancakesError, Unreachable
from pancakes.packet import CTRL, LOG, SYSCTRL, SYSTEM, Cause, Packet, agent_of
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
"""Processes live in the host's time, whatever the mission's clock does."""

LOOK_S: Final = 1.0
"""How often, in mission time, it reads the descriptions of the agents."""
SLICE_S: Final = 0.05
"""How often, in the viewer's time, it waits for the viewer's clock."""


class VirtualWatch:
    """Fill a feed with what a fleet in virtual time does, and keep it from going faster than can be watched.

    What agents publish is tapped where they publish it, and what they are is read between two turns. Its methods are
    called in the thread in which the fleet runs, unless they say otherwise.

    Args:
        speed: mission seconds for each second of the viewer.
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
        self._questions: deque[tuple[str, Describe, Future[Reply]]] = deque()
        self._chains = CommandChains()
        self._explainer = CommandExplainer()

    def begin(self, fleet: Fleet) -> None:
        """Take the agents of a fleet that are there; to be called before anything runs."""
        self._fleet = fleet
        for handle in fleet.agents.values():
            self.joined(handle.agent)

    def joined(self, agent: Agent) -> None:
        """Take an agent that was killed, and is started again; to be called before it runs."""
        self._tap(agent)

    def slice_s(self) -> float:
        """Return how much virtual time may pass until the next `pace`."""
        return SLICE_S * self.speed

    def pace(self) -> None:
        """Show what has happened, and wait until its time has come."""
        assert self._fleet is not None
        self._time_s = self._fleet.now()
        self._look()
        self._answer()
        self.feed.record()
        self._stopping.wait(max(0.0, self._began_s + self._now() - HOST.now()))

    def end(self) -> None:
        """Take no more descriptions: that agents stop once a mission is over is no part of it."""
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
            body: what is asked; its target is `service/task`.
            timeout_s: the mission runs in this process, so the answer takes no longer than until the next `pace`.
        """
        answer: Future[Reply] = Future()
        self._questions.append((agent, body, answer))
        if self._over:  # it looks no more, and may have answered the last of them before this one
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
            except ControlRefused as error:
                answer.set_result(Reply(Refusal.of(error)))
            except PancakesError as error:
                answer.set_exception(error)

    def _described(self, agent: str, body: Describe) -> dict[str, Any]:
        """Return what there is to be known of a task.

        Raises:
            ControlRefused: there is none, or it does not run and so has no state, or that cannot be written down.
            Unreachable: the mission is over, or its agent was killed.
        """
        if self._over:
            raise Unreachable("the mission is over: no agent can be asked any more")
        assert self._fleet is not None
        if agent not in self._fleet.agents:
            raise Unreachable(f"{agent} cannot be reached")
        service, _, name = body.target.partition("/")
        owner = self._fleet.agents[agent].kernel.registry.get(f"{agent}/{service}")
        if not isinstance(owner, ServiceCore) or name not in owner.slots:
            raise ControlRefused(f"{agent} has no task {body.target!r}")
        slot = owner.slots[name]
        described = owner.describe_in_detail(slot)
        if not body.state:
            return described
        if not isinstance(slot.task, TaskCore) or slot.life.state is not State.RUNNING:
            raise ControlRefused(f"{slot.address} is {slot.life.word}, not running")
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

        for channel in (LOG, SYSTEM, CTRL):
            stream.tap(channel, hear)
        # When it leaves, a packet is not on any channel here.
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
        described = []
        for agent in (handle.agent for handle in self._fleet.agents.values()):
            root = agent.kernel.registry.get(f"{agent.name}/kernel")
            if isinstance(root, Root) and agent.config.agent.role != "client":
                description = root.describe()
                # As fast as mission time goes for the viewer.
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
        for state in (True, False):  # what a task keeps in its state may be anything; what cannot be told is not shown
            try:
                self.feed.take_detail(agent, self._described(agent, Describe(f"{service}/{task}", state)))
                return
            except PancakesError:  # or its agent was killed
                continue
