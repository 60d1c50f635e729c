"""One step of the machine of a hosted task: it feeds life and hand-off, and joins them by rules. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Final, get_args

import msgspec
from msgspec.structs import replace

from pancakes.hosting.hosting_effect import HostingEffect, Lasts, PassedOn, Unreserve, Vacate
from pancakes.hosting.hosting_event import HostingEvent
from pancakes.hosting.leave import Leave
from pancakes.hosting.standing import Standing
from pancakes.life.life import Life
from pancakes.life.life_effect import Effect as LifeEffect
from pancakes.life.life_event import Event as LifeEvent
from pancakes.life.life_event import Written
from pancakes.life.restart import Draw
from pancakes.life.table import handle as live
from pancakes.migration.core import TIMES, handle
from pancakes.migration.effect import Effect
from pancakes.migration.event import Event


class Moment(msgspec.Struct, frozen=True):
    """What a rule may ask besides how the task stands.

    Attributes:
        me: this agent's name.
        now_s: host time.
        draw: draws the length of a pause.
        closing: whether the task's service ends.
    """

    me: str
    now_s: float
    draw: Draw
    closing: bool = False


AnyEvent = LifeEvent | Event | HostingEvent
AnyEffect = PassedOn | HostingEffect


class Turn:
    """One step: what it has changed so far, and what is to be done.

    Args:
        life: the life of the task; None: it has no place here.
        standing: how it stands besides.
        at: the moment.
        rules: what means something for the other half, by its type.

    Attributes:
        effects: what is to be done, in this order.
        why_not: why the record could not be written, where that is the event.
    """

    def __init__(self, life: Life | None, standing: Standing, at: Moment, rules: Rules) -> None:
        self.life = life
        self.standing = standing
        self.at = at
        self.effects: list[Any] = []
        self.why_not = ""
        self._rules = rules
        self._lives: deque[tuple[LifeEvent, Leave]] = deque()
        self._living = False
        self._going = False
        self.leave = Leave.ENTRY
        self.decided: Event | None = None

    def take(self, event: AnyEvent) -> None:
        """Takes the event of this step."""
        settled = self.standing.settled
        if type(event) in _LIFE_EVENTS:
            self.live(event)  # type: ignore[arg-type]
        elif type(event) in _HOSTING_EVENTS:
            self._rules[type(event)](self, event)
        else:
            self.feed(event)  # type: ignore[arg-type]
        self.go_on()
        if self.standing.settled:
            if self.standing.rests:
                self.change(rests=False)
                self.live(Written(self.why_not))
            if not settled:
                self.do(Lasts(self.why_not))
        if self.standing.leaving and self.life is not None and self.life.at_rest:
            self.change(leaving=False)
            self.do(Vacate())

    def do(self, effect: AnyEffect) -> None:
        """Has an effect carried out, after those before it."""
        self.effects.append(effect)

    def change(self, **changes: Any) -> None:
        """Changes how the task stands."""
        self.standing = replace(self.standing, **changes)

    def feed(self, event: Event) -> None:
        """Feeds an event to the hand-off, which takes it after those before it."""
        self.change(events=(*self.standing.events, event))

    def live(self, event: LifeEvent, leave: Leave = Leave.ENTRY) -> None:
        """Feeds an event to the life, which takes it after those before it.

        Args:
            event: the event.
            leave: by what a start that follows gets leave.
        """
        self._lives.append((event, leave))
        if self._living:
            return
        self._living = True
        while self._lives:
            event, self.leave = self._lives.popleft()
            assert self.life is not None
            self.life, effects = live(self.life, event, self.at.now_s, self.at.draw)
            for effect in effects:
                self._carry(effect)
        self._living = False

    def go_on(self) -> None:
        """Goes on with the hand-off, until one of its effects takes time."""
        if self._going:
            return
        self._going = True
        while self.standing.waits is None:
            standing = self.standing
            if standing.effects:
                effect, *later = standing.effects
                self.change(effects=tuple(later))
                self._carry(effect)
            elif standing.events:
                self.decided, *waiting = standing.events
                effects = handle(self.at.me, standing.record, standing.volatile, self.decided, TIMES)
                self.change(events=tuple(waiting), effects=tuple(effects))
            else:
                break
        self._going = False

    def _carry(self, effect: LifeEffect | Effect) -> None:
        rule = self._rules.get(type(effect))
        if rule is None:
            self.effects.append(effect)
        else:
            rule(self, effect)

    def done(self) -> None:
        """The start that the hand-off asked for is decided: it goes on."""
        self.change(waits=None, begins=False)
        self.do(Unreserve())
        self.go_on()


Rule = Callable[[Turn, Any], None]
Rules = Mapping[type, Rule]

_LIFE_EVENTS: Final = frozenset(get_args(LifeEvent))
_HOSTING_EVENTS: Final = frozenset(get_args(HostingEvent))
