"""A service of a robot as a device (`ros2.service`), such as the one that clears a costmap."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Final

from msgspec import Meta

from pancakes.devices.driver import Actuator
from pancakes.errors import PancakesError
from pancakes.packet import SYSTEM
from pancakes_ros2.goal_packets import CALL, Call, CallAnswer
from pancakes_ros2.installation import checked_type, type_class
from pancakes_ros2.node_table import NODES, fail
from pancakes_ros2.ros_message import fill, plain_of
from pancakes_ros2.ros_node import RosNode

S = Annotated[float, Meta(gt=0)]
LOOK_S: Final = 0.1
"""How often it is looked whether a service has come, or a call has waited too long."""
MOST_CALLS: Final = 64


@dataclass(eq=False)
class _Waiting:
    """A call without an answer yet.

    Attributes:
        call, task: the call, and whose it is.
        until_s: when it is given up, by the mission clock.
        sent: whether it is on its way.
        future: gets the answer; used in the node's thread.
    """

    call: Call
    task: str
    until_s: float
    sent: bool = False
    future: Any = None


class RosCall(Actuator):
    """A service, which the task that holds it calls: each command is one call, and has one answer."""

    type = CALL

    @dataclass
    class Settings:
        """Which service.

        Attributes:
            service: its type, such as `std_srvs/srv/Trigger`; any that is installed.
            name: its name; one that does not begin with a slash is below `/AGENT`.
            timeout_s: after so long without an answer a call has failed, in seconds of mission time.
        """

        service: str
        name: str
        timeout_s: S = 5.0

        def __post_init__(self) -> None:
            self.service = checked_type(self.service, "srv")
            if not self.name.strip("/"):
                raise ValueError("the service has no name")

    settings: Settings
    _node: RosNode | None = None
    _client: Any = None

    def open(self) -> None:
        self._waiting: list[_Waiting] = []
        self._node = node = NODES.take(self.context.agent, self.context.virtual)
        node.do(self._make, self._failed)

    def close(self) -> None:
        for waiting in list(self._waiting) if self._node is not None else ():
            self._answer(waiting, None, f"{self.context.device} was closed before the answer came")
        node, self._node = self._node, None
        if node is not None:
            node.do(self._destroy)
            NODES.give_back(self.context.agent)

    def write(self, command: Call, ttl_s: float, source: str) -> None:
        if len(self._waiting) >= MOST_CALLS:
            raise PancakesError(f"{MOST_CALLS} calls of {self.settings.name} wait for their answers already")
        self._waiting.append(_Waiting(command, source, self.context.now() + self.settings.timeout_s))
        if len(self._waiting) == 1:
            self._look()

    def watchdog_s(self, hold_after_s: float) -> float:
        """A call is over when it is answered: nothing goes on that had to be held."""
        return hold_after_s

    def safe_stop(self) -> None:
        """What was called is not called back: a service of ROS 2 cannot be."""

    # In the device's actor ---------------------------------------------------------------------------------------

    def _look(self) -> None:
        """Sends what can be sent, and gives up what has waited too long."""
        node, now_s = self._node, self.context.now()
        if node is None:
            return
        for waiting in list(self._waiting):
            if now_s >= waiting.until_s:
                name = self.settings.name
                none = f"there is no service {name}: start it, or name the one that the robot has"
                late = f"the service {name} has not answered within {self.settings.timeout_s:g} s; whether the call had"
                self._answer(waiting, None, f"{late} an effect is not known" if waiting.sent else none)
                node.do(partial(self._forget, waiting))
            elif not waiting.sent:
                node.do(partial(self._call, waiting), partial(self._refused, waiting))
        if self._waiting:
            self.context.after(LOOK_S, self._look)

    def _answer(self, waiting: _Waiting, response: dict[str, Any] | None, error: str = "") -> None:
        if waiting in self._waiting:
            self._waiting.remove(waiting)
            answer = CallAnswer(self.context.device, waiting.task, waiting.call.number, response, error)
            self.context.send(SYSTEM, answer, "")

    def _failed(self, text: str) -> None:
        self.context.call(partial(fail, text))

    # In the node's thread ----------------------------------------------------------------------------------------

    def _make(self, node: Any) -> None:
        self._kind = type_class(self.settings.service, "srv")
        self._client = node.create_client(self._kind, self.settings.name)

    def _destroy(self, node: Any) -> None:
        client, self._client = self._client, None
        if client is not None:
            node.destroy_client(client)

    def _call(self, waiting: _Waiting, node: Any) -> None:
        client = self._client
        if client is None or waiting.sent or not client.service_is_ready():
            return
        request = self._kind.Request()
        fill(request, waiting.call.fields)
        waiting.sent = True
        waiting.future = client.call_async(request)
        waiting.future.add_done_callback(partial(self._answered, waiting))

    def _forget(self, waiting: _Waiting, node: Any) -> None:
        """Let go of a call that is given up: ROS 2 would keep it for ever."""
        waiting.sent = True  # nor is it made, if that was asked for before
        if self._client is not None and waiting.future is not None:
            self._client.remove_pending_request(waiting.future)

    def _refused(self, waiting: _Waiting, text: str) -> None:
        self.context.call(partial(self._answer, waiting, None, f"it is no call of {self.settings.service}: {text}"))

    def _answered(self, waiting: _Waiting, future: Any) -> None:
        try:
            response = plain_of(future.result())
        except Exception as error:  # rclpy raises what it likes
            self.context.call(partial(self._answer, waiting, None, f"the call failed: {error}"))
        else:
            self.context.call(partial(self._answer, waiting, response))
