"""What membership decides about connections to other agents."""

from __future__ import annotations

import msgspec

from pancakes.mesh.net.few_links import DropWaiting
from pancakes.mesh.wire.link_messages import Refusal


class Dial(msgspec.Struct, frozen=True):
    """Open a connection to `address`, and call it `link`."""

    address: str
    link: int


class Admit(msgspec.Struct, frozen=True):
    """`link` is the one that stays: say so to the peer."""

    link: int


class TurnDown(msgspec.Struct, frozen=True):
    """Refuse `link`, or end it where it is up: the peer is told the code and the reason."""

    link: int
    code: Refusal
    reason: str


class Rest(msgspec.Struct, frozen=True):
    """End `link`, which is up: the agent goes on, and may be dialled again when there is something to say."""

    link: int


Decision = Dial | Admit | TurnDown | Rest | DropWaiting
