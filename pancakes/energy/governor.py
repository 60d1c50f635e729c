"""Keep a mission alive as the battery empties: the task `energy.governor` (paper §3.4).

`GovernorSettings` is what a user configures. `GovernorDecider` decides, without any input or output: readings and
times in, orders out. `EnergyGovernor` is the task that carries the orders out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

from pancakes.control import Restart, Start, Stop
from pancakes.devices import Battery, Load
from pancakes.energy.adjusting_task import AdjustingTask
from pancakes.energy.orders import ANSWER_S, Decider, Knob, Order, Range, RateRange, Sleep
from pancakes.energy.policies import Feedback, FeedbackSettings, Step, Thresholds, faults_of
from pancakes.packet import SYSTEM, Packet, agent_of
from pancakes.settings import Share
from pancakes.task import Tick, every, on

NETWORK: Final = "network"
"""The service that sleeps."""


@dataclass
class GovernorSettings:
    """The policy, and what may be turned down.

    Attributes:
        policy: `thresholds` or `feedback`.
        thresholds: for the first: levels of the battery, from the highest, and the effort below each.
        hysteresis: how far the battery must rise above a threshold before that no longer counts.
        feedback: for the second: how long the battery must last.
        rates: rates of tasks, by `task` or `service/task`; `network/Discovery` sends the beacons of discovery.
        values: settings of tasks that are numbers, such as speeds, by task and by name.
        sleep: how the Network Service sleeps and wakes in turn; None: it never sleeps.
    """

    policy: Literal["thresholds", "feedback"] = "thresholds"
    thresholds: list[Step] = field(default_factory=list)
    hysteresis: Share = 0.03
    feedback: FeedbackSettings | None = None
    rates: dict[str, RateRange] = field(default_factory=dict)
    values: dict[str, dict[str, Range]] = field(default_factory=dict)
    sleep: Sleep | None = None

    def __post_init__(self) -> None:
        if self.policy == "thresholds" and not self.thresholds:
            raise ValueError("the policy 'thresholds' needs at least one threshold")
        if self.policy == "feedback" and self.feedback is None:
            raise ValueError("the policy 'feedback' needs a table feedback with until_s")
        fault = faults_of(self.thresholds, self.hysteresis)
        if fault:
            raise ValueError(fault)
        if not self.rates and not any(self.values.values()) and self.sleep is None:
            raise ValueError("there is nothing to govern: name rates, values or sleep")

    def knobs(self) -> dict[Knob, Range]:
        """Return all knobs with their ranges."""
        knobs: dict[Knob, Range] = {Knob(target, timer=rate.timer): rate for target, rate in self.rates.items()}
        for target, values in self.values.items():
            knobs.update({Knob(target, key): value for key, value in values.items()})
        return knobs


class GovernorDecider(Decider):
    """Decide for a governor: the effort, and the orders that follow from it.

    Args:
        settings: the policy and the knobs.
        now_s: the mission time.
        effort: where to begin: what a governor before this one decided.
        doubt: whether another governor ran before this one, so that the values of the knobs are not known.

    Attributes:
        effort: what the robot may do now, from 0 to 1.
        level: the battery's level by the last reading; NaN before the first.
    """

    def __init__(self, settings: GovernorSettings, now_s: float, effort: float = 1.0, doubt: bool = False) -> None:
        self._settings = settings
        self._knobs = settings.knobs()
        self._thresholds = Thresholds(settings.thresholds, settings.hysteresis)
        self._thresholds.resume(effort)
        self._feedback: Feedback | None = None
        if settings.policy == "feedback" and settings.feedback is not None:
            self._feedback = Feedback(settings.feedback, now_s, effort)
        super().__init__(self._values(1.0), doubt)
        self.effort = effort
        self.level = math.nan
        self._asleep = False
        self._sleep_from_s = -math.inf
        self._sleep_asked: int | None = None
        self._sleep_asked_s = -math.inf
        self._sleep_refusal = ""

    def battery(self, now_s: float, level: float) -> None:
        """Take a reading of the battery's level; NaN is ignored."""
        if math.isnan(level):
            return
        self.level = level
        if self._feedback is not None:
            self._feedback.battery(now_s, level)

    def load(self, cpu: float) -> None:
        """Take a reading of the processor's load."""
        if self._feedback is not None and not math.isnan(cpu):
            self._feedback.load(cpu)

    def decide(self, now_s: float) -> list[Order]:
        """Return the orders that are due; the caller passes each that it publishes to `asked`."""
        if math.isnan(self.level):
            return []
        if self._feedback is not None:
            self.effort = self._feedback.decide(now_s)
        else:
            self.effort = self._thresholds.decide(self.level)
        self.book.want(self._values(self.effort))
        return [*self.book.due(now_s), *self._sleep(now_s)]

    def restore(self, now_s: float) -> list[Order]:
        orders = super().restore(now_s)
        if not self._asleep:
            return orders
        if self.book.turned_in(NETWORK):
            # Its tasks cannot be asked for anything while it sleeps: it wakes as it is configured.
            return [*orders, Order(Restart(NETWORK, keep_state=False), {})]
        return [*orders, Order(Start(NETWORK), {})]

    def _values(self, effort: float) -> dict[Knob, float]:
        return {knob: knob_range.at(effort) for knob, knob_range in self._knobs.items()}

    def _sleep(self, now_s: float) -> list[Order]:
        sleep = self._settings.sleep
        if sleep is None or (self._sleep_asked is not None and now_s < self._sleep_asked_s + ANSWER_S):
            return []
        for_s = sleep.at(self.effort)
        if for_s == 0.0:
            return [Order(Start(NETWORK), {})] if self._asleep else []
        if self._asleep or now_s < self._sleep_from_s + sleep.every_s:
            return []
        self._sleep_from_s = now_s
        return [Order(Stop(NETWORK, for_s=for_s), {})]

    def asked(self, seq: int, order: Order, now_s: float) -> None:
        if isinstance(order.body, (Start, Stop, Restart)):
            self._sleep_asked, self._sleep_asked_s = seq, now_s
        else:
            super().asked(seq, order, now_s)

    def answered(self, seq: int, ok: bool, reason: str, result: Any = None) -> list[str]:
        if seq != self._sleep_asked:
            return super().answered(seq, ok, reason, result)
        self._sleep_asked = None
        if ok:
            self._sleep_refusal = ""
        elif reason != self._sleep_refusal:
            self._sleep_refusal = reason
            return [f"the Network Service does not sleep: {reason}"]
        return []

    def on_event(self, kind: str, fields: Mapping[str, Any]) -> None:
        super().on_event(kind, fields)
        if fields.get("service") == NETWORK and kind in ("service_stopped", "service_started"):
            self._asleep = kind == "service_stopped"


