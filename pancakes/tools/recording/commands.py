"""The commands to actuators, each with the chain that led to it. Pure, in bounded memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any, Final

import msgspec

from pancakes.control import Hold
from pancakes.packet import CTRL, Packet, agent_of, field_names
from pancakes.tools.recording.chains import Causes, Chain
from pancakes.tools.recording.recorded_packet import NANOSECONDS, RecordedPacket

REMEMBERED: Final = 50_000
"""The number of packets that are remembered as causes of later ones."""
HELD_NS: Final = NANOSECONDS
"""A chain is followed this much later: where the clocks of two machines disagree, a cause may seem later."""
BODY_CHARACTERS: Final = 160
"""A packet's body is shown in so many characters."""


def is_command(agent: str, packet: Packet) -> bool:
    """Returns whether a packet that was seen on an agent's channel commands an actuator of that agent."""
    return packet.channel == CTRL and not isinstance(packet.body, Hold) and agent_of(packet.source) == agent


class ActuatorCommand(msgspec.Struct, frozen=True):
    """A command, and why it was given.

    Attributes:
        time_ns: when it was recorded, see `RecordedPacket`.
        packet: the command; its type names the actuator, its stamp is the mission time.
        chain: what led to it; of one that answers nothing that is known, the command alone.
    """

    time_ns: int
    packet: Packet
    chain: Chain

    @property
    def agent(self) -> str:
        """The agent whose actuator it is."""
        return agent_of(self.packet.source)

    @property
    def caused(self) -> bool:
        """Whether it answers a packet that is known: else a timer led to it, or nothing of its cause was recorded."""
        return len(self.chain.steps) > 1


class CommandChains:
    """Takes packets, and gives the commands among them with their chains.

    Args:
        bodies: whether the packets of a chain bear what they said; that of the command always does. Without, less
            memory is needed.
        limit: so many packets are remembered.
    """

    def __init__(self, bodies: bool = True, limit: int = REMEMBERED) -> None:
        self._bodies = bodies
        self._causes = Causes(limit)
        self._waiting: deque[tuple[int, Packet]] = deque()

    def add(self, entry: RecordedPacket) -> list[ActuatorCommand]:
        """Takes a packet, in the order of time; returns the commands of which all is known now, oldest first."""
        packet = entry.packet
        kept = packet if self._bodies else msgspec.structs.replace(packet, body=None)
        self._causes.add(RecordedPacket(entry.time_ns, entry.agent, kept))
        if is_command(entry.agent, packet):
            self._waiting.append((entry.time_ns, packet))
        return self._followed(entry.time_ns - HELD_NS)

    def close(self) -> list[ActuatorCommand]:
        """Returns the rest, now that no more packets come."""
        return self._followed(None)

    def _followed(self, until_ns: int | None) -> list[ActuatorCommand]:
        found = []
        while self._waiting and (until_ns is None or self._waiting[0][0] <= until_ns):
            time_ns, packet = self._waiting.popleft()
            chain = self._causes.chain(packet.source, packet.seq)
            if chain is not None:
                found.append(ActuatorCommand(time_ns, packet, chain))
        return found


def body_text(body: Any, longest: int = BODY_CHARACTERS) -> str:
    """Returns what a packet says in one short line."""
    items = _items(body)
    text = _value(body) if items is None else ", ".join(f"{name} {_value(value)}" for name, value in items)
    return text if len(text) <= longest else text[: longest - 1] + "…"


def _items(value: Any) -> Iterable[tuple[Any, Any]] | None:
    """Returns the fields of a body, or of what is in one; None where it has none.

    It reads the fields themselves: making plain values of a body first is slower, and agents do this for each command
    while a page is open.
    """
    if isinstance(value, Mapping):
        return value.items()
    names = field_names(type(value))
    return ((name, getattr(value, name)) for name in names) if names else None


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, str | int | None):
        return str(value)
    if isinstance(value, list | tuple):
        if len(value) > 4 or any(_items(it) is not None for it in value):
            return f"{len(value)} values"
        return f"({', '.join(_value(it) for it in value)})"
    if hasattr(value, "tolist"):
        size = getattr(value, "size", 1)
        return _value(value.tolist()) if size <= 4 else f"{size} values"
    items = _items(value)
    return str(value) if items is None else f"({', '.join(f'{name} {_value(it)}' for name, it in items)})"
