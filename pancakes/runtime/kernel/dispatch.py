"""Dispatchers decide where a component runs; the component never knows (Akka's word).

`PoolDispatcher` runs many components on a few threads, `PinnedDispatcher` gives one a thread of its own,
`VirtualDispatcher` runs whole fleets on one thread in virtual time.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable

from pancakes.runtime.kernel.mailbox import Mailbox, Runnable


class Turn(threading.local):
    """The turn that a thread gives now, if it gives one.

    Attributes:
        deferred: what the turn has put off; None outside of a turn.
    """

    deferred: list[Callable[[], None]] | None = None


TURN = Turn()


def defer(function: Callable[[], None]) -> None:
    """Runs `function` at the end of the turn that this thread gives now, or at once outside of a turn."""
    if TURN.deferred is None:
        function()
    else:
        TURN.deferred.append(function)


def is_for_program(error: BaseException) -> bool:
    """Tell whether an exception is for the program that runs an actor, and no failure of that actor.

    A signal's handler raises such exceptions in the midst of whatever the main thread does: KeyboardInterrupt, the
    time-out of a test. So do test frameworks to end a test: what `pytest.fail` and `pytest.skip` raise. Python's rule
    is that no ordinary error derives from BaseException directly.
    """
    return not isinstance(error, (Exception, SystemExit, GeneratorExit))


class Dispatcher(ABC):
    """Gives turns to components whose mailboxes have something in them."""

    @abstractmethod
    def ready(self, mailbox: Mailbox) -> None:
        """Sees that the component of `mailbox`, whose token is held, gets a turn. Any thread."""

    def attach(self, component: Runnable) -> None:
        """Lets `component` run from now on; its first turn calls `on_start`. Any thread."""
        mailbox = component.actor_inbox
        mailbox.dispatch = self
        mailbox.component = component
        mailbox.enter_all()
        self.ready(mailbox)

    def stop(self) -> None:
        """Ends the dispatcher's threads. Not to be called from one of them."""

    def give_turn(self, mailbox: Mailbox, slice_s: float | None = None) -> None:
        """Gives the component of `mailbox` one turn in this thread, if it has one.

        Args:
            mailbox: its mailbox, whose token is held.
            slice_s: after this time the turn ends even if more waits; None: no limit.
        """
        component = mailbox.component
        if component is not None:
            component.take_turn(slice_s)
