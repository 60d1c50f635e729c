"""The rows of the service's tables: which packets are published, and which messages are taken."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal

from pancakes import LOG, NETWORK, SYSCTRL, SYSTEM, Positive
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
"""The placeholders in topics, with an example of each."""
NOT_TAKEN: Final = (SYSCTRL, LOG)
"""Channels that messages cannot reach: a broker must not give orders to an agent, or write its log."""


@dataclass
class PublishRow:
    """Which packets of a channel become messages.

    Attributes:
        channel: the channel.
        topic: the topic, in which `{agent}`, `{source}` (the publisher's address), `{name}` (the last part of it),
            `{channel}` and `{type}` are filled in.
        type: the type of the packets; `*`: all.
        payload: `body`: the fields of the packet's body, as JSON; `packet`: also its source, type, stamp and number.
        qos: the quality of service.
        retain: whether the broker keeps the newest for those who subscribe later.
        max_hz: at most this many packets a second of each publisher; without it, all.
        others: also publish packets that came from other agents.
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
        fields: the path in the JSON for each field of the body; fields without a path are found by their own name. If a
            body needs only one field, the payload itself may be its value.
        qos: the quality of service of the subscription.
        retained: also take retained messages, which may be old.
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
            raise ValueError(f"messages cannot become packets on {self.channel}: use {SYSTEM}, or another channel")
