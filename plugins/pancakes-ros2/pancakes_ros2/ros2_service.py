"""The service `ros2`: an agent's channels as topics, its log on /rosout, and its tasks as nodes.

[service.ros2]
type = "ros2"

[[service.ros2.settings.topics]]
topic = "pose"
message = "geometry_msgs/msg/PoseStamped"
packet = "pose"
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

from pancakes.control import Reply
from pancakes.errors import PancakesError
from pancakes.events import Event, LogLine, level_of
from pancakes.kernel.handlers import QueuePolicy, Tick, every, on
from pancakes.packet import LOG, SYSCTRL, Packet, agent_of
from pancakes.service import Service
from pancakes_ros2.lifecycle_states import state_of
from pancakes_ros2.log_messages import LOG_LEVELS, LOG_MESSAGE, log_text
from pancakes_ros2.node_table import NODES
from pancakes_ros2.quality import Quality
from pancakes_ros2.ros_node import Outlet, RosNode
from pancakes_ros2.task_node import TaskView
from pancakes_ros2.task_nodes import TaskNodes
from pancakes_ros2.topic_bridge import TopicBridge
from pancakes_ros2.topic_row import TopicRow

CORE: Final = ("device", "network", "log")
"""The services whose tasks are no nodes."""
LOG_QUALITY: Final = Quality("reliable", "transient_local", 1000, 10.0)
"""As all nodes of ROS 2 have it on /rosout."""
PATIENCE_S: Final = 3.0
"""A topic of which nothing has come after so long, in seconds of the host, is looked for."""


class Ros2Service(Service):
    """Shows an agent in ROS 2. Its node is `/AGENT/pancakes`, which the drivers `ros2.*` share."""

    @dataclass
    class Settings:
        """What is shown.

        Attributes:
            topics: which packets are which messages.
            rosout: whether what is said on `log` goes to /rosout.
            tasks: whether each task is a node whose parameters and life cycle ROS 2 can look at and change. Whatever
                reaches the ROS 2 network may then do so.
            use_sim_time: whether messages bear the time of /clock. Mission time is the agent's own all the same.
        """

        topics: list[TopicRow] = field(default_factory=list)
        rosout: bool = True
        tasks: bool = False
        use_sim_time: bool = False

    settings: Settings

    def __init__(self, *args: Any, **others: Any) -> None:
        super().__init__(*args, **others)
        self._node: RosNode | None = None
        self._bridges: list[TopicBridge] = []
        self._rosout: Outlet | None = None
        self._nodes: TaskNodes | None = None
        self._unsaid: deque[Packet] = deque(maxlen=LOG_QUALITY.depth)
        self._asked: dict[int, Future[Reply]] = {}
        self._shown: list[TaskView] = []

    def on_start(self) -> None:
        self._node = node = NODES.take(self.agent, self._actor.kernel.virtual is not None)
        if self.settings.use_sim_time:
            node.do(_use_sim_time, self._warn)
        if self.settings.rosout:
            self._rosout = Outlet(node, LOG_MESSAGE, "/rosout", LOG_QUALITY, self._warn, self._warn)
        for row in self.settings.topics:
            try:
                row.check_packet()
                self._open(row, node)
            except PancakesError as error:
                self.log("error", f"{self.address}: {error}")
        heard: dict[tuple[str, str], list[TopicBridge]] = {}
        for bridge in self._bridges:
            if bridge.row.direction == "out":
                heard.setdefault((bridge.row.channel, bridge.row.packet), []).append(bridge)
        for (channel, packet), bridges in heard.items():
            self._listen(channel, packet, bridges)
        if self.settings.tasks:
            NODES.take(self.agent, False)
            ended = partial(NODES.give_back, self.agent)
            self._nodes = TaskNodes(self.agent, node, self._ask, self._warn, ended)
        self.after_host(PATIENCE_S, self._explain)

    def _open(self, row: TopicRow, node: RosNode) -> None:
        self.open_channel(row.channel)
        bridge = TopicBridge(row, self.agent, self.now, self.call, self.publish, self.log)
        bridge.open(node)
        self._bridges.append(bridge)

    def _listen(self, channel: str, packet: str, bridges: list[TopicBridge]) -> None:
        def handle(packet: Packet) -> None:
            own = agent_of(packet.source) == self.agent
            for bridge in bridges:
                # What this service took in from a topic does not go out again.
                if packet.source != self.address and (own or bridge.row.include_remote):
                    bridge.send(packet.body)

        self.subscribe(channel, packet, handle, QueuePolicy(256))

    def _explain(self) -> None:
        for bridge in self._bridges:
            bridge.explain()

    def on_stop(self) -> None:
        self._close()

    def on_failure(self, exception_type: Any, exception_value: Any, traceback: Any) -> None:
        super().on_failure(exception_type, exception_value, traceback)
        self._close()

    def _close(self) -> None:
        for bridge in self._bridges:
            bridge.close()
        if self._rosout is not None:
            self._rosout.close()
        if self._nodes is not None:
            self._nodes.end()
        for asked in self._asked.values():
            asked.set_exception(PancakesError(f"{self.address} was stopped before the answer came"))
        self._asked.clear()
        if self._node is not None:
            self._node = None
            NODES.give_back(self.agent)

    def _warn(self, text: str) -> None:
        """Any thread."""
        self.log("warning", text)

    # The log ---------------------------------------------------------------------------------------------------

    @on(LOG, None, queue=1000)
    def said(self, packet: Packet) -> None:
        """Publishes a line or an event on /rosout."""
        if self._rosout is None or agent_of(packet.source) != self.agent:
            return
        self._unsaid.append(packet)  # what was said before there is a /rosout is said once there is
        self._say()

    def _say(self) -> None:
        out = self._rosout
        while out is not None and out.ready and self._unsaid:
            packet = self._unsaid.popleft()
            body = packet.body
            if not isinstance(body, (LogLine, Event)):
                continue
            message = out.new()
            message.stamp.sec, message.stamp.nanosec = out.moment("")[:2]
            message.level = LOG_LEVELS[level_of(body)]
            message.name, message.msg = packet.source, log_text(body)
            out.publish(message)

    # Tasks as nodes --------------------------------------------------------------------------------------------

    @every(hz=5)
    def look(self, tick: Tick) -> None:
        """Shows what has become of the tasks."""
        self._say()
        if self._nodes is None:
            return
        views = [
            TaskView(entry.service, entry.name, state_of(entry.life.state))
            for entry in self._actor.kernel.tasks.all()
            if entry.service not in CORE
        ]
        if views != self._shown:
            self._shown = views
            self._nodes.show(views)

    def _ask(self, body: Any) -> Future[Reply]:
        """Asks the agent for something; for the thread that serves the tasks' nodes."""
        answer: Future[Reply] = Future()
        self.call(partial(self._put, body, answer))
        return answer

    def _put(self, body: Any, answer: Future[Reply]) -> None:
        try:
            self._asked[self.publish(SYSCTRL, body).seq] = answer
        except PancakesError as error:
            answer.set_exception(error)

    @on(SYSCTRL, Reply, addressed=True)
    def answered(self, packet: Packet) -> None:
        """Takes the agent's answer."""
        cause = packet.cause
        answer = self._asked.pop(cause[1], None) if cause is not None and cause[0] == self.address else None
        if answer is None:
            return
        reply: Reply = packet.body
        if not reply.ok:
            self.log("warning", f"what was asked for through ROS 2 is refused: {reply.reason}")
        answer.set_result(reply)


def _use_sim_time(node: Any) -> None:
    from rclpy.parameter import Parameter

    node.set_parameters([Parameter("use_sim_time", value=True)])
