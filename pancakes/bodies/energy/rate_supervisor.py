"""`RateSupervisor`: reads sensors, and lowers or raises their rates (`energy.supervisor`, paper Figure 2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pancakes.bodies.energy.activity import RateSupervision, SupervisorSettings
from pancakes.bodies.energy.rim import AdjustingTask
from pancakes.errors import PancakesError
from pancakes.packet import Packet, agent_of, body_class, field_names, known_types
from pancakes.runtime.foundation.suggestion import did_you_mean
from pancakes.runtime.kernel.keep import LATEST
from pancakes.task import Tick, every


class RateSupervisor(AdjustingTask):
    """Lets tasks be fast while something happens, and slow while all is quiet, as its rules say.

    A task becomes fast with the very packet that says so, and slow at a tick. The supervisor sets everything back to
    fast when it is stopped. Events: `busy` and `quiet`, with the `rule`.
    """

    Settings = SupervisorSettings

    @dataclass
    class State:
        """What outlives a restart.

        Attributes:
            turned: whether any rate was ever changed.
        """

        turned: bool = False

    settings: SupervisorSettings
    state: State
    decider: RateSupervision

    def on_start(self) -> None:
        self._read: dict[tuple[str, str], None] = {}
        _check(self.settings)
        self._begin(self.state.turned)

    def on_settings(self) -> None:
        try:
            _check(self.settings)
        except PancakesError:
            self.settings = self._in_force
            raise
        # What the old settings slowed down and the new ones do not name is set back first.
        self.give_last(self.decider.give_back(self.now()))
        self._begin(True)

    def _begin(self, doubt: bool) -> None:
        self._in_force = self.settings
        self.decider = RateSupervision(self.settings, self.now(), doubt)
        for rule in self.settings.rules.values():
            if (rule.channel, rule.when) not in self._read:
                self._read[rule.channel, rule.when] = None
                self.subscribe(rule.channel, rule.when, self._heard_on(rule.channel, rule.when), keep=LATEST)

    def _heard_on(self, channel: str, kind: str) -> Callable[[Packet], None]:
        def heard(packet: Packet) -> None:
            own = agent_of(packet.source) == self.agent
            for name, rule in self.settings.rules.items():
                if (rule.channel, rule.when) == (channel, kind) and (own or rule.foreign):
                    self.decider.read(name, packet.body, self.now())
            self._decide()

        return heard

    @every(hz=2)
    def look(self, tick: Tick) -> None:
        """Looks whether it has become quiet."""
        self._decide()

    def _decide(self) -> None:
        before = self.decider.busy
        orders = self.decider.decide(self.now())
        for name, busy in self.decider.busy.items():
            if busy != before[name]:
                self.event("busy" if busy else "quiet", rule=name)
        self.give(orders)
        self.state.turned = self.state.turned or self.decider.book.turned


def _check(settings: SupervisorSettings) -> None:
    """Makes sure that the packets of all rules are known, and have their fields."""
    for name, rule in settings.rules.items():
        body = body_class(rule.when)
        if body is None:
            hint = did_you_mean(rule.when, known_types())
            raise PancakesError(f"the rule {name} reads packets of the unknown type {rule.when!r}{hint}")
        known = field_names(body)
        if known and rule.field not in known:
            raise PancakesError(f"the rule {name}: {rule.when} has no field {rule.field!r}, only {', '.join(known)}")
