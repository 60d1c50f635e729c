"""The goal keeper: a process beside the agent that is the client of one action server, and outlives the agent.

It has the goals of a device because an action server works on a goal whether or not its client lives. As long as the
device tells it, many times a second, that a goal is wanted, it lets the server work. It cancels the goal when it is
told to, when no command is fresh, and when the pipe from the agent breaks, which the kernel of the machine sees to
however the agent died. Then it stays until the server has confirmed the end.

    python -m pancakes_ros2.goal_keeper        # started by the device `ros2.action`
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from pancakes.devices.driver import Pace
from pancakes.util import codecs
from pancakes.util.clock import MonotonicClock
from pancakes_ros2.goal_machine import AskResult, Cancel, Effect, GoalMachine, Leave, Send, Tell, Warn
from pancakes_ros2.installation import have_fields_checked, ros_name, type_class
from pancakes_ros2.keeper_pipe import (
    Again,
    Alive,
    Command,
    Failure,
    Hold,
    PipeWriter,
    Ready,
    Setup,
    Status,
    Warned,
    read_all,
)
from pancakes_ros2.message_fields import Unusable
from pancakes_ros2.ros_message import fill, plain_of
from pancakes_ros2.ros_node import RosNode

LOOK_S: Final = 0.05
"""How often it looks whether a command is still fresh."""
GRAPH_EVERY: Final = 4
"""It asks ROS 2 once in this many looks which servers there are."""
ALIVE_EVERY: Final = 20
"""It tells once in this many looks that it is at work."""
MARK_LENGTH: Final = 8
ID_LENGTH: Final = 16
"""Of the UUID of a goal, in bytes."""


def mark_of(agent: str, device: str) -> bytes:
    """Returns how the ids of all goals of a device begin, in each life of it."""
    return codecs.sha256(f"pancakes {agent}/{device}".encode())[:MARK_LENGTH]


class GoalKeeper:
    """Does what the machine decides. All in the thread of its node.

    Args:
        setup: what it is for.
        node: its node.
        out: leads to the agent.
    """

    def __init__(self, setup: Setup, node: RosNode, out: PipeWriter) -> None:
        self._setup = setup
        self._node = node
        self._out = out
        self._now = MonotonicClock().now
        self._pace = Pace(setup.feedback_hz)
        self._parent = os.getppid()
        self._looks = 0
        self._servers: set[str] = set()
        self._ready = False
        self._others = ""
        self._command: Command | None = None
        self._told = ""
        self._handles: dict[bytes, Any] = {}
        self._cancels: dict[bytes, Any] = {}

    def open(self, node: Any) -> None:
        """Makes the client.

        Raises:
            PancakesError: the type of the action is not installed.
        """
        setup = self._setup
        self._type = type_class(setup.action, "action")
        from action_msgs.msg import GoalStatusArray
        from action_msgs.srv import CancelGoal
        from rclpy.action import ActionClient
        from rclpy.qos import qos_profile_action_status_default
        from unique_identifier_msgs.msg import UUID

        self._uuid, self._cancel_type, self._rcl = UUID, CancelGoal, node
        self._name = node.resolve_service_name(f"{setup.name}/_action/send_goal").removesuffix("/_action/send_goal")
        rest = ID_LENGTH - MARK_LENGTH
        self._machine = GoalMachine(self._name, mark_of(setup.agent, setup.device), lambda: os.urandom(rest))
        self._client = ActionClient(node, self._type, setup.name)
        self._canceller = node.create_client(CancelGoal, f"{setup.name}/_action/cancel_goal")
        node.create_subscription(
            GoalStatusArray,
            f"{setup.name}/_action/status",
            lambda message: self._guarded(self._listed, message),
            qos_profile_action_status_default,
        )
        node.create_timer(LOOK_S, lambda: self._guarded(self._look))
        self._say(Ready())

    def take(self, order: Command | Again | Hold | None) -> None:
        """Takes an order; None: the agent is gone."""
        now_s = self._now()
        if order is None:
            self._carry_out(self._machine.alone(now_s))
        elif isinstance(order, Hold):
            self._carry_out(self._machine.hold(now_s))
        else:
            if isinstance(order, Command):
                self._command = order
            if (command := self._command) is not None:
                key = (command.task, command.number)
                self._carry_out(self._machine.want(key, command.fields, order.until_s, now_s))

    # What the server says ----------------------------------------------------------------------------------------

    def _look(self) -> None:
        if os.getppid() != self._parent:
            self.take(None)  # a process that the agent has forked may hold its end of the pipe open
        if self._looks % GRAPH_EVERY == 0:
            self._guarded(self._look_at_graph)
        self._looks += 1
        why = f"the action server {self._name} has the type {self._others}, not {self._setup.action}"
        self._carry_out(self._machine.look(self._servers, self._ready, self._now(), why if self._others else ""))
        self._say(Alive() if self._looks % ALIVE_EVERY == 0 else None)

    def _look_at_graph(self) -> None:
        there = self._rcl.get_publishers_info_by_topic(f"{self._name}/_action/feedback")
        self._servers = {bytes(it.endpoint_gid).hex() for it in there}
        self._ready = bool(self._client.server_is_ready())
        kinds = {it.topic_type.removesuffix("_FeedbackMessage") for it in there}
        self._others = ", ".join(sorted(kinds - {self._setup.action}))

    def _listed(self, message: Any) -> None:
        goals = [(bytes(it.goal_info.goal_id.uuid.tolist()), int(it.status)) for it in message.status_list]
        self._carry_out(self._machine.listed(goals, self._now()))

    def _answered(self, id: bytes, future: Any) -> None:
        handle: Any = future.result()
        self._handles[id] = handle
        self._carry_out(self._machine.answered(id, bool(handle.accepted), self._now()))

    def _fed_back(self, id: bytes, message: Any) -> None:
        key = self._machine.feedback(id)
        if key is not None and self._pace.due(self._now()):
            self._say(Status(*key, "running", feedback=plain_of(message.feedback)))

    def _ended(self, id: bytes, future: Any) -> None:
        answer = future.result()
        self._carry_out(self._machine.result(id, int(answer.status), plain_of(answer.result), self._now()))

    def _cancel_answered(self, id: bytes, future: Any) -> None:
        code = int(future.result().return_code)
        if self._cancels.get(id) is future:
            del self._cancels[id]
        self._carry_out(self._machine.cancel_answered(id, code, self._now()))

    # What to do ------------------------------------------------------------------------------------------

    def _carry_out(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Send):
                self._send(effect)
            elif isinstance(effect, Cancel):
                self._cancel(effect.id)
            elif isinstance(effect, AskResult):
                handle = self._handles.get(effect.id)
                if handle is not None:
                    self._then(handle.get_result_async(), self._ended, effect.id)
            elif isinstance(effect, Tell):
                self._say(Status(*effect.key, effect.state, effect.text, result=effect.result))
            elif isinstance(effect, Warn):
                self._say(Warned(effect.text))
            elif isinstance(effect, Leave):
                self._node.end()

    def _send(self, effect: Send) -> None:
        goal = self._type.Goal()
        try:
            fill(goal, effect.fields)
        except Unusable as error:
            text = f"it is no goal of {self._setup.action}: {error}"
            self._carry_out(self._machine.unsendable(effect.id, text, self._now()))
            return
        self._handles.clear()
        uuid = self._uuid(uuid=list(effect.id))
        feedback = partial(self._guarded, self._fed_back, effect.id)
        self._then(self._client.send_goal_async(goal, feedback, uuid), self._answered, effect.id)

    def _cancel(self, id: bytes) -> None:
        if not self._canceller.service_is_ready():
            return
        if (before := self._cancels.pop(id, None)) is not None:
            self._canceller.remove_pending_request(before)
        request = self._cancel_type.Request()
        request.goal_info.goal_id = self._uuid(uuid=list(id))
        future = self._cancels[id] = self._canceller.call_async(request)
        self._then(future, self._cancel_answered, id)

    def _then(self, future: Any, method: Callable[[bytes, Any], None], id: bytes) -> None:
        future.add_done_callback(partial(self._guarded, method, id))

    def _guarded(self, method: Callable[..., None], *came: Any) -> None:
        try:
            method(*came)
        except Exception as error:  # what rclpy raises must not end the keeper of a goal
            text = f"what is known of the server of {self._name} may be wrong: {error!r}"
            if text != self._told:
                self._told = text
                self._say(Warned(text))

    def _say(self, body: Ready | Alive | Status | Warned | None) -> None:
        try:
            if body is None:
                self._out.flush()
            else:
                self._out.put(body)
        except OSError:
            pass  # that the agent is gone is heard from the other pipe


def main() -> None:
    """Keeps the goals of one device until the agent is gone and no goal is left."""
    for each in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(each, signal.SIG_IGN)  # a program that ends all processes of an agent may end this one last
    have_fields_checked()
    number = os.dup(1)
    os.dup2(2, 1)  # what a library prints is not for the agent
    out = PipeWriter(number)
    orders = os.fdopen(os.dup(0), "rb")  # not `sys.stdin`, which Python closes at its end while a thread reads it
    setup = next(read_all(orders, Setup), None)
    if setup is None:
        return
    node = RosNode(setup.agent, f"pancakes_{ros_name(setup.device)}")
    keeper = GoalKeeper(setup, node, out)

    def failed(text: str) -> None:
        out.put(Failure(text))
        node.end()

    def listen() -> None:
        try:
            for order in read_all(orders, Command | Again | Hold):
                node.do(partial(_take, keeper, order))
        finally:
            node.do(partial(_take, keeper, None))

    node.do(keeper.open, failed)
    threading.Thread(target=listen, daemon=True).start()
    while not node.join(60.0):
        pass


def _take(keeper: GoalKeeper, order: Command | Again | Hold | None, node: Any) -> None:
    keeper.take(order)


if __name__ == "__main__":
    main()
