"""The packets of the MQTT devices and service."""

from __future__ import annotations

from typing import Annotated

import msgspec

from pancakes import packet_type


@packet_type("mqtt.number")
class Number(msgspec.Struct, frozen=True):
    """A reading without a type of its own: humidity, light, power.

    Attributes:
        value: the number.
        unit: its unit, from the configuration.
    """

    value: float
    unit: str = ""


@packet_type("mqtt.switch")
class Switch(msgspec.Struct, frozen=True):
    """A command to a switch."""

    on: bool


@packet_type("mqtt.light")
class Light(msgspec.Struct, frozen=True):
    """A command to a light: its brightness, from 0 (off) to 1."""

    brightness: Annotated[float, msgspec.Meta(ge=0, le=1)]


@packet_type("mqtt.traffic")
class BrokerTraffic(msgspec.Struct, frozen=True):
    """The counters of the MQTT service, from its start.

    Attributes:
        connected: whether the broker takes and sends messages.
        connections: how often it has connected.
        published: messages that the broker has got; with QoS 1 and 2: that it has acknowledged.
        unsent: messages that were lost before that: no broker (QoS 0), no room, or the broker refused them.
        waiting: messages that wait for the broker or its acknowledgement.
        taken: messages that became packets.
        overflowed: messages (QoS 0) that were dropped because they came too fast.
        unfit: messages that did not fit a packet, or that were too large.
    """

    connected: bool
    connections: int
    published: int
    unsent: int
    waiting: int
    taken: int
    overflowed: int
    unfit: int
