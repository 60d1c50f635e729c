"""Tasks with goals and calls, for agents in the tests of ROS 2."""

import json
from dataclasses import dataclass, field
from typing import Any

from pancakes_ros2.action_task import ActionTask
from pancakes_ros2.goal_packets import CALL, Call, CallAnswer, GoalStatus

from pancakes.packet import CTRL, SYSTEM
from pancakes.task import Task, Tick, every, on


class Errand(ActionTask[Any, Any]):
    """Has goals reached, one after the other."""

    @dataclass
    class Settings:
        goals: list[str] = field(default_factory=list)
        endless: bool = False
        cancel: bool = False

    def on_start(self) -> None:
        self.heard = 0
        self.go_on()

    def on_settings(self) -> None:
        if self.settings.cancel:
            self.cancel_goal()

    def go_on(self) -> None:
        goals, done = self.settings.goals, self.state.number
        if not self.goal_is_open and (done < len(goals) or self.settings.endless):
            self.send_goal(json.loads(goals[done % len(goals)]))

    def on_goal_feedback(self, status: GoalStatus) -> None:
        self.heard += 1
        if self.heard == 3:
            self.event("goal_goes_on", feedback=str(status.feedback))

    def on_goal_end(self, status: GoalStatus) -> None:
        self.event("goal_ended", number=status.number, state=status.state, result=str(status.result), why=status.text)
        self.go_on()


class Caller(Task[Any, Any]):
    """Calls a service once for each entry of its settings."""

    requires = (CALL,)

    @dataclass
    class Settings:
        calls: list[str] = field(default_factory=list)

    @dataclass
    class State:
        called: int = 0

    @every(hz=10)
    def call_next(self, tick: Tick) -> None:
        if self.state.called < len(self.settings.calls):
            self.state.called += 1
            self.publish(CTRL, Call(self.state.called, json.loads(self.settings.calls[self.state.called - 1])))

    @on(SYSTEM, queue=10)
    def answered(self, answer: CallAnswer) -> None:
        if answer.task == self.address:
            self.event("call_answered", number=answer.number, response=str(answer.response), why=answer.error)
