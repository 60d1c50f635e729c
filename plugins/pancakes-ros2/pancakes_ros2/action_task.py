"""A task with a goal for an action server of its robot, which moves with the task.

class Visit(ActionTask):
    def on_start(self) -> None:
        if not self.state.number:
            self.send_goal(pose_goal(4.0, 2.0))

    def on_goal_end(self, status: GoalStatus) -> None:
        self.log.info(f"the goal has {status.state}")
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Generic, cast

from pancakes.errors import ClassError, PancakesError
from pancakes.packet import CTRL, SYSTEM
from pancakes.task import SettingsT, StateT, Task, Tick, every, on
from pancakes.util import codecs
from pancakes.util.class_checks import check_own_names
from pancakes_ros2.goal_packets import ENDED, GOAL, Goal, GoalState, GoalStatus

_HOOKS: Final = ("on_goal_feedback", "on_goal_end", "goal_class", "goal_device")


@dataclass
class ActionState:
    """The state of an `ActionTask`. A state of your own derives from it.

    Attributes:
        number: the number of the newest goal; 0: there was none yet.
        goal: the fields of the goal, as JSON; empty: none is open.
        canceling: whether it is to end.
    """

    number: int = 0
    goal: str = ""
    canceling: bool = False


class ActionTask(Task[SettingsT, StateT], Generic[SettingsT, StateT]):
    """A task that keeps a goal at the action server of the robot that it is on.

    While the goal is open, its timer `keep_goal` commands it ten times a second. Wherever the task goes, the server
    there gets the goal once, and the server that it has left cancels it.

    Attributes:
        goal_class: the class of the commands; for a device type of your own.
        goal_device: the name of the device, if the robot has several of that type; empty: it has one.
    """

    State: ClassVar[type] = ActionState
    requires: ClassVar[tuple[str, ...]] = (GOAL,)
    goal_class: ClassVar[type[Goal]] = Goal
    goal_device: ClassVar[str] = ""
    _stands: GoalState | None = None

    def __init_subclass__(cls, **others: Any) -> None:
        """Raise `ClassError` if the class cannot work, as `Task` does, or its state is no `ActionState`."""
        super().__init_subclass__(**others)
        check_own_names(cls, ActionTask, {*dir(Task), *_HOOKS})
        if not issubclass(cls.State, ActionState):
            raise ClassError(f"{cls.__qualname__}.State is no ActionState: write `class State(ActionState):`")

    # For the task ------------------------------------------------------------------------------------------------

    def send_goal(self, fields: Mapping[str, Any]) -> int:
        """Begin a goal, in place of the one before if that has not ended.

        Args:
            fields: the fields of the goal as plain values; messages in it are mappings.

        Returns:
            Its number, which `GoalStatus` names.

        Raises:
            PancakesError: a field is no plain value.
        """
        try:
            text = json.dumps(fields)
            codecs.encode(dict(fields))  # JSON has numbers and texts that packets cannot have
        except codecs.UNENCODABLE as error:
            raise PancakesError(
                f"the goal of {self.name} cannot travel: {error}; write numbers, strings, lists and mappings"
            ) from None
        kept = self._kept
        kept.number, kept.goal, kept.canceling = kept.number + 1, text, False
        self._stands = None
        self._command()
        return kept.number

    def cancel_goal(self) -> bool:
        """Have the goal cancelled; `on_goal_end` tells how it ended, which may also be with success.

        Returns:
            False if none is open.
        """
        if not self._kept.goal:
            return False
        self._kept.canceling = True
        self._command()
        return True

    @property
    def goal_is_open(self) -> bool:
        """Whether there is a goal that has not ended."""
        return bool(self._kept.goal)

    @property
    def goal_state(self) -> GoalState | None:
        """How the open goal stands on this robot; None: nothing was heard of it here."""
        return self._stands

    def on_goal_feedback(self, status: GoalStatus) -> None:
        """Called for each feedback on the open goal, `status.feedback`."""

    def on_goal_end(self, status: GoalStatus) -> None:
        """Called once for each goal that ends: `status.state` says how, `status.result` has the fields of the result.

        It is not called for a goal that another one has replaced.
        """

    # How it is kept ----------------------------------------------------------------------------------------------

    @property
    def _kept(self) -> ActionState:
        return cast(ActionState, self.state)

    @every(hz=10)
    def keep_goal(self, tick: Tick) -> None:
        """Command the open goal."""
        if self._kept.goal:
            self._command()

    def _command(self) -> None:
        kept = self._kept
        to = f"{self.agent}/device/{self.goal_device}" if self.goal_device else ""
        fields = None if kept.canceling else json.loads(kept.goal)
        self.publish(CTRL, self.goal_class(kept.number, fields), to)

    @on(SYSTEM, queue=64)
    def goal_reported(self, status: GoalStatus) -> None:
        """Take what the device tells of the open goal."""
        kept = self._kept
        if status.task != self.address or status.number != kept.number or not kept.goal:
            return
        if self.goal_device not in ("", status.device):
            return
        if status.feedback is not None:
            self.on_goal_feedback(status)
        elif status.state in ENDED:
            kept.goal, kept.canceling, self._stands = "", False, None
            self.on_goal_end(status)
        else:
            self._stands = status.state


def pose_goal(x_m: float, y_m: float, heading_rad: float = 0.0, frame: str = "map", **others: Any) -> dict[str, Any]:
    """Return the fields of a NavigateToPose goal of Nav2.

    Args:
        x_m, y_m, heading_rad: the pose, in metres and radians.
        frame: the frame that it is in. Robots that may take over a goal share it.
        others: other fields of the goal, such as `behavior_tree`.
    """
    half = heading_rad / 2.0
    pose = {"position": {"x": x_m, "y": y_m}, "orientation": {"z": math.sin(half), "w": math.cos(half)}}
    return {"pose": {"header": {"frame_id": frame}, "pose": pose}, **others}
