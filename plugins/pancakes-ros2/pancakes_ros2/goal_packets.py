"""Goals of ROS 2 actions and calls of its services, as packets between a task and a device of its robot."""

from __future__ import annotations

from typing import Any, Final, Literal

import msgspec

from pancakes.packet import packet_type

GOAL: Final = "ros2.goal"
"""The type of devices with an action server behind them, and of the commands to them."""
CALL: Final = "ros2.call"
"""The same of devices with a service server behind them."""

GoalState = Literal["waiting", "running", "held", "succeeded", "aborted", "canceled", "refused", "lost"]
ENDED: Final = ("succeeded", "aborted", "canceled", "refused", "lost")
"""The states that a goal does not leave."""


@packet_type(GOAL)
class Goal(msgspec.Struct, frozen=True):
    """What an action server is to do. It is commanded again and again, as wheels are: without, the goal is cancelled.

    Attributes:
        number: tells the goals of a task apart. While the same number is commanded, the goal is sent once.
        fields: the fields of the goal as plain values, messages in it are mappings; what is left out keeps its default.
            None: cancel the goal of this number.
    """

    number: int
    fields: dict[str, Any] | None


@packet_type("ros2.goal_status")
class GoalStatus(msgspec.Struct, frozen=True):
    """How a goal stands, on `system`.

    Attributes:
        device: the device that it was commanded to.
        task: the address of the task that commands it.
        number: the goal's number.
        state: `waiting` (not accepted yet), `running`, `held` (cancelled because no command came: it is sent again
            when it is commanded again), or how it ended. `refused`: it was never begun. `lost`: its server is gone.
        text: more for people; empty: the state says it all.
        feedback: the fields of a feedback message, if this reports one.
        result: the fields of the result message, if there is one.
    """

    device: str
    task: str
    number: int
    state: GoalState
    text: str = ""
    feedback: dict[str, Any] | None = None
    result: dict[str, Any] | None = None


@packet_type(CALL)
class Call(msgspec.Struct, frozen=True):
    """A request to a service. Each command is one call.

    Attributes:
        number: comes back with the answer.
        fields: the fields of the request as plain values; what is left out keeps its default.
    """

    number: int
    fields: dict[str, Any] = {}


@packet_type("ros2.call_answer")
class CallAnswer(msgspec.Struct, frozen=True):
    """The answer of a service, on `system`.

    Attributes:
        device: the device that was commanded.
        task: the address of the task that called.
        number: the number of the call.
        response: the fields of the response; None: there is none.
        error: why there is none; empty: there is one.
    """

    device: str
    task: str
    number: int
    response: dict[str, Any] | None = None
    error: str = ""
