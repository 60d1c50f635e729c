"""A node of ROS 2 that does what it is told: a program for the other release. It knows nothing of Pancakes.

It reads orders as lines of JSON and says what it hears in the same way, on standard output. Times are those of this
machine's monotonic clock, which its processes share.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from importlib import import_module
from typing import Any, ClassVar

import rclpy
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.task import Future


def class_of(name: str) -> Any:
    """Returns the class of `package/kind/Name`."""
    package, kind, attribute = name.split("/")
    return getattr(import_module(f"{package}.{kind}"), attribute)


def fill(message: Any, fields: dict[str, Any]) -> Any:
    """Fills a message."""
    for name, value in fields.items():
        present = getattr(message, name)
        setattr(message, name, fill(present, value) if isinstance(value, dict) else value)
    return message


def plain(value: Any) -> Any:
    """Returns a message as plain values."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, (str, bool, int, float)):
        return value
    if isinstance(value, bytes):
        return value.hex()
    return [plain(item) for item in (value.tolist() if hasattr(value, "tolist") else value)]


def quality(order: dict[str, Any]) -> QoSProfile:
    """Returns the QoS of an order."""
    profile = QoSProfile(depth=order.get("depth", 10))
    if order.get("best_effort"):
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    if order.get("latched"):
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return profile


def say(**told: Any) -> None:
    """Says something."""
    print(json.dumps({**told, "at_s": time.monotonic()}), flush=True)


class Robot:
    """The body behind an action server: it moves while it works on a goal, and says when it begins and ends."""

    moving: ClassVar[list[str]] = []
    """The ids of the goals that robots of this process work on."""

    def __init__(self, node: Node, name: str, kind: Any, order: dict[str, Any]) -> None:
        self.name, self.kind, self.order = name, kind, order
        self.at_work: list[tuple[Any, Any]] = []  # the goals, and what wakes the coroutine of each
        self.server = ActionServer(
            node,
            kind,
            name,
            self.execute,
            goal_callback=lambda goal: self.asked(goal),
            cancel_callback=lambda goal: CancelResponse.REJECT if order.get("keeps_on") else CancelResponse.ACCEPT,
        )
        node.create_timer(order.get("step_s", 0.05), self.step)

    def asked(self, goal: Any) -> Any:
        say(asked=self.name, fields=plain(goal))
        return GoalResponse.REJECT if self.order.get("refuses") else GoalResponse.ACCEPT

    def step(self) -> None:
        for _, wakes in list(self.at_work):
            wakes.set_result(None)

    async def execute(self, goal: Any) -> Any:
        id, steps = bytes(goal.goal_id.uuid.tolist()).hex(), 0
        say(begins=self.name, id=id, steps=int(goal.request.order), at_work=len(self.moving))
        self.moving.append(id)
        feedback, result = self.kind.Feedback(), self.kind.Result()
        state = "succeeded"
        while steps < goal.request.order:
            entry = (goal, Future())
            self.at_work.append(entry)
            await entry[1]
            self.at_work.remove(entry)
            if goal.is_cancel_requested:
                state = "canceled"
                break
            steps += 1
            feedback.sequence = [*feedback.sequence, steps]
            goal.publish_feedback(feedback)
            if self.order.get("fails"):
                state = "abort"
                break
        {"succeeded": goal.succeed, "canceled": goal.canceled, "abort": goal.abort}[state]()
        self.moving.remove(id)
        say(ends=self.name, id=id, state=state, steps=steps)
        result.sequence = feedback.sequence
        return result


