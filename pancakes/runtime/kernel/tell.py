"""How one actor gives another a message that is no packet: data, and nothing that the other could call."""

from __future__ import annotations

from pancakes.runtime.kernel.mailbox import Runnable
from pancakes.runtime.kernel.reference import Reference


class Told:
    """A message that waits in a control lane for a turn of its actor, and of none of that actor's successors."""

    __slots__ = ("component", "message")

    def __init__(self, component: Runnable, message: object) -> None:
        self.component = component
        self.message = message


def tell(component: Reference, message: object) -> bool:
    """Gives an actor a message, which its `take_message` takes after what it is doing now. Any thread.

    Its successor at the same address does not get it.

    Returns:
        False where the actor has ended, and the message is forgotten.
    """
    alive = not component.actor_stopped.is_set()
    if alive:
        component.actor_inbox.put(Told(component, message))
    return alive
