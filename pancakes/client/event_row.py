"""Something that an agent said has happened."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from pancakes.client.heard_packet import HeardPacket
from pancakes.client.sentences import sentence_of
from pancakes.events import Event
from pancakes.packet import agent_of, body_to_plain


class EventRow(msgspec.Struct, frozen=True, kw_only=True):
    """An event on `log`, or a line for people, whose kind is `line`. Its `str` is a sentence.

    Attributes:
        agent: the agent that said it.
        source: the address of the component that said it.
        stamp_s: when, in mission seconds of that agent.
        kind: what happened, such as `task_started`.
        fields: its particulars, as plain values; of a line `level` and `text`.
    """

    agent: str
    source: str
    stamp_s: float
    kind: str
    fields: Mapping[str, Any] = {}

    @classmethod
    def of(cls, heard: HeardPacket[Any]) -> EventRow:
        """Returns what a packet of `log` says."""
        packet = heard.packet
        if isinstance(packet.body, Event):
            kind, fields = packet.body.kind, packet.body.fields
        else:
            kind, fields = packet.type, body_to_plain(packet.body)
        return cls(agent=agent_of(packet.source), source=packet.source, stamp_s=packet.stamp, kind=kind, fields=fields)

    def __str__(self) -> str:
        about = {"t_s": self.stamp_s, "agent": self.agent, "source": self.source, "kind": self.kind}
        return sentence_of({**self.fields, **about})