class EnergyGovernor(AdjustingTask):
    """Watch the battery of the agent, and turn down rates, settings and the network, by a policy.

    It sends control packets. It restores everything when the battery has recovered, and when it is stopped. Event:
    `effort_changed`.
    """

    requires = ("battery",)

    Settings = GovernorSettings

    @dataclass
    class State:
        """The state that outlives a restart.

        Attributes:
            effort: what was decided last.
            turned: whether any knob was ever turned.
        """

        effort: float = 1.0
        turned: bool = False

    settings: GovernorSettings
    state: State
    decider: GovernorDecider

    def on_start(self) -> None:
        self.decider = GovernorDecider(self.settings, self.now(), self.state.effort, self.state.turned)

    def on_settings(self) -> None:
        # First restore what the old settings turned down and the new ones may not name.
        self.restore()
        self.decider = GovernorDecider(self.settings, self.now(), self.state.effort, True)

    @on(SYSTEM, Battery, queue="latest")
    def measured(self, packet: Packet) -> None:
        """Take a reading of the battery."""
        if agent_of(packet.source) == self.agent:
            self.decider.battery(self.now(), packet.body.level)

    @on(SYSTEM, Load, queue="latest")
    def loaded(self, packet: Packet) -> None:
        """Take a reading of the processor's load."""
        if agent_of(packet.source) == self.agent:
            self.decider.load(packet.body.cpu)

    @every(hz=1)
    def decide(self, tick: Tick) -> None:
        """Decide, and publish the orders that follow."""
        orders = self.decider.decide(self.now())
        effort = self.decider.effort
        if effort != self.state.effort:
            self.state.effort = effort
            self.event("effort_changed", effort=effort, level=self.decider.level, policy=self.settings.policy)
        self.publish_orders(orders)
