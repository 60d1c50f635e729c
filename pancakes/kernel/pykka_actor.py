"""A pykka actor whose turns others give: everything that Pancakes uses of pykka's internals is in this file.

It relies on these promises, which pykka does not document and `tests/kernel/test_pykka_contract.py` checks:

- `Actor` makes its inbox, its futures and its loop by `_create_actor_inbox`, `_create_future` and `_start_actor_loop`.
- `Actor.start` calls `_start_actor_loop` of an actor once it is made.
- A reference puts `Envelope(message, reply_to)` into `actor_inbox`; `reply_to` is a future or None.
- A reference reads `actor_urn`, `actor_inbox`, `actor_stopped` and the class of an actor, and nothing else of it.
- `Actor._handle_receive` carries out a message: it calls `_stop` for an `_ActorStop`, does what a proxy asks for, and
  calls `on_receive` for anything else.

`Flag` is what pykka uses of a `threading.Event`, with one lock and nothing else: there is one for each actor.
"""

from __future__ import annotations

import contextlib
import sys
import threading
from typing import TYPE_CHECKING, Any

import pykka
from pykka._envelope import Envelope
from pykka.messages import _ActorStop as ActorStop


class Flag:
    """What pykka uses of a `threading.Event`, with one lock and nothing else: there is one for each actor.

    Attributes:
        on: whether it has happened, as `is_set` says, for those who ask with each packet. Any thread.
    """

    __slots__ = ("_gate", "on")

    def __init__(self) -> None:
        self.on = False
        self._gate = threading.Lock()  # held until it happens
        self._gate.acquire()

    def is_set(self) -> bool:
        """Return whether it has happened."""
        return self.on

    def set(self) -> None:
        """Say that it has happened."""
        self.on = True
        with contextlib.suppress(RuntimeError):  # it had happened already
            self._gate.release()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it happens, for at most `timeout` seconds; return whether it has."""
        if not self.on and self._gate.acquire(timeout=-1 if timeout is None else timeout):
            with contextlib.suppress(RuntimeError):
                self._gate.release()  # for the next thread that waits
        return self.on


if TYPE_CHECKING:

    class _Actor:
        """pykka's actor as type checkers see it: pykka says of its hooks that they return nothing."""

        def __init__(self, *args: Any, **others: Any) -> None: ...

        @classmethod
        def start(cls, *args: Any, **others: Any) -> pykka.ActorRef[Any]: ...

        @property
        def actor_ref(self) -> pykka.ActorRef[Any]: ...

        actor_inbox: Any
        actor_stopped: Any
else:
    _Actor = pykka.Actor


class PykkaActor(_Actor):
    """A pykka actor that runs as Pancakes has it, and answers pykka's references, proxies and futures."""

    __slots__ = ()

    @staticmethod
    def _create_future() -> pykka.Future[Any]:
        return pykka.ThreadingFuture()

    def stop(self) -> None:
        """End this actor after what it is doing now. Any thread; one that has ended already is left alone."""
        # pykka's own raises if the actor ends just then.
        if not self.actor_stopped.is_set():
            self.actor_inbox.put(Envelope(ActorStop()))


def handle_envelope(actor: Any, envelope: Envelope[Any]) -> None:
    """Handle what came by a reference: `tell`, `ask`, a proxy's call, `stop`. In the actor."""
    try:
        response = actor._handle_receive(envelope.message)  # noqa: SLF001
    except BaseException as error:
        if envelope.reply_to is None:
            raise
        # As in pykka: the caller gets the error, and the actor lives.
        envelope.reply_to.set_exception(sys.exc_info())
        if not isinstance(error, Exception):
            raise
        return
    if envelope.reply_to is not None:
        envelope.reply_to.set(response)


def is_envelope(item: Any) -> bool:
    """Return whether something that came in an inbox is for `handle_envelope`."""
    return isinstance(item, Envelope)


def dismiss(item: Any) -> None:
    """Tell a caller that waits for an answer to `item`, which an ended actor has not handled, that none will come."""
    if not isinstance(item, Envelope) or item.reply_to is None:
        return
    if isinstance(item.message, ActorStop):
        item.reply_to.set(None)
    else:
        error = pykka.ActorDeadError(f"stopped before it handled {item.message!r}")
        item.reply_to.set_exception((pykka.ActorDeadError, error, None))
