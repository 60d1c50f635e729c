"""Publishes packets for a program that is no agent, in the mission time of the agent that gets them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from pancakes.client.door import Door
from pancakes.client.mesh_client import MeshClient
from pancakes.control import CONTROLS, Channels, Describe
from pancakes.errors import ControlRefused, NoAnswer, PancakesError, PeerLost, RemoteProtocolError, Unreachable
from pancakes.mesh.net.send_buffer import PeerBusy
from pancakes.mesh.wire.codec import Encoder, packet_from_row, rows_from_payload
from pancakes.mesh.wire.framing import array_head
from pancakes.packet import LOG, NEIGHBOURS, SYSCTRL, TO_TASK, Packet, agent_of, join, type_name
from pancakes.runtime.foundation.suggestion import hint_of

ANEW_S: Final = 1.0
"""How old what is known of an agent's mission may be: it may have been held, and have begun."""
AGAIN_S: Final = 0.02
"""When a packet is tried again for which there was no room."""


@dataclass(frozen=True, slots=True)
class _Known:
    """What is known of an agent that packets go to.

    Attributes:
        door: leads to it.
        at_s: when it told the rest, in host time.
        mission_s: its mission time then.
        speed: mission seconds for each second; 0 where its mission is held.
        channels: its channels.
    """

    door: Door
    at_s: float
    mission_s: float
    speed: float
    channels: tuple[str, ...]


class Publisher:
    """Sends packets to agents, in order. One thread at a time.

    Args:
        client: reaches the agents.
    """

    def __init__(self, client: MeshClient) -> None:
        self._client = client
        self._known: dict[str, _Known] = {}
        self._unsettled: dict[str, None] = {}

    def publish(self, agent: str, channel: str, body: Any, to: str, timeout_s: float | None) -> None:
        """Publishes a packet on a channel of an agent; see `pancakes.client.Client.publish`."""
        if channel == SYSCTRL and type(body) in CONTROLS:
            raise PancakesError(
                f"{type(body).__name__} is a control packet, whose answer counts: client.request({agent!r}, ...)"
            )
        check_body(body)
        known = self._of(agent, timeout_s)
        if channel not in known.channels:
            raise ControlRefused(f"{agent} has no channel {channel!r}{hint_of(channel, known.channels)}")
        stamp_s = known.mission_s + (self._client.now() - known.at_s) * known.speed
        destination = destination_on(agent, to)
        self._try(agent, lambda: known.door.publish(agent, channel, body, stamp_s, destination), timeout_s)

    def send(self, packet: Packet, timeout_s: float | None) -> None:
        """Sends a packet as it stands; see `pancakes.client.Client.send`."""
        agent = agent_of(packet.destination)
        door = self._client.door(agent)
        self._try(agent, lambda: door.send(packet), timeout_s)

    def settle(self, timeout_s: float | None) -> None:
        """Waits until all agents have got what was sent to them; see `pancakes.client.Client.settle`."""
        for agent in list(self._unsettled):
            # A link keeps the order, so the answer comes after all else has arrived.
            self._client.request(agent, Channels(LOG), timeout_s)
            self._unsettled.pop(agent, None)

    def _of(self, agent: str, timeout_s: float | None) -> _Known:
        known = self._known.get(agent)
        now_s = self._client.now()
        if known is not None and now_s - known.at_s < ANEW_S and known.door.connected(agent):
            return known
        reply = self._client.request(agent, Describe(), timeout_s)
        if not reply.ok:
            raise ControlRefused(reply.reason)
        told = reply.result
        speed = 0.0 if told["held"] else told["speed"]
        door = self._client.door(agent)
        self._known[agent] = _Known(door, self._client.now(), told["mission_s"], speed, tuple(told["channels"]))
        return self._known[agent]

    def _try(self, agent: str, send: Any, timeout_s: float | None) -> None:
        limit_s = self._client.timeout_s if timeout_s is None else timeout_s
        until_s = self._client.now() + limit_s
        self._unsettled[agent] = None
        while True:
            try:
                send()
                return
            except PeerLost as error:
                raise Unreachable(str(error)) from None
            except PeerBusy as error:
                if self._client.now() >= until_s:
                    raise NoAnswer(f"{agent} is too slow, and found no room within {limit_s:g} s: {error}") from None
                self._client.wait(self._client.now() + AGAIN_S, lambda: False)


def check_body(body: Any) -> None:
    """Takes a body apart as the agent will that gets it; pure.

    Raises:
        PancakesError: a value in it does not fit its type, or cannot travel.
    """
    message = Encoder().packet(Packet(SYSCTRL, type_name(body), "this program", "", 0.0, 1, body))
    try:
        packet_from_row(rows_from_payload(array_head(1) + message)[0])
    except RemoteProtocolError as error:
        raise PancakesError(f"{type(body).__name__} cannot be sent: {error}") from None


def destination_on(agent: str, to: str) -> str:
    """Returns the address on an agent that is meant by `SERVICE/TASK`, with the agent before it or without; pure.

    Raises:
        PancakesError: it is no such address.
    """
    if not to:
        return agent
    address = to if agent_of(to) == agent else join(agent, to)
    if to == NEIGHBOURS or to.startswith(TO_TASK) or address.count("/") > 2 or not all(address.split("/")):
        raise PancakesError(f"{to!r} is no service or task of {agent}: write it as SERVICE/TASK")
    return address
