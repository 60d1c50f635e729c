"""A command whose sender waits for an answer."""

from __future__ import annotations

import msgspec

from pancakes.control import Command
from pancakes.packet import Cause


class Request(msgspec.Struct, frozen=True):
    """The sender of a control packet, and which of its packets that was.

    Attributes:
        by: the sender's address.
        cause: the packet.
        number: its place in the order of all commands to this agent.
    """

    by: str
    cause: Cause
    number: int = 0


def request_of(command: Command) -> Request:
    """Returns the request that a command carries out."""
    return Request(command.request[0], command.request, command.number)
