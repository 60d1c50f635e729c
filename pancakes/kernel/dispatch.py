"""Dispatchers decide where a component runs; the component never knows (Akka's word).

`PoolDispatcher` runs many components on a few threads, `PinnedDispatcher` gives one a thread of its own,
`VirtualDispatcher` runs whole fleets on one thread in virtual time.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING

from pancakes.kernel.mailbox import Mailbox

if TYPE_CHECKING:
    from pancakes.kernel.component import Component


_TURN = threading.local()
"""What the turn that a thread gives now has put off; a thread gives one turn at a time, of whatever dispatcher."""


def defer(function: Callable[[], None]) -> None:
    """Runs `function` at the end of the turn that this thread gives now, or at once outside of a turn."""
    deferred: list[Callable[[], None]] | None = getattr(_TURN, "deferred", None)
    if deferred is None:
        function()
    else:
        deferred.append(function)


class Dispatcher(ABC):
    """Gives turns to components whose mailboxes have something in them."""

    @abstractmethod
    def ready(self, mailbox: Mailbox) -> None:
        """Sees that the component of `mailbox`, whose token is held, gets a turn. Any thread."""

    def attach(self, component: Component) -> None:
        """Lets `component` run from now on; its first turn calls `on_start`. Any thread."""
        mailbox = component.actor_inbox
        mailbox.dispatch = self
        mailbox.component = component
        mailbox.list_all()
        self.ready(mailbox)

    def stop(self) -> None:
        """Ends the dispatcher's threads. Not to be called from one of them."""

    def give_turn(self, mailbox: Mailbox, slice_s: float | None = None) -> None:
        """Gives the component of `mailbox` one turn in this thread, then hands its token back."""
        component = mailbox.component
        if component is None:
            return
        deferred: list[Callable[[], None]] = []
        _TURN.deferred = deferred
        try:
            component.take_turn(slice_s)
        finally:
            _TURN.deferred = None
            for function in deferred:
                try:
                    function()
                except Exception as error:  # the thread, and the component's right to turns, must outlive it
                    text = f"what a turn of {component.address} had put off failed: {type(error).__name__}: {error}"
                    component.kernel.log("error", text)
        # A stopped component keeps the token, so that what comes now waits for its successor.
        if mailbox.component is component:
            mailbox.token.release()
            if mailbox.has_work() and mailbox.token.acquire(False):
                self.ready(mailbox)
