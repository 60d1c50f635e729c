"""What other actors of this agent tell the courier, and it tells the services: data."""

from __future__ import annotations

from typing import Final

import msgspec

from pancakes.durable.delivery import AskBegan, ForwardTo, Letter, Receipt, StreamsBegan
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
    body: Letter | Receipt | ForwardTo | StreamsBegan


class AskedBegan(msgspec.Struct, frozen=True):
    """The courier tells a service that another agent asks from what state one of its tasks began; answered by `Say`.

    Attributes:
        peer: the agent that asks.
        asked: what it asks.
    """

    peer: str
    asked: AskBegan


class SendUnsent(msgspec.Struct, frozen=True):
    """There is something in the outbox that was not sent yet."""
