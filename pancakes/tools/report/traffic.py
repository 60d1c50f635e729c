"""Packets and bytes between agents, by link and by channel. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field

from pancakes.errors import LocalProtocolError
from pancakes.mesh.wire.codec import Encoder
from pancakes.packet import NEIGHBOURS, TO_TASK, Packet, agent_of
from pancakes.tools.report.series import Counts


@dataclass
class Flow:
    """What went between agents, or on channels.

    Attributes:
        packets: counted over time, by name.
        bytes: their sizes as they travel, over time, by name.
    """

    packets: Counts = field(default_factory=Counts)
    bytes: Counts = field(default_factory=Counts)

    def add(self, t_s: float, name: str, size: int) -> None:
        """Counts a packet."""
        self.packets.add(t_s, name)
        self.bytes.add(t_s, name, size)

    def take(self, other: Flow, name: str) -> None:
        """Adds what another flow has counted under a name."""
        for counts, of in ((self.packets, other.packets), (self.bytes, other.bytes)):
            for slot, number in of.slots[name].items():
                counts.add((slot + 0.5) * of.slot_s, name, number)

    def names(self) -> list[str]:
        """Returns the names, those with the most bytes first."""
        return sorted(self.packets.slots, key=lambda name: (-self.bytes.total(name), name))


@dataclass
class Traffic:
    """What travelled between agents.

    A packet that travels may be seen twice, where it leaves and where it arrives. It counts where it arrives; where
    the receiver was not recorded, where it leaves.

    Attributes:
        links: by link, as `FROM → TO`.
        channels: by channel, all links together.
        heard: the agents that were recorded.
    """

    links: Flow = field(default_factory=Flow)
    channels: Flow = field(default_factory=Flow)
    heard: set[str] = field(default_factory=set)
    _leaving: Flow = field(default_factory=Flow)
    _leaving_channels: dict[str, Flow] = field(default_factory=dict)
    _encoder: Encoder = field(default_factory=Encoder)

    def add(self, agent: str, packet: Packet, t_s: float) -> None:
        """Takes a packet that was seen on an agent."""
        self.heard.add(agent)
        source, destination = agent_of(packet.source), packet.destination
        if source != agent:
            size = self._size(packet)
            self.links.add(t_s, f"{source} → {agent}", size)
            self.channels.add(t_s, packet.channel, size)
        elif destination and not destination.startswith(TO_TASK) and agent_of(destination) != agent:
            to = NEIGHBOURS if destination == NEIGHBOURS else agent_of(destination)
            name = f"{agent} → {to}"
            size = self._size(packet)
            self._leaving.add(t_s, name, size)
            self._leaving_channels.setdefault(name, Flow()).add(t_s, packet.channel, size)

    def _size(self, packet: Packet) -> int:
        try:
            return len(self._encoder.packet(packet))
        except LocalProtocolError:  # a body whose class is not installed here may be of a kind that does not travel
            return 0

    def close(self) -> None:
        """The recording has ended: what left for agents that were not recorded counts where it left."""
        for name in list(self._leaving.packets.slots):
            to = name.rpartition(" → ")[2]
            if to in self.heard or (to == NEIGHBOURS and len(self.heard) > 1):
                continue
            self.links.take(self._leaving, name)
            for channel in self._leaving_channels[name].packets.slots:
                self.channels.take(self._leaving_channels[name], channel)
        self._leaving, self._leaving_channels = Flow(), {}
