"""Feeds recorded packets into agents that run, at their times."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from msgspec.structs import replace

from pancakes.client import Client
from pancakes.control import Describe
from pancakes.errors import ControlRefused, PancakesError, Unreachable
from pancakes.tools.recording.recorded_packet import NANOSECONDS, RecordedPacket
from pancakes.tools.replay.selection import Live, Selection, Tally

LATE_S = 1.0
"""When it is told that an agent cannot keep up."""


class Feeder:
    """Sends packets to agents as a client of their fleet.

    What happens does so at times that are counted from the first packet, so that nothing drifts. Packets wait for an
    agent that is too slow for them; none is left out.

    Args:
        client: reaches the agents.
        selection: which packets are fed, and into which agent.
        say: takes a sentence about an agent that is too slow.

    Attributes:
        tally: what was fed so far.
    """

    def __init__(self, client: Client, selection: Selection, say: Callable[[str], None]) -> None:
        self._client = client
        self._selection = selection
        self._say = say
        self._known_s = client.now()
        self._fed: set[str] = set()
        self._slow: set[str] = set()
        self.tally = Tally()

    def feed(self, entries: Iterable[RecordedPacket], first_ns: int, speed: float, recorded_speed: float) -> None:
        """Feeds all packets.

        Args:
            entries: the recording, in the order of time.
            first_ns: when the first packet was seen that is fed; it goes out at once.
            speed: how many times as fast as then, in mission time.
            recorded_speed: mission seconds for each second of the recording.

        Raises:
            ControlRefused: the agents' missions run at several speeds.
            Unreachable: an agent went away.
        """
        # A mission that is held has no speed, and what is fed to it bears the time 0.
        speeds = sorted({agent.speed for agent in self._selection.agents.values() if agent.speed})
        if len(speeds) > 1:
            told = ", ".join(f"{name} at {agent.speed:g}" for name, agent in self._selection.agents.items())
            raise ControlRefused(f"the agents' missions run at different speeds: {told}")
        pace = recorded_speed / (speed * (speeds[0] if speeds else 1.0))
        begin_s = self._client.now()
        for fed in self._selection.of(entries):
            if fed.topic.left_out:
                continue
            due_s = begin_s + (fed.time_ns - first_ns) / NANOSECONDS * pace
            if (early_s := due_s - self._client.now()) > 0.0:
                self._client.wait(lambda: False, early_s)
            agent = self._selection.agents[fed.topic.agent]
            self._make_room(agent.name, due_s)
            packet = replace(fed.packet, stamp=self._stamp(agent))
            try:
                self._client.send(packet)
            except PancakesError as error:
                raise Unreachable(f"after {self.tally.fed()} packets: {error}") from None
            self._fed.add(agent.name)
            self.tally.add(fed)

    def settle(self) -> None:
        """Waits until all agents have got what was sent to them."""
        for name in self._fed:
            self._client.wait(lambda: not self._waits(name))  # noqa: B023
            self._client.request(name, Describe())

    def _stamp(self, agent: Live) -> float:
        return agent.mission_s + (self._client.now() - self._known_s) * agent.speed

    def _make_room(self, name: str, due_s: float) -> None:
        while self._waits(name):
            self._client.wait(lambda: not self._waits(name))
            late_s = self._client.now() - due_s
            if late_s > LATE_S and name not in self._slow:
                self._slow.add(name)
                self._say(f"{name} is too slow: the replay waits for it, and is {late_s:.1f} s late")

    def _waits(self, name: str) -> bool:
        if not self._client.is_connected(name):
            raise Unreachable(f"after {self.tally.fed()} packets: {name} went away")
        return self._client.waiting(name) > 0
