"""Dead letters: packets whose handler failed, and packets that nobody received.

A packet under a `reliable` subscription comes again, up to `ATTEMPTS` times. After that, and under any other
subscription at once, it is counted and logged, so one bad packet cannot stop a task for ever. A packet that was for
somebody and reached nobody is logged once for each source, destination and type, with the name that was probably
meant.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import Final

from pancakes.control import Reply
from pancakes.errors import RefusalCode
from pancakes.kernel.mailbox import ASK_TYPE, TypeQueue
from pancakes.packet import CTRL, NETWORK, Packet, agent_of, covers, type_name
from pancakes.util.text import did_you_mean

ATTEMPTS = 3
"""How often a reliable packet is handled before it is given up as a dead letter."""
MOST_KNOWN = 1024
"""The most packets that failed and are remembered: of one whose task is given up nothing is heard again."""


class DeadLetters:
    """Decides what becomes of a packet whose handler failed.

    A packet under a `reliable` subscription comes again, up to `ATTEMPTS` times in all; then, and under any other
    subscription at once, it is a dead letter: counted and logged, so that one bad packet cannot stop a task for ever.

    Args:
        log: takes a level and a line.
    """

    def __init__(self, log: Callable[[str, str], None]) -> None:
        self._log = log
        self._lock = threading.Lock()
        self._failures: dict[tuple[str, str, int], int] = {}
        self.count = 0

    def failed(self, address: str, queue: TypeQueue, packet: Packet) -> None:
        """Take a packet whose handler raised, in the turn of the component at `address`."""
        key = (address, packet.source, packet.seq)
        with self._lock:
            failures = self._failures.pop(key, 0) + 1
            again = queue.policy.reliable and failures < ATTEMPTS
            if again:
                self._failures[key] = failures
                if len(self._failures) > MOST_KNOWN:
                    del self._failures[next(iter(self._failures))]  # the one that has not failed for longest
        if again:
            queue.put_back(packet)
        else:
            self.bury(
                f"{address} failed {failures} time{'s' * (failures > 1)} on {packet.type!r}"
                f" #{packet.number} from {packet.source}"
            )

    def bury(self, reason: str) -> None:
        """Count and log a packet that is given up. Any thread."""
        with self._lock:
            self.count += 1
        self._log("warning", f"dead letter: {reason}")


MOST_TOLD: Final = 1024
"""The most that are remembered as told: a program that makes up destinations must not fill the memory."""
FOREIGN_EVERY_S: Final = 10.0
"""Packets of another agent are told no more often than this, in host time: the log is not that agent's to fill."""
_REPLY: Final = type_name(Reply)


class Unheard:
    """Tells the log of packets that nobody got, once for each source, destination and type. Any thread.

    A packet without a destination is for all that subscribe to it, if any; only a command is for an actuator.
    Replies, and what agents tell each other on `network`, are no concern of the author of a task.

    Args:
        agent: the name of this agent.
        log: takes a level and a line.
        running: returns the addresses of what runs here.
        resting: returns the addresses of what is known here and may not run now.
        refuse: takes a request that no task can take, with the reason for programs and for people.
        device_types: returns the types of the devices that run here.
        host_now: returns the host time in seconds.
    """

    def __init__(
        self,
        agent: str,
        log: Callable[[str, str], None],
        running: Callable[[], list[str]],
        resting: Callable[[], list[str]],
        refuse: Callable[[Packet, RefusalCode, str], None],
        device_types: Callable[[], list[str]],
        host_now: Callable[[], float],
    ) -> None:
        self._agent = agent
        self._log = log
        self._running = running
        self._resting = resting
        self._refuse = refuse
        self._device_types = device_types
        self._host_now = host_now
        self._lock = threading.Lock()
        self._told: dict[tuple[str, str, str, str], None] = {}
        self._met: dict[str, None] = {}
        self._foreign_s = 0.0

    def met(self, agent: str) -> None:
        """Learn that an agent is there: if it goes away, nobody has mistaken its name."""
        with self._lock:
            self._met.pop(agent, None)
            self._met[agent] = None
            if len(self._met) > MOST_TOLD:
                del self._met[next(iter(self._met))]

    def here(self, packet: Packet) -> None:
        """Take a packet for this agent that no component of it got."""
        destination = packet.destination
        if destination in ("", self._agent):
            if packet.channel == CTRL and agent_of(packet.source) == self._agent:
                self._tell(packet, lambda: self._no_actuator(packet))
        elif agent_of(destination) == self._agent:
            if packet.type == ASK_TYPE:  # who asked is told, and the log need not be
                if any(covers(destination, it) for it in self._running()):
                    self._refuse(packet, "unsupported", f"{destination} answers no requests")
                elif reason := self._no_reader(packet):
                    self._refuse(packet, "not_found", reason)
                else:
                    self._refuse(packet, "unable", f"{destination} does not run now")
                return
            self._tell(packet, lambda: self._no_reader(packet))

    def elsewhere(self, packet: Packet, linked: Iterable[str]) -> None:
        """Take a packet for an agent that is not linked; it is told if that never was.

        Args:
            packet: the packet.
            linked: the names of the agents that are linked.
        """
        name = agent_of(packet.destination)
        if packet.type == ASK_TYPE:
            self._refuse(packet, "unable", f"{self._agent} has no link to {name}")
            return
        if name in self._met:
            return
        there = sorted(linked)
        only = f"; linked are {', '.join(there)}" if there else ", and none is"
        self._tell(packet, lambda: f"no agent {name!r} was ever linked{did_you_mean(name, there, only)}")

    def _no_actuator(self, packet: Packet) -> str:
        return f"no actuator of {self._agent} takes it{did_you_mean(packet.type, self._device_types())}"

    def _no_reader(self, packet: Packet) -> str:
        destination = packet.destination
        running = self._running()
        if any(covers(destination, it) for it in running):
            return f"{destination} does not read {packet.type!r} on {packet.channel!r}"
        known = [*running, *self._resting()]
        if any(covers(destination, it) for it in known):
            return ""  # it is stopped, and that is told elsewhere
        return f"{self._agent} has no {destination!r}{did_you_mean(destination, known)}"

    def _tell(self, packet: Packet, reason: Callable[[], str]) -> None:
        if packet.channel == NETWORK or packet.type == _REPLY:
            return
        key = (packet.source, packet.destination, packet.channel, packet.type)
        foreign = agent_of(packet.source) != self._agent
        with self._lock:
            if key in self._told:
                return
            if foreign:
                now_s = self._host_now()
                if now_s < self._foreign_s:
                    return
                self._foreign_s = now_s + FOREIGN_EVERY_S
            if len(self._told) >= MOST_TOLD:
                self._told.clear()
            self._told[key] = None
        why = reason()
        if why:
            to = f" for {packet.destination}" if packet.destination else ""
            self._log("warning", f"{packet.type!r} of {packet.source}{to} on {packet.channel!r} is lost: {why}")
