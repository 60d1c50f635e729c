"""The wheels of a robot that speaks ROS 2 (`ros2.motors`)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated

from msgspec import Meta

from pancakes.devices import Twist
from pancakes.devices.driver import Actuator
from pancakes_ros2.conversion import CONVERSIONS, TWIST, TWIST_STAMPED, Unusable
from pancakes_ros2.node_table import NODES, fail
from pancakes_ros2.quality import COMMAND, Quality
from pancakes_ros2.ros_node import Outlet, RosNode

STANDS = Twist(0.0, 0.0)
TEXT = "std_msgs/msg/String"
S = Annotated[float, Meta(gt=0)]


class RosMotors(Actuator):
    """Wheels that follow a Twist.

    In safe hold they are told to stand still, once. A process that is killed can say nothing: then the robot stands
    still if it has a time-out of its own for commands.
    """

    type = "motors"

    @dataclass
    class Settings:
        """How the robot is commanded.

        Attributes:
            topic: where it listens; one that does not begin with a slash is below `/AGENT`.
            stamped: whether it wants a TwistStamped, as controllers of ROS 2 Jazzy and later do.
            frame: the frame of reference that a TwistStamped names.
            lifespan_s: a command that could not be delivered for so long, in seconds, is not delivered any more.
            times_out_s: after so long without a command the robot stands still by itself, as its documentation says;
                without it, it is taken for one that never does.
            tell_task: a topic on which the address of the task is published that commands the wheels, and an empty
                text in safe hold; empty: none.
        """

        topic: str = "cmd_vel"
        stamped: bool = False
        frame: str = "base_link"
        lifespan_s: S = 0.5
        times_out_s: S | None = None
        tell_task: str = ""

    settings: Settings
    _node: RosNode | None = None
    _out: Outlet | None = None
    _telling: Outlet | None = None

    def open(self) -> None:
        settings = self.settings
        self._told: set[str] = set()
        self._task = ""
        self._kind = TWIST_STAMPED if settings.stamped else TWIST
        self._node = node = NODES.take(self.context.agent, self.context.virtual)
        quality = Quality(COMMAND.reliability, COMMAND.durability, COMMAND.depth, settings.lifespan_s)
        self._out = Outlet(node, self._kind, settings.topic, quality, self._fail, self._warn)
        if settings.tell_task:
            newest = Quality("reliable", "transient_local", 1)
            self._telling = Outlet(node, TEXT, settings.tell_task, newest, self._fail, self._warn)

    def close(self) -> None:
        for outlet in (self._out, self._telling):
            if outlet is not None:
                outlet.close()
        if self._node is not None:
            self._node = None
            NODES.give_back(self.context.agent)

    def write(self, command: Twist, ttl_s: float, source: str) -> None:
        try:
            self._send(command)
        except Unusable as error:
            self._warn(f"a command of {source} was dropped, and the wheels were told to stand still: {error}")
            self._send(STANDS)
            return
        self._tell(source)
        if self._out is not None and self._out.ready and not self._out.readers:
            self._warn(f"no node listens to {self.settings.topic}: the wheels hear nothing")

    def watchdog_s(self, hold_after_s: float) -> float | None:
        """The robot's own time-out, as far as the settings say that it has one."""
        return self.settings.times_out_s

    def safe_stop(self) -> None:
        self._send(STANDS)
        self._tell("")

    def _send(self, command: Twist) -> None:
        out = self._out
        if out is None or not out.ready:
            return  # so nothing has moved yet
        message = out.new()
        write = CONVERSIONS[self.type, self._kind].write
        write(message, command, out.moment(self.settings.frame), 0)
        out.publish(message)

    def _tell(self, task: str) -> None:
        if self._telling is not None and self._telling.ready and task != self._task:
            self._task = task
            message = self._telling.new()
            message.data = task
            self._telling.publish(message)

    def _fail(self, text: str) -> None:
        """Fails the device, which its service then restarts. In the node's thread."""
        self.context.call(partial(fail, text))

    def _warn(self, text: str) -> None:
        """Logs a sentence, once. Any thread."""
        if text not in self._told and len(self._told) < 100:
            self._told.add(text)
            self.context.log("warning", text)
