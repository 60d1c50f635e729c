"""Feed recorded packets into running agents: each packet into the agent that it was recorded on, at its time.

`Selection` decides which packets are fed, and into which agent. It is pure, and `virtual_replay` uses it too.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any, Final, NamedTuple

from msgspec.structs import replace

from pancakes.client import Client
from pancakes.control import Describe
from pancakes.errors import ControlRefusedError, PancakesError, UnreachableError
from pancakes.packet import CORE_CHANNELS, NEIGHBOURS, SYSTEM, TO_TASK, Packet, agent_of, join
from pancakes.recording.clock_alignment import MissionTime
from pancakes.recording.records import CHANNEL, NANOSECONDS, RecordedPacket
from pancakes.security.access import may_be_replayed

_TWICE_NS: Final = 60 * NANOSECONDS
"""The largest time between two recordings of the same packet."""


@dataclass(frozen=True)
class Live:
    """An agent that packets may be fed into.

    Attributes:
        name: its name.
        channels: its channels.
        speaking: the addresses of its running components that publish by themselves: all except null devices.
        mission_s: its mission time.
        speed: mission seconds per second of host time; 0 while the mission clock is held.
    """

    name: str
    channels: Sequence[str]
    speaking: frozenset[str]
    mission_s: float
    speed: float

    @classmethod
    def of(cls, description: Mapping[str, Any]) -> Live:
        """Convert an agent's answer to `Describe()`."""
        name = description["agent"]
        speaking = {join(name, "kernel"), *(join(name, row["service"]) for row in description["services"])}
        for row in description["tasks"]:
            null = row["service"] == "device" and row["type"].startswith("null.")
            if row["state"] == "running" and not null:
                speaking.add(join(name, row["service"], row["task"]))
        speed = 0.0 if description["held"] else description["speed"]
        return cls(name, description["channels"], frozenset(speaking), description["mission_s"], speed)


class Topic(NamedTuple):
    """A group of packets that are fed or left out together.

    Attributes:
        recorded_on: the agent that they were recorded on.
        channel: the channel.
        type: their type.
        source: the address of their publisher.
        agent: the agent that they are fed into.
        left_out: why they are left out; empty: they are fed.
    """

    recorded_on: str
    channel: str
    type: str
    source: str
    agent: str
    left_out: str


@dataclass(frozen=True, slots=True)
class Fed:
    """A packet to feed.

    Attributes:
        time_ns: when it was recorded, in recording time.
        topic: its topic.
        packet: the packet as its agent will get it, but still with the recorded stamp.
    """

    time_ns: int
    topic: Topic
    packet: Packet


@dataclass(frozen=True)
class Selection:
    """Which packets of a recording are fed, and into which agent.

    A packet is fed into the agent that it was recorded on, if it was for a component there. Without `only`, the packets
    on `system` and on user channels are fed, except those of components that run now and so publish by themselves.

    Attributes:
        agents: the agents of the fleet, by name.
        only: shell patterns for `AGENT/CHANNEL/TYPE` or for the source: feed exactly the packets that match one of
            them, even if their source runs; empty: see above.
        from_s: the mission time to begin at.
        to_s: the mission time to end before; None: the end of the recording.
        as_name: feed all packets into this agent; empty: into the agents that they were recorded on.
        time: converts recording time to mission time.
    """

    agents: Mapping[str, Live]
    only: tuple[str, ...] = ()
    from_s: float = 0.0
    to_s: float | None = None
    as_name: str = ""
    time: MissionTime = MissionTime()

    def of(self, entries: Iterable[RecordedPacket]) -> Iterator[Fed]:
        """Yield the packets to feed and those left out (see `Topic.left_out`), in the order of time, each once.

        Args:
            entries: the recording, in the order of time.
        """
        once = _Once()
        for entry in entries:
            time_s = self.time.at(entry.time_ns)
            if self.to_s is not None and time_s >= self.to_s:
                return
            if time_s < self.from_s or not _was_for(entry) or not self._wanted(entry):
                continue
            name = self.as_name or entry.agent
            if once.is_new(entry, name):
                packet = _moved(entry.packet, entry.agent, name)
                source, channel, kind = entry.packet.source, packet.channel, packet.type
                topic = Topic(entry.agent, channel, kind, source, name, self._left_out(packet, name))
                yield Fed(entry.time_ns, topic, packet)

    def _wanted(self, entry: RecordedPacket) -> bool:
        packet = entry.packet
        if not self.only:
            return packet.channel == SYSTEM or packet.channel not in CORE_CHANNELS
        names = (entry.topic.removeprefix("/"), packet.source)
        return any(fnmatchcase(name, pattern) for pattern in self.only for name in names)

    def _left_out(self, packet: Packet, name: str) -> str:
        if name not in self.agents:
            return f"{name} does not run"
        if not may_be_replayed(packet.channel):
            return f"agents take {packet.channel} only from its publisher"
        if self.only:
            return ""
        publisher = self.agents.get(agent_of(packet.source))
        return "its source runs" if publisher is not None and packet.source in publisher.speaking else ""


