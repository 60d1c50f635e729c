"""One row of the table of topics at work: its publishers, or its subscription. A part of the service `ros2`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from pancakes.devices.driver import Pace
from pancakes.errors import PancakesError
from pancakes_ros2.frame_tree import FrameTree
from pancakes_ros2.newest import Newest
from pancakes_ros2.quality import STATIC, Quality
from pancakes_ros2.ros_node import Inlet, Outlet, RosNode
from pancakes_ros2.sensor_conversion import STATIC_TOPIC
from pancakes_ros2.topic_row import TopicRow

WAITING: Final = 100
"""How many messages of a topic wait for the service, at most."""
AGAIN_S: Final = 10.0
"""The same complaint about a topic is told again after so long, in seconds of mission time."""


class TopicBridge:
    """A topic that is published, or listened to.

    Its methods are called in the service's actor, unless they say otherwise.

    Args:
        row: what it is.
        agent: the agent's name.
        now: tells the mission time. Any thread.
        call: has a function called in the service's actor. Any thread.
        publish: publishes a packet of this agent: channel and body.
        log: takes level and text. Any thread.
    """

    def __init__(
        self,
        row: TopicRow,
        agent: str,
        now: Callable[[], float],
        call: Callable[[Callable[[], None]], None],
        publish: Callable[[str, Any], Any],
        log: Callable[[str, str], None],
    ) -> None:
        self.row = row
        self._agent = agent
        self._now = now
        self._publish = publish
        self._log = log
        self._pace = Pace(row.max_hz)
        self._came: Newest[Any] = Newest(WAITING, lambda: call(self._take))
        self._outlets: dict[int | None, Outlet] = {}
        self._inlets: list[Inlet] = []
        self._tree = FrameTree(*row.frames(agent)) if row.direction == "in" and row.composes else None
        self._node: RosNode | None = None
        self._told_s: dict[str, float] = {}
        self._left_out = 0
        self.passed = 0

    def open(self, node: RosNode) -> None:
        """Begins."""
        self._node = node
        if self.row.direction == "in":
            self._listen(node, self.row.topic, self.row.qos)
            if self._tree is not None:
                self._listen(node, STATIC_TOPIC, STATIC)
        elif self.row.conversion is None or self.row.conversion.parts is None:
            self._outlet(None)  # else it is known with the first packet how many there are

    def _listen(self, node: RosNode, topic: str, qos: Quality) -> None:
        heard = self._came.put if self._tree is None else self._heard_transforms
        self._inlets.append(Inlet(node, self.row.message, topic, qos, heard, self.complain, self.complain))

    def _heard_transforms(self, message: Any) -> None:
        """Take transforms, each of which counts; in the node's thread, which has all topics of tf."""
        assert self._tree is not None
        pose, faults = self._tree.hear(message)
        for fault in faults:
            self.complain(f"a transform of {self.row.topic} is left out: {fault}")
        if pose is not None:
            self._came.put(pose)

    def close(self) -> None:
        """Ends."""
        self._node = None
        for inlet in self._inlets:
            inlet.close()
        for outlet in self._outlets.values():
            outlet.close()

    def explain(self) -> None:
        """Says why nothing has come, where nothing has."""
        if self._inlets and not self.passed:
            self._inlets[0].explain(self.complain)
            if self._tree is not None and self._node is not None:
                self._tree.explain(self._node.do, self.complain)

    def complain(self, text: str) -> None:
        """Logs a sentence, and the same one again no sooner than after a while. Any thread."""
        now_s = self._now()
        if now_s - self._told_s.get(text, -AGAIN_S) >= AGAIN_S and (text in self._told_s or len(self._told_s) < 100):
            self._told_s[text] = now_s
            self._log("warning", text)

    def send(self, body: Any) -> None:
        """Publishes a packet's body as a message, or several."""
        if self._node is None or not self._passes():
            return
        row = self.row
        try:
            parts = row.parts(body)
            for part in [None] if parts is None else range(parts):
                outlet = self._outlet(part)
                if not outlet.ready:
                    continue
                frame, child = row.frames(self._agent)
                message = outlet.new()
                moment = outlet.moment(frame if part is None else f"{frame}/{row.packet}_{part}", child)
                row.write(message, body, moment, part or 0)
                outlet.publish(message)
        except PancakesError as error:
            self.complain(f"a packet {row.packet!r} does not become a message of {row.topic}: {error}")
        else:
            self.passed += 1

    def _outlet(self, part: int | None) -> Outlet:
        outlet = self._outlets.get(part)
        if outlet is None:
            assert self._node is not None
            row = self.row
            topic = row.topic if part is None else f"{row.topic}_{part}"
            outlet = self._outlets[part] = Outlet(self._node, row.message, topic, row.qos, self.complain, self.complain)
        return outlet

    def _take(self) -> None:
        messages, lost = self._came.take()
        if self._node is None:
            return
        self._left_out += lost
        for message in messages:
            if not self._passes():
                continue
            try:
                self._publish(self.row.channel, self._read(message))
            except PancakesError as error:
                self.complain(f"a message of {self.row.topic} does not become a packet: {error}")
            else:
                self.passed += 1
        if self._left_out:
            self._tell_flood()

    def _read(self, came: Any) -> Any:
        if self._tree is None:
            return self.row.read(came)
        return came if self.row.packet == "pose_3d" else came.flat()

    def _passes(self) -> bool:
        if self._pace.due(self._now()):
            return True
        self._left_out += 1
        if self.row.direction == "out":
            self._tell_flood()
        return False

    def _tell_flood(self) -> None:
        now_s = self._now()
        if now_s - self._told_s.get("", -AGAIN_S) >= AGAIN_S:
            self._told_s[""] = now_s
            self._log(
                "warning",
                f"more than {self.row.max_hz:g} a second come for {self.row.topic}: {self._left_out} were left out",
            )
            self._left_out = 0
