"""What the courier and the services that host tasks tell each other: data."""

from __future__ import annotations

from typing import Final

import msgspec

from pancakes.mesh.migration.post import ForwardTo, Letter, Receipt
from pancakes.packet import Packet

COURIER: Final = "kernel/Courier"
"""Where on each agent the courier is."""


class CameFor(msgspec.Struct, frozen=True):
    """The courier tells a service that a packet has come for one of its tasks.

    Attributes:
        letter: the letter that it came in.
        packet: what is in it; None: it cannot be read here.
    """

    letter: Letter
    packet: Packet | None


class Say(msgspec.Struct, frozen=True):
    """Tell the courier of another agent something; it may be lost.

    Attributes:
        peer: the other agent.
        body: what to tell it.
    """

    peer: str
    body: Letter | Receipt | ForwardTo


class SendUnsent(msgspec.Struct, frozen=True):
    """There is something in the outbox that was not sent yet."""
