"""The supervisor: feeds lives with events and carries out their effects, and answers each request once.

`Keeper` is shared by services (for their tasks) and by the root (for its services); what differs is in the `LifeRim`
that each gives it. If an event comes while effects are carried out, it waits until the last of them is done. All runs
in the owner's actor. `Answers` keeps the requests that its owner has not answered yet.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Final, Generic, Protocol, TypeVar, assert_never

from pancakes.control import Refusal, Reply
from pancakes.errors import PancakesError
from pancakes.kernel.actor import ActorCore
from pancakes.packet import SYSCTRL, Cause
from pancakes.supervision.lifecycle import (
    Answer,
    AskLeave,
    Effect,
    Event,
    LetGo,
    Life,
    LookAgain,
    Request,
    Retry,
    Revoke,
    Settle,
    Spawn,
    Tell,
    TellToEnd,
    TryAt,
    TryDue,
    WriteRest,
)
from pancakes.supervision.lifecycle_table import handle

LOOK_S = 1.0
"""How often, in host time, what was refused is tried again, for want of a device, say."""


class Living(Protocol):
    """Where something lives; it outlives the actors that fill it."""

    life: Life


P = TypeVar("P", bound=Living)
P_contra = TypeVar("P_contra", bound=Living, contravariant=True)


class LifeRim(Protocol[P_contra]):
    """What carries the effects of lives out, in its own actor; see `pancakes.supervision.lifecycle` for each.

    `show` comes first, once a life has changed: what others may read of the place is brought up to date.
    """

    def feed(self, place: P_contra, event: Event) -> None: ...

    def show(self, place: P_contra) -> None: ...

    def ask_leave(self, place: P_contra) -> None: ...

    def spawn(self, place: P_contra) -> None: ...

    def halt(self, place: P_contra) -> None: ...

    def revoke_rights(self, place: P_contra) -> None: ...

    def let_go(self, place: P_contra) -> None: ...

    def settle(self, place: P_contra) -> None: ...

    def write_rest(self, place: P_contra) -> None: ...

    def answer(self, place: P_contra, effect: Answer) -> None: ...

    def tell_news(self, place: P_contra, effect: Tell) -> None: ...


class Keeper(Generic[P]):
    """Feeds the lives of one component's places, in that component's actor.

    An event that comes while effects are carried out waits until the last of them is.

    Args:
        component: the component; gives the time, the timers and the random numbers.
        rim: what carries the effects out.
    """

    def __init__(self, component: ActorCore, rim: LifeRim[P]) -> None:
        self._component = component
        self._rim = rim
        self._events: deque[tuple[P, Event]] = deque()
        self._turning = False

    def feed(self, place: P, event: Event) -> None:
        """Take an event of one life, and carry out what follows."""
        self._events.append((place, event))
        if self._turning:
            return
        self._turning = True
        try:
            while self._events:
                place, event = self._events.popleft()
                place.life, effects = handle(place.life, event, self._component.kernel.host.now(), self.draw)
                self._rim.show(place)
                for effect in effects:
                    self.carry_out(place, effect)
        finally:
            self._turning = False

    def draw(self, low: float, high: float) -> float:
        """Draw the length of a pause."""
        return self._component.random.uniform(low, high)

    def carry_out(self, place: P, effect: Effect) -> None:
        """Carry one effect of a life out."""
        rim = self._rim
        match effect:
            case AskLeave():
                rim.ask_leave(place)
            case Spawn():
                rim.spawn(place)
            case TellToEnd():
                rim.halt(place)
            case Revoke():
                rim.revoke_rights(place)
            case LetGo():
                rim.let_go(place)
            case TryAt():
                self._later(effect.due_s - self._component.kernel.host.now(), place, TryDue(effect.due_s))
            case LookAgain():
                self._later(LOOK_S, place, Retry())
            case Settle():
                rim.settle(place)
            case WriteRest():
                rim.write_rest(place)
            case Answer():
                rim.answer(place, effect)
            case Tell():
                rim.tell_news(place, effect)
            case _:
                assert_never(effect)

    def _later(self, delay_s: float, place: P, event: Event) -> None:
        self._component.after_host(delay_s, lambda: self._rim.feed(place, event))


ANSWERED_S: Final = 2.5
"""An asker whose command is not done after this long, in host time, is told what it waits for."""


class Answers:
    """The requests that a component has taken and not answered yet. In that component's actor, or once it has ended.

    Args:
        component: the component; the answers are published in its name.
    """

    def __init__(self, component: ActorCore) -> None:
        self._component = component
        self._owed: dict[int, Request] = {}
        self._put_off: set[int] = set()  # those whose askers were told that they wait

    def owe(self, request: Request) -> None:
        """A request has come in."""
        self._owed[request.number] = request

    def owes(self, cause: Cause) -> bool:
        """Return whether the asker of a packet still waits for the answer of this component."""
        return any(request.cause == cause for request in self._owed.values())

    def forget_all(self) -> list[Request]:
        """Return all requests that are not answered, and forget them: another component answers them."""
        owed = [request for request in self._owed.values() if self.waits(request)]
        self._owed.clear()
        self._put_off.clear()
        return owed

    def put_off(self, request: Request, reason: str) -> None:
        """Tell the asker what a request waits for; what becomes of it in the end is said on `log`."""
        if self.waits(request):
            self._put_off.add(request.number)
            self._reply(request, Reply(Refusal("pending", reason), None, request.number))

    def waits(self, request: Request) -> bool:
        """Return whether the asker has not been told yet what becomes of a request."""
        return request.number in self._owed and request.number not in self._put_off

    def pass_on(self, request: Request) -> None:
        """Another component answers this request from now on."""
        self._owed.pop(request.number, None)

    def give(self, request: Request, refusal: Refusal | None = None, result: Any = None) -> None:
        """Answer a request; if the answer cannot be sent, the asker is told that, and why.

        Args:
            request: the request.
            refusal: why it is not done; None: it is.
            result: what was asked for, if there is something to tell.
        """
        self._owed.pop(request.number, None)
        if request.number in self._put_off:
            self._put_off.discard(request.number)
            became = f"was not done: {refusal.text}" if refusal else "is done"
            text = f"what {request.by} asked for (#{request.number}) {became}"
            self._component.log("warning" if refusal else "info", text)
            return
        self._reply(request, Reply(refusal, result, request.number))

    def refuse_all(self, reason: str) -> None:
        """Tell all askers that still wait that what they asked for is not done."""
        for request in list(self._owed.values()):
            self.give(request, Refusal("failed", reason))

    def _reply(self, request: Request, reply: Reply) -> None:
        try:
            try:
                self._send(request, reply)
            except PancakesError as error:
                # Too large for a frame, say: a short refusal fits.
                self._send(request, Reply(Refusal("failed", f"the answer is lost: {error}"), None, request.number))
        except PancakesError as error:
            # A component must not fail because an asker does not listen fast enough.
            self._component.log("warning", f"the answer to {request.by} was lost: {error}")

    def _send(self, request: Request, reply: Reply) -> None:
        self._component.publish(SYSCTRL, reply, to=request.by, cause=request.cause)
