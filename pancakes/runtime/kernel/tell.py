"""How one actor gives another a message that is no packet: data, and nothing that the other could call."""

from __future__ import annotations

from functools import partial

from pancakes.runtime.kernel.call import Call
from pancakes.runtime.kernel.component import Component


def tell(component: Component, message: object) -> bool:
    """Gives an actor a message, which its `on_receive` takes after what it is doing now. Any thread.

    Its successor at the same address does not get it.

    Returns:
        False where the actor has ended, and the message is forgotten.
    """
    alive = not component.actor_stopped.is_set()
    if alive:
        component.actor_inbox.put(Call(component, partial(component.on_receive, message)))
    return alive
