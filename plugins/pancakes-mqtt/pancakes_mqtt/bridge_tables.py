"""The rows of the service's tables: what is published, and what is taken."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal

from pancakes.packet import LOG, NETWORK, SYSCTRL, SYSTEM
from pancakes.settings import Positive
from pancakes.util.text import fault_of_name
from pancakes_mqtt.message import Qos
from pancakes_mqtt.topics import fault_of_filter, fault_of_retained, fault_of_template

PLACES: Final = {
    "agent": "agent",
    "source": "agent/service/task",
    "name": "task",
    "channel": "channel",
    "type": "type",
}
"""What stands in a topic for a packet, with an example of each."""
NOT_TAKEN: Final = (SYSCTRL, LOG)
"""The channels that no topic leads to: a broker gives no orders to an agent, and does not speak in its log."""


@dataclass
class PublishRow:
    """What of a channel becomes messages.

    Attributes:
        channel: the channel.
        topic: the topic, in which `{agent}`, `{source}` (the publisher's address), `{name}` (the last part of it),
            `{channel}` and `{type}` are filled in.
        type: the type of the packets; `*`: all.
        payload: `body`: the fields of the packet's body, as JSON; `packet`: also its source, type, stamp and number.
        qos: the quality of service.
        retain: whether the broker keeps the newest for those who subscribe later.
        max_hz: so many packets a second of each publisher at the most; without it, all.
        others: whether packets that came from other agents are published as well.
    """

    channel: str
    topic: str
    type: str = "*"
    payload: Literal["body", "packet"] = "body"
    qos: Qos = 0
    retain: bool = False
    max_hz: Positive | None = None
    others: bool = False

    def __post_init__(self) -> None:
        if fault := fault_of_name(self.channel) or fault_of_template(self.topic, PLACES):
            raise ValueError(fault)


@dataclass
class TakeRow:
    """Which messages become packets.

    Attributes:
        topic: the topic, or a filter with `+` and `#`.
        type: the type of the packets.
        channel: the channel on which they are published.
        to: the destination of the packets; empty: all subscribers of this agent.
        fields: the path in the JSON for each field of the body; those that are not named are taken by their own name.
            Where a body needs one field, its value may also be the payload itself.
        qos: the quality of service that the broker is asked for.
        retained: whether a message that the broker has kept, and that may be old, is taken.
    """

    topic: str
    type: str
    channel: str = NETWORK
    to: str = ""
    fields: dict[str, str] = field(default_factory=dict)
    qos: Qos = 1
    retained: bool = False

    def __post_init__(self) -> None:
        if fault := fault_of_name(self.channel) or fault_of_filter(self.topic):
            raise ValueError(fault)
        if self.retained and (fault := fault_of_retained(self.topic)):
            raise ValueError(fault)
        if self.channel in NOT_TAKEN:
            raise ValueError(f"no message becomes a packet on {self.channel}: take it on {SYSTEM}, or on another")
