"""Feed recorded packets into running agents, each to the agent on which it was seen, at its time.

`Selection` decides which packets are fed, and into which agent; it is pure, and `virtual_replay` uses it too.
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
from pancakes.errors import ControlRefused, PancakesError, Unreachable
from pancakes.packet import CORE_CHANNELS, NEIGHBOURS, SYSTEM, TO_TASK, Packet, agent_of, join
from pancakes.recording.clock_alignment import MissionTime
from pancakes.recording.records import CHANNEL, NANOSECONDS, RecordedPacket
from pancakes.security.access import may_be_replayed

_TWICE_NS: Final = 60 * NANOSECONDS
"""Two recordings may show the same packet this far apart."""


@dataclass(frozen=True)
class Live:
    """An agent that packets may be fed into.

    Attributes:
        name: its name.
        channels: its channels.
        speaking: the addresses there that publish by themselves: what runs, but for null devices, which say nothing.
        mission_s: its mission time.
        speed: mission seconds for each second of host time; 0 while it is held.
    """

    name: str
    channels: Sequence[str]
    speaking: frozenset[str]
    mission_s: float
    speed: float

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> Live:
        """Make it of what an agent answers to `Describe()`."""
        name = told["agent"]
        speaking = {join(name, "kernel"), *(join(name, row["service"]) for row in told["services"])}
        for row in told["tasks"]:
            null = row["service"] == "device" and row["type"].startswith("null.")
            if row["state"] == "running" and not null:
                speaking.add(join(name, row["service"], row["task"]))
        speed = 0.0 if told["held"] else told["speed"]
        return cls(name, told["channels"], frozenset(speaking), told["mission_s"], speed)


class Topic(NamedTuple):
    """What the packets have in common that are fed or left out together.

    Attributes:
        recorded_on: the agent that they were seen on.
        channel: the channel.
        type: their type.
        source: the address of their publisher.
        agent: the agent that they are for.
        left_out: why they are not fed; empty if they are.
    """

    recorded_on: str
    channel: str
    type: str
    source: str
    agent: str
    left_out: str


@dataclass(frozen=True, slots=True)
class Fed:
    """A packet that is fed.

    Attributes:
        time_ns: when it was seen, as the recording counts time.
        topic: what it belongs to.
        packet: the packet as its agent is to get it; its stamp is still the recorded one.
    """

    time_ns: int
    topic: Topic
    packet: Packet


@dataclass(frozen=True)
class Selection:
    """Which packets of a recording are fed, and into which agent.

    Packets go to the agent on which they were seen, if they were for a component there. Without `only`, these are what
    was said on `system` and on channels of one's own, but for what the fleet says by itself: that of components that
    run.

    Attributes:
        agents: the agents of the fleet, by name.
        only: patterns of the shell for `AGENT/CHANNEL/TYPE` or for the source; what fits one of them is fed, also
            where its source runs, and nothing else.
        from_s: nothing before this mission time.
        to_s: nothing from this mission time on; None: to the end.
        as_name: the agent that gets everything, in place of those on which it was seen; empty: none.
        time: turns the recording's time into mission time.
    """

    agents: Mapping[str, Live]
    only: tuple[str, ...] = ()
    from_s: float = 0.0
    to_s: float | None = None
    as_name: str = ""
    time: MissionTime = MissionTime()

    def of(self, entries: Iterable[RecordedPacket]) -> Iterator[Fed]:
        """Yield what is fed and what is left out (see `Topic.left_out`), in the order of time, each packet once.

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
            return f"{name} is not there"
        if not may_be_replayed(packet.channel):
            return f"agents take {packet.channel} only from its publisher"
        if self.only:
            return ""
        publisher = self.agents.get(agent_of(packet.source))
        return "its source runs" if publisher is not None and packet.source in publisher.speaking else ""


def _was_for(entry: RecordedPacket) -> bool:
    """Return whether a packet was for the agent on which it was seen, and not only on its way out there."""
    packet = entry.packet
    destination = packet.destination
    if packet.channel == CHANNEL or destination.startswith(TO_TASK):
        return False
    if destination == NEIGHBOURS:
        return agent_of(packet.source) != entry.agent
    return agent_of(destination) in ("", entry.agent)


def _moved(packet: Packet, seen_on: str, name: str) -> Packet:
    """Return a packet for another agent in place of the one on which it was seen, in whose name it speaks."""

    def renamed(address: str) -> str:
        return name + address[len(seen_on) :] if agent_of(address) == seen_on else address

    destination = name if packet.destination in ("", NEIGHBOURS) else renamed(packet.destination)
    # No packet of a replay bears a right that a task once had.
    return replace(packet, source=renamed(packet.source), destination=destination, fence=None)


class _Once:
    """Remember which packets were there already: two recordings may have the same."""

    def __init__(self) -> None:
        self._known: set[tuple[str, str, int, float]] = set()
        self._order: deque[tuple[int, tuple[str, str, int, float]]] = deque()

    def is_new(self, entry: RecordedPacket, name: str) -> bool:
        while self._order and self._order[0][0] < entry.time_ns - _TWICE_NS:
            self._known.discard(self._order.popleft()[1])
        packet = entry.packet
        key = (name, packet.source, packet.seq, packet.stamp)
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
        first_ns: when the first was seen that is fed; None if none is.
        last_ns: when the last was.
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
        """Return how many are fed."""
        return sum(count for topic, count in self.packets.items() if not topic.left_out)


def tally_of(selection: Selection, entries: Iterable[RecordedPacket]) -> Tally:
    """Count what would be fed, before anything is.

    Raises:
        ControlRefused: an agent lacks a channel, nothing fits, or no agent is there of those that it is for.
    """
    tally = Tally()
    for fed in selection.of(entries):
        tally.add(fed)
    for topic, count in tally.packets.items():
        agent = selection.agents.get(topic.agent)
        if not topic.left_out and agent is not None and topic.channel not in agent.channels:
            raise ControlRefused(
                f"{agent.name} has no channel {topic.channel!r}, on which {count} packets of {topic.source} are to be"
                f" fed: add [channel.{topic.channel}] to its configuration, or choose others with --only"
            )
    if not tally.fed():
        raise ControlRefused(_why_nothing(selection, tally))
    return tally


def _why_nothing(selection: Selection, tally: Tally) -> str:
    if not tally.packets:
        what = "that fits --only" if selection.only else "on system or a channel of one's own"
        return f"the recording has nothing {what}" + (" in that time" if selection.from_s or selection.to_s else "")
    reasons = ", ".join(dict.fromkeys(topic.left_out for topic in tally.packets))
    return f"nothing is left to be fed: {reasons}"


LATE_S = 1.0
"""When it is told that an agent cannot keep up."""


class Feeder:
    """Send packets to agents as a client of their fleet.

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
        """Feed all packets.

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
        """Wait until all agents have got what was sent to them."""
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
