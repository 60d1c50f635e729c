"""Dispatchers decide where a component runs; the component never knows (Akka's word).

`PoolDispatcher` runs many components on a few threads, `PinnedDispatcher` gives one a thread of its own,
`VirtualDispatcher` runs whole fleets on one thread in virtual time.
"""

from __future__ import annotations

import logging
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from pancakes.kernel.mailbox import Mailbox

if TYPE_CHECKING:
    from pancakes.kernel.component import Component

_LOG: Final = logging.getLogger("pancakes.kernel")

Deferred = list[Callable[[], None]]


class Turns:
    """The turns that one thread gives: one at a time, of whatever dispatcher.

    Attributes:
        given: whether it gives turns just now.
        deferred: what they have put off.
    """

    __slots__ = ("deferred", "given")

    def __init__(self) -> None:
        self.given = False
        self.deferred: Deferred = []


class _Thread(threading.local):
    """What each thread has for itself."""

    def __init__(self) -> None:
        self.turns = Turns()


_THREAD: Final = _Thread()


def defer(function: Callable[[], None]) -> None:
    """Runs `function` at the end of the turn that this thread gives now, or at once outside of a turn."""
    turns = _THREAD.turns
    if turns.given:
        turns.deferred.append(function)
    else:
        function()


def turns_of_thread() -> Turns:
    """Returns the turns of the calling thread: for who begins and ends them with each moment, as virtual time does."""
    return _THREAD.turns


def begin_turns() -> Deferred:
    """Says that the calling thread gives turns from now on.

    Returns:
        What they put off, for `Component.take_turn`.
    """
    turns = _THREAD.turns
    turns.deferred, turns.given = [], True
    return turns.deferred


def end_turns() -> None:
    """Says that the calling thread gives no turns any more."""
    _THREAD.turns.given = False


def run_deferred(deferred: Deferred, component: Component | None) -> None:
    """Runs what a turn of `component` has put off; None: what its thread has put off between two turns."""
    for function in deferred:
        try:
            function()
        except Exception as error:  # the thread, and the component's right to turns, must outlive it
            if component is None:
                _LOG.exception("what was put off between two turns failed")
                continue
            text = f"what a turn of {component.address} had put off failed: {type(error).__name__}: {error}"
            component.kernel.log("error", text)
    deferred.clear()


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

    def give_turn(self, mailbox: Mailbox, deferred: Deferred, slice_s: float | None = None) -> None:
        """Gives the component of `mailbox` one turn in this thread, if it has one.

        Args:
            mailbox: its mailbox, whose token is held.
            deferred: what this thread's turns put off (`begin_turns`).
            slice_s: after this time the turn ends even if more waits; None: no limit.
        """
        component = mailbox.component
        if component is not None:
            component.take_turn(slice_s, deferred)
