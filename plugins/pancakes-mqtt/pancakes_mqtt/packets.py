"""What the devices and the service of MQTT say."""

from __future__ import annotations

from typing import Annotated

import msgspec

from pancakes.packet import packet_type


@packet_type("mqtt.number")
class Number(msgspec.Struct, frozen=True):
    """A reading for which there is no type of its own: humidity, light, power.

    Attributes:
        value: the number.
        unit: its unit, as the configuration says it.
    """

    value: float
    unit: str = ""


@packet_type("mqtt.switch")
class Switch(msgspec.Struct, frozen=True):
    """A command to a switch."""

    on: bool


@packet_type("mqtt.light")
class Light(msgspec.Struct, frozen=True):
    """A command to a light: how bright it shall shine, from 0 (off) to 1."""

    brightness: Annotated[float, msgspec.Meta(ge=0, le=1)]


@packet_type("mqtt.traffic")
class BrokerTraffic(msgspec.Struct, frozen=True):
    """How the MQTT service fares with its broker. It counts from the start of the service.

    Attributes:
        connected: whether the broker takes and sends messages.
        connections: how often a connection stood.
        published: messages that the broker has got; where it promises that (QoS 1 and 2): that it has said so.
        unsent: messages that were lost before that: no broker (QoS 0), no room, or the broker has refused them.
        waiting: messages that wait for the broker, or for its word.
        taken: messages that became packets.
        overflowed: messages (QoS 0) that fell out because they came faster than packets could be made of them.
        unfit: messages that no packet could be made of, or that were too large.
    """

    connected: bool
    connections: int
    published: int
    unsent: int
    waiting: int
    taken: int
    overflowed: int
    unfit: int
