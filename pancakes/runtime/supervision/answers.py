"""The answers that a component owes: each request gets one, and no more than one."""

from __future__ import annotations

from typing import Any, Final

from pancakes.control import Reply
from pancakes.errors import PancakesError
from pancakes.packet import SYSCTRL, Cause
from pancakes.runtime.kernel.component import Component
from pancakes.runtime.life.request import Request

ANSWERED_S: Final = 2.5
"""An asker whose command is not done after so long, in host time, is told what it waits for."""


class Answers:
    """The requests that a component has taken and not answered yet. In that component's actor, or once it has ended.

    Args:
        component: the component; the answers are published in its name.
    """

    def __init__(self, component: Component) -> None:
        self._component = component
        self._owed: dict[int, Request] = {}
        self._put_off: set[int] = set()  # those whose askers were told that they wait

    def owe(self, request: Request) -> None:
        """A request has come in."""
        self._owed[request.number] = request

    def owes(self, cause: Cause) -> bool:
        """Returns whether the asker of a packet still waits for the answer of this component."""
        return any(request.cause == cause for request in self._owed.values())

    def forget_all(self) -> list[Request]:
        """Returns all requests that are not answered, and forgets them: another component answers them."""
        owed = [request for request in self._owed.values() if self.waits(request)]
        self._owed.clear()
        self._put_off.clear()
        return owed

    def put_off(self, request: Request, reason: str) -> None:
        """Tells the asker what a request waits for; what becomes of it in the end is said on `log`."""
        if self.waits(request):
            self._put_off.add(request.number)
            self._reply(request, Reply(False, reason, None, request.number))

    def waits(self, request: Request) -> bool:
        """Returns whether the asker has not been told yet what becomes of a request."""
        return request.number in self._owed and request.number not in self._put_off

    def pass_on(self, request: Request) -> None:
        """Another component answers this request from now on."""
        self._owed.pop(request.number, None)

    def give(self, request: Request, reason: str = "", result: Any = None) -> None:
        """Answers a request; where the answer cannot be sent, the asker is told that, and why.

        Args:
            request: the request.
            reason: why it is not done; empty: it is.
            result: what was asked for, where that is something to know.
        """
        self._owed.pop(request.number, None)
        if request.number in self._put_off:
            self._put_off.discard(request.number)
            became = f"was not done: {reason}" if reason else "is done"
            text = f"what {request.by} asked for (#{request.number}) {became}"
            self._component.log("warning" if reason else "info", text)
            return
        self._reply(request, Reply(not reason, reason, result, request.number))

    def refuse_all(self, reason: str) -> None:
        """Tells all askers that still wait that what they asked for is not done."""
        for request in list(self._owed.values()):
            self.give(request, reason)

    def _reply(self, request: Request, reply: Reply) -> None:
        try:
            try:
                self._send(request, reply)
            except PancakesError as error:
                # Too large for a frame, say: a short refusal fits.
                self._send(request, Reply(False, f"the answer is lost: {error}", None, request.number))
        except PancakesError as error:
            # A component must not fail because an asker does not listen fast enough.
            self._component.log("warning", f"the answer to {request.by} was lost: {error}")

    def _send(self, request: Request, reply: Reply) -> None:
        self._component.publish(SYSCTRL, reply, to=request.by, cause=request.cause)