class Peer:
    """Carries orders out."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.publishers: dict[str, Any] = {}
        self.clients: dict[str, Any] = {}
        self.listening: list[Any] = []

    def publish(self, order: dict[str, Any]) -> None:
        """Publishes a message: once, or `count` times."""
        topic, kind = order["topic"], class_of(order["type"])
        if topic not in self.publishers:
            self.publishers[topic] = self.node.create_publisher(kind, topic, quality(order))
        publisher = self.publishers[topic]
        deadline_s = time.monotonic() + 10.0
        while order.get("readers", 0) > publisher.get_subscription_count() and time.monotonic() < deadline_s:
            time.sleep(0.01)
        message = fill(kind(), order.get("fields", {}))
        if "every_s" in order:
            self.listening.append(self.node.create_timer(order["every_s"], lambda: publisher.publish(message)))
        for _ in range(order.get("count", 1)):
            publisher.publish(message)
        say(published=topic, readers=publisher.get_subscription_count())

    def listen(self, order: dict[str, Any]) -> None:
        """Says what it hears, and what ROS 2 itself makes of that."""
        topic, kind = order["topic"], class_of(order["type"])

        def heard(data: bytes) -> None:
            message = deserialize_message(data, kind)
            say(heard=topic, message=plain(message), bytes=data.hex(), again=serialize_message(message).hex())

        self.listening.append(self.node.create_subscription(kind, topic, heard, quality(order), raw=True))
        say(listens=topic)

    def serialise(self, order: dict[str, Any]) -> None:
        """Says how ROS 2 serialises a message of given fields."""
        say(serialised=serialize_message(fill(class_of(order["type"])(), order["fields"])).hex())

    def call(self, order: dict[str, Any]) -> None:
        """Calls a service, and says what it answers."""
        name, kind = order["service"], class_of(order["type"])
        client = self.clients.setdefault(name, self.node.create_client(kind, name))
        if not client.wait_for_service(10.0):
            say(answered=name, message=None)
            return
        request = order.get("request", {})
        made = kind.Request()
        for field, value in request.items():
            if isinstance(value, list) and value and isinstance(value[0], dict):
                item = class_of(order["items"])
                setattr(made, field, [fill(item(), entry) for entry in value])
            elif isinstance(value, dict):
                fill(getattr(made, field), value)
            else:
                setattr(made, field, value)
        client.call_async(made).add_done_callback(lambda done: say(answered=name, message=plain(done.result())))

    def serve(self, order: dict[str, Any]) -> None:
        """Is the server of an action: a robot that makes a step each `step_s` until it has made those of its goal.

        `refuses` goals, `keeps_on` whatever is cancelled, or `fails` after a step.
        """
        name, kind = order["action"], class_of(order["type"])
        Robot(self.node, name, kind, order)
        say(serves=name)

    def echo(self, order: dict[str, Any]) -> None:
        """Is a service that answers with the fields of the request, or `never`."""
        name, kind = order["service"], class_of(order["type"])

        async def answer(request: Any, response: Any) -> Any:
            say(called=name, fields=plain(request))
            if order.get("never"):
                await Future()
            for field in request.get_fields_and_field_types():
                if hasattr(response, field):
                    setattr(response, field, getattr(request, field))
            return response

        self.listening.append(self.node.create_service(kind, name, answer))
        say(serves=name)

    def graph(self, order: dict[str, Any]) -> None:
        """Says which nodes there are."""
        nodes = [f"{space.rstrip('/')}/{name}" for name, space in self.node.get_node_names_and_namespaces()]
        say(nodes=sorted(nodes))

    def parameters(self, order: dict[str, Any]) -> None:
        """Looks at a node, or changes it, with the client that rclpy brings for parameters."""
        from rclpy.parameter import Parameter
        from rclpy.parameter_client import AsyncParameterClient

        client = AsyncParameterClient(self.node, order["node"])
        if not client.wait_for_services(10.0):
            say(answered=order["node"], message=None)
            return
        if "set" in order:
            wanted = [Parameter(name, value=value) for name, value in order["set"].items()]
            future = client.set_parameters(wanted)
        elif "get" in order:
            future = client.get_parameters(order["get"])
        else:
            future = client.list_parameters([], 0)
        self.listening.append(client)
        future.add_done_callback(lambda done: say(answered=order["node"], message=plain(done.result())))


def main() -> None:
    """Carries out orders until its input ends."""
    rclpy.init(args=[])
    node = Node(sys.argv[1] if len(sys.argv) > 1 else "peer")
    peer = Peer(node)
    executor = SingleThreadedExecutor()
    executor.add_node(node)

    def spin() -> None:
        try:
            executor.spin()
        except ExternalShutdownException:
            pass

    thread = threading.Thread(target=spin)
    thread.start()
    say(ready=node.get_name())
    for line in sys.stdin:
        order = json.loads(line)
        getattr(peer, order.pop("do"))(order)
    rclpy.try_shutdown()
    thread.join()
    node.destroy_node()


if __name__ == "__main__":
    main()
