"""`Alarm`: one task that hears all nodes of the field and raises the alarm. It migrates with its state."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pancakes import NEIGHBOURS, SYSTEM, Packet, Positive, Task, Tick, every, on
from pancakes_sensor_field.fusion import FusionSettings, Situation, judge, remember
from pancakes_sensor_field.packets import AlarmCleared, AlarmRaised, Report


class Alarm(Task):
    """Fuse the reports of all nodes into one judgement of the field.

    Reports are addressed to it wherever it is, so none is lost while it migrates. It publishes `AlarmRaised` again and
    again while there is an alarm, and `AlarmCleared`, here and to all neighbours. Events: `alarm_raised`,
    `alarm_cleared`, and from time to time `tally`: how many reports of each node have come, and the number of the last
    one.
    """

    requires = ("temperature", "motion")

    @dataclass
    class Settings(FusionSettings):
        """The weights of the evidence, and how often it reports.

        Attributes:
            repeat_s: how often a lasting alarm is published again: a node may have slept.
            tally_s: seconds between two tallies.
        """

        repeat_s: Positive = 2.0
        tally_s: Positive = 20.0

    State = Situation

    settings: Settings
    state: Situation

    def on_start(self) -> None:
        self._tally_s = self.now() + self.settings.tally_s
        self._said_s = -math.inf

    @on(SYSTEM, Report)
    def reported(self, packet: Packet) -> None:
        """Take a node's report."""
        remember(self.state, packet.body, packet.stamp_s, self.settings)
        self._judge()

    @every(hz=1)
    def look(self, tick: Tick) -> None:
        """Check whether evidence is too old."""
        self._judge()
        if self.now() >= self._tally_s:
            self._tally_s += self.settings.tally_s
            heard = {name: [node.received, node.highest] for name, node in sorted(self.state.nodes.items())}
            self.event("tally", heard=heard, alarms=self.state.alarms, open=self.state.open)

    def _judge(self) -> None:
        evidence, change = judge(self.state, self.now(), self.settings)
        number = self.state.alarms
        if change == "raised":
            moving, hot = list(evidence.moving), list(evidence.hot)
            self.event("alarm_raised", number=number, weight=evidence.weight, moving=moving, hot=hot)
        elif change == "cleared":
            self.event("alarm_cleared", number=number)
            self._say(AlarmCleared(number))
        if self.state.open and self.now() - self._said_s >= self.settings.repeat_s - 1e-9:
            self._said_s = self.now()
            self._say(AlarmRaised(number, evidence.weight, evidence.moving, evidence.hot))

    def _say(self, body: AlarmRaised | AlarmCleared) -> None:
        self.publish(SYSTEM, body)
        self.publish(SYSTEM, body, to=NEIGHBOURS)
