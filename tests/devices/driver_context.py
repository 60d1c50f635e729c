"""What a driver sees of its agent, for tests of drivers without an agent."""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import cached_property
from typing import Any, TypeVar

from pancakes.events import Log
from pancakes.kernel.virtual_time import VirtualDispatcher
from pancakes.mesh.memory_network import MemoryNetwork
from pancakes.mesh.transport import Transport

_T = TypeVar("_T")


def _alone(agent: str) -> Transport:
    """Returns a transport that reaches nothing."""
    dispatcher = VirtualDispatcher(1)
    return MemoryNetwork(dispatcher.call_at, dispatcher.clock.now, random.Random(1)).transport(agent)


class DriverContext:
    """Keeps what a driver says, and has a clock that the test moves.

    Args:
        agent: the agent's name.
        device: the device's name.
        transport: how the driver reaches its hardware.
        shared: what the drivers of this agent share.

    Attributes:
        readings: the bodies that the driver delivered.
        lines: (level, text) of each line that it logged.
        misses: why each reading was missed that the driver told of.
        alive_s: mission times at which it told that its hardware speaks.
        sent: (channel, body, destination) of each packet that it sent.
        later: (mission time, function) of each call that is still to come.
        packets: how many mission packets the agent has sent.
        awake: whether the Network Service is awake.
        virtual: whether the agent is said to run in virtual time.
    """

    def __init__(
        self,
        agent: str = "agent1",
        device: str = "pose",
        transport: Transport | None = None,
        shared: dict[str, Any] | None = None,
    ) -> None:
        self.agent = agent
        self.device = device
        self.random = random.Random(1)
        self.time_s = 0.0
        self.readings: list[Any] = []
        self.lines: list[tuple[str, str]] = []
        self.misses: list[str] = []
        self.alive_s: list[float] = []
        self.sent: list[tuple[str, Any, str]] = []
        self.later: list[tuple[float, Callable[[], None]]] = []
        self.packets = 0
        self.awake = True
        self.virtual = False
        self.transport = transport or _alone(agent)
        self._shared = {} if shared is None else shared

    def now(self) -> float:
        return self.time_s

    def deliver(self, body: Any) -> None:
        self.readings.append(body)

    def missed(self, why: str) -> None:
        self.misses.append(why)

    def alive(self) -> None:
        self.alive_s.append(self.time_s)

    def send(self, channel: str, body: Any, to: str) -> None:
        self.sent.append((channel, body, to))

    def call(self, function: Callable[[], None]) -> None:
        self.later.append((self.time_s, function))

    def after(self, delay_s: float, function: Callable[[], None]) -> None:
        self.later.append((self.time_s + delay_s, function))

    @cached_property
    def log(self) -> Log:
        return Log(lambda level, text, traceback: self.lines.append((level, text)))

    def mission_packets_sent(self) -> int:
        return self.packets

    def network_awake(self) -> bool:
        return self.awake

    def shared(self, key: str, make: Callable[[], _T]) -> _T:
        if key not in self._shared:
            self._shared[key] = make()
        found: _T = self._shared[key]
        return found

    def run_until(self, time_s: float) -> None:
        """Moves the clock, and makes the calls that are due by then."""
        while self.later and min(due_s for due_s, _ in self.later) <= time_s:
            due = min(self.later, key=lambda call: call[0])
            self.later.remove(due)
            self.time_s = due[0]
            due[1]()
        self.time_s = time_s
