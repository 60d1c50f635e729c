"""What actors know of each other."""

from __future__ import annotations

from typing import Any, Protocol

import pykka

from pancakes.runtime.kernel.mailbox import Runnable


class Reference(Runnable, Protocol):
    """All that one actor uses of another, as pykka's `ActorRef`: where it is, its mailbox, and whether it has ended.

    The actor itself stands behind it. What else it has is for that actor alone: `tell` brings it a message, and what
    others want to read of it stands in a table that is shared. Any thread.
    """

    @property
    def agent(self) -> str:
        """The name of its agent."""

    @property
    def name(self) -> str:
        """The last part of its address."""

    @property
    def actor_ref(self) -> pykka.ActorRef[Any]:
        """Pykka's own reference to it."""

    def stop(self) -> None:
        """Ends the actor after what it is doing now."""

    def revoke(self) -> None:
        """Takes the right to publish away from an actor that cannot be ended."""
