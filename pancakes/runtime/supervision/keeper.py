"""What feeds lives with events, and has their effects carried out, one after the other."""

from __future__ import annotations

from collections import deque
from typing import Generic, Protocol, TypeVar, assert_never

from pancakes.runtime.kernel.component import Component
from pancakes.runtime.life.life import Life
from pancakes.runtime.life.life_effect import (
    Answer,
    AskLeave,
    Effect,
    LetGo,
    LookAgain,
    Revoke,
    Settle,
    Spawn,
    Tell,
    TellToEnd,
    TryAt,
    WriteRest,
)
from pancakes.runtime.life.life_event import Event, Retry, TryDue
from pancakes.runtime.life.table import handle

LOOK_S = 1.0
"""How often, in host time, what was refused is tried again, for want of a device, say."""


class Living(Protocol):
    """Where something lives; it outlives the actors that fill it."""

    life: Life


P = TypeVar("P", bound=Living)
P_contra = TypeVar("P_contra", bound=Living, contravariant=True)


class LifeRim(Protocol[P_contra]):
    """What carries the effects of lives out, in its own actor; see `pancakes.runtime.life.life_effect` for each.

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

    def __init__(self, component: Component, rim: LifeRim[P]) -> None:
        self._component = component
        self._rim = rim
        self._events: deque[tuple[P, Event]] = deque()
        self._turning = False

    def feed(self, place: P, event: Event) -> None:
        """Takes an event of one life, and carries out what follows."""
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
        """Draws the length of a pause."""
        return self._component.random.uniform(low, high)

    def carry_out(self, place: P, effect: Effect) -> None:
        """Carries one effect of a life out."""
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