def _was_for(entry: RecordedPacket) -> bool:
    """Return whether a packet was for the agent that it was recorded on, and was not only leaving it."""
    packet = entry.packet
    destination = packet.destination
    if packet.channel == CHANNEL or destination.startswith(TO_TASK):
        return False
    if destination == NEIGHBOURS:
        return agent_of(packet.source) != entry.agent
    return agent_of(destination) in ("", entry.agent)


def _moved(packet: Packet, seen_on: str, name: str) -> Packet:
    """Return a packet with `name` in place of the agent that it was recorded on."""

    def renamed(address: str) -> str:
        return name + address[len(seen_on) :] if agent_of(address) == seen_on else address

    destination = name if packet.destination in ("", NEIGHBOURS) else renamed(packet.destination)
    # A replayed packet must not have the rights that its task had then.
    return replace(packet, source=renamed(packet.source), destination=destination, fence=None)


class _Once:
    """Remember the packets of the last minute: several recordings may have the same packet."""

    def __init__(self) -> None:
        self._known: set[tuple[str, str, int, float]] = set()
        self._order: deque[tuple[int, tuple[str, str, int, float]]] = deque()

    def is_new(self, entry: RecordedPacket, name: str) -> bool:
        while self._order and self._order[0][0] < entry.time_ns - _TWICE_NS:
            self._known.discard(self._order.popleft()[1])
        packet = entry.packet
        key = (name, packet.source, packet.seq, packet.stamp_s)
        if key in self._known:
            return False
        self._known.add(key)
        self._order.append((entry.time_ns, key))
        return True


@dataclass
class Tally:
    """How many packets there are of each topic.

    Attributes:
        packets: the counts.
        first_ns: when the first packet to feed was recorded; None: no packet is fed.
        last_ns: when the last packet to feed was recorded.
    """

    packets: dict[Topic, int] = field(default_factory=dict)
    first_ns: int | None = None
    last_ns: int = 0

    def add(self, fed: Fed) -> None:
        """Count a packet."""
        self.packets[fed.topic] = self.packets.get(fed.topic, 0) + 1
        if not fed.topic.left_out:
            self.first_ns = fed.time_ns if self.first_ns is None else self.first_ns
            self.last_ns = fed.time_ns

    def fed(self) -> int:
        """Return how many packets are fed."""
        return sum(count for topic, count in self.packets.items() if not topic.left_out)


def tally_of(selection: Selection, entries: Iterable[RecordedPacket]) -> Tally:
    """Count the packets to feed, before any is fed.

    Raises:
        ControlRefusedError: an agent lacks a channel, no packet matches, or none of the agents runs.
    """
    tally = Tally()
    for fed in selection.of(entries):
        tally.add(fed)
    for topic, count in tally.packets.items():
        agent = selection.agents.get(topic.agent)
        if not topic.left_out and agent is not None and topic.channel not in agent.channels:
            raise ControlRefusedError(
                f"{agent.name} has no channel {topic.channel!r} for {count} packets of {topic.source}: add"
                f" [channel.{topic.channel}] to its configuration, or choose others with --only"
            )
    if not tally.fed():
        raise ControlRefusedError(_why_nothing(selection, tally))
    return tally


def _why_nothing(selection: Selection, tally: Tally) -> str:
    if not tally.packets:
        what = "that match --only" if selection.only else "on system or a user channel"
        return f"the recording has no packets {what}" + (" in that time" if selection.from_s or selection.to_s else "")
    reasons = ", ".join(dict.fromkeys(topic.left_out for topic in tally.packets))
    return f"all packets are left out: {reasons}"


LATE_S = 1.0
"""An agent that delays the replay by more than this is reported, in seconds."""


class Feeder:
    """Send packets to agents as a client of their fleet.

    The time of each packet counts from the first one, so that nothing drifts. If an agent is too slow, its packets
    wait; none is left out.

    Args:
        client: reaches the agents.
        selection: which packets are fed, and into which agent.
        say: reports a sentence about an agent that is too slow.

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
        """Feed all packets.

        Args:
            entries: the recording, in the order of time.
            first_ns: when the first packet to feed was recorded; it is fed at once.
            speed: how many times faster than recorded, in mission time.
            recorded_speed: mission seconds per second of the recording.

        Raises:
            ControlRefusedError: the agents' missions run at several speeds.
            UnreachableError: an agent went away.
        """
        # A held mission has no speed; packets for it get the stamp 0.
        speeds = sorted({agent.speed for agent in self._selection.agents.values() if agent.speed})
        if len(speeds) > 1:
            text = ", ".join(f"{name} at {agent.speed:g}" for name, agent in self._selection.agents.items())
            raise ControlRefusedError(f"the agents' missions run at different speeds: {text}")
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
            packet = replace(fed.packet, stamp_s=self._stamp(agent))
            try:
                self._client.send(packet)
            except PancakesError as error:
                raise UnreachableError(f"after {self.tally.fed()} packets: {error}") from None
            self._fed.add(agent.name)
            self.tally.add(fed)

    def settle(self) -> None:
        """Wait until all agents have received their packets."""
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
            raise UnreachableError(f"after {self.tally.fed()} packets: {name} went away")
        return self._client.waiting(name) > 0
