"""An agent's node in ROS 2, `/AGENT/pancakes`, and the thread that runs it.

All of rclpy's own work is done in that thread: nodes, topics and services are made there, and what comes in is heard
there. What is heard is handed to actors as data. Publishing alone is done in the thread that has something to say.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from pancakes.errors import PancakesError
from pancakes_ros2.installation import have_fields_checked, message_class
from pancakes_ros2.message_fields import Moment
from pancakes_ros2.quality import Quality, profile_of

Failed = Callable[[str], None]
"""Takes a sentence on what went wrong. Called in the node's thread."""
ACKNOWLEDGED_S = 0.2
"""The last message of a reliable publisher has so long to arrive before it is closed."""


class Outlet:
    """A publisher of an agent's node; there once the node's thread has made it.

    Args:
        node: the node.
        kind: the name of its message type.
        topic: its topic; a relative name is below the agent's namespace.
        quality: its QoS.
        failed: is told where it cannot be made.
        warn: is told where a reader of the topic cannot hear it.
    """

    def __init__(self, node: RosNode, kind: str, topic: str, quality: Quality, failed: Failed, warn: Failed) -> None:
        self._node = node
        self._quality = quality
        self._publisher: Any = None
        self._closed = False
        node.do(lambda made: self._make(made, kind, topic, warn), failed)

    def _make(self, node: Any, kind: str, topic: str, warn: Failed) -> None:
        if self._closed:
            return
        from rclpy.event_handler import PublisherEventCallbacks

        def incompatible(event: Any) -> None:
            warn(f"a reader of {publisher.topic_name} wants another QoS ({_policy(event)}), so it hears nothing")

        callbacks = PublisherEventCallbacks(incompatible_qos=incompatible)
        publisher = node.create_publisher(
            message_class(kind), topic, profile_of(self._quality), event_callbacks=callbacks
        )
        self._clock = node.get_clock()
        self._publisher = publisher

    @property
    def ready(self) -> bool:
        """Whether it can publish."""
        return self._publisher is not None

    @property
    def readers(self) -> int:
        """How many readers it has."""
        return int(self._publisher.get_subscription_count()) if self._publisher is not None else 0

    def moment(self, frame: str, child: str = "") -> Moment:
        """Returns the time of the node's clock, for a message in a frame of reference; only where it is `ready`."""
        seconds, nanoseconds = divmod(self._clock.now().nanoseconds, 1_000_000_000)
        return Moment(seconds, nanoseconds, frame, child)

    def new(self) -> Any:
        """Returns an empty message of its type; only where it is `ready`."""
        return self._publisher.msg_type()

    def publish(self, message: Any) -> None:
        """Publishes a message; before it is ready, and once it is closed, the message is lost. Any thread."""
        publisher = self._publisher
        if publisher is not None and not self._closed:
            publisher.publish(message)

    def close(self) -> None:
        """Closes it once what it said has arrived, or could not."""
        self._closed = True
        self._node.do(self._destroy)

    def _destroy(self, node: Any) -> None:
        publisher, self._publisher = self._publisher, None
        if publisher is None:
            return
        if self._quality.reliability == "reliable":
            from rclpy.duration import Duration

            publisher.wait_for_all_acked(Duration(nanoseconds=round(ACKNOWLEDGED_S * 1e9)))
        node.destroy_publisher(publisher)


class Inlet:
    """A subscription of an agent's node.

    Args:
        node: the node.
        kind: the name of its message type.
        topic: its topic; a relative name is below the agent's namespace.
        quality: its QoS.
        heard: takes each message, in the node's thread; what it raises goes to `warn`.
        failed: is told where it cannot be made.
        warn: is told where what is said there cannot be heard.
    """

    def __init__(
        self,
        node: RosNode,
        kind: str,
        topic: str,
        quality: Quality,
        heard: Callable[[Any], None],
        failed: Failed,
        warn: Failed,
    ) -> None:
        self._node = node
        self._kind = kind
        self._topic = topic
        self._heard = heard
        self._warn = warn
        self._subscription: Any = None
        self._closed = False
        node.do(lambda made: self._make(made, quality), failed)

    def _make(self, node: Any, quality: Quality) -> None:
        if self._closed:
            return
        from rclpy.event_handler import SubscriptionEventCallbacks

        def incompatible(event: Any) -> None:
            name = self._subscription.topic_name if self._subscription is not None else self._topic
            self._warn(f"a node that publishes {name} has another QoS ({_policy(event)}), so it is not heard")

        self._subscription = node.create_subscription(
            message_class(self._kind),
            self._topic,
            self._take,
            profile_of(quality),
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=incompatible),
        )

    def _take(self, message: Any) -> None:
        try:
            self._heard(message)
        except Exception as error:  # the node's thread outlives whatever a message leads to
            self._warn(f"a message of {self._topic} was dropped: {error}")

    def explain(self, tell: Callable[[str], None]) -> None:
        """Has `tell` called, in the node's thread, with a sentence on why nothing may be heard."""

        def look(node: Any) -> None:
            if self._subscription is not None:
                name = self._subscription.topic_name
                there = [(f"{it.node_namespace.rstrip('/')}/{it.node_name}", it.topic_type)
                         for it in node.get_publishers_info_by_topic(name)]  # fmt: skip
                tell(silence_of(name, self._kind, there))

        self._node.do(look)

    def close(self) -> None:
        """Hears nothing more."""
        self._closed = True
        self._node.do(self._destroy)

    def _destroy(self, node: Any) -> None:
        subscription, self._subscription = self._subscription, None
        if subscription is not None:
            node.destroy_subscription(subscription)


def silence_of(topic: str, kind: str, publishers: list[tuple[str, str]]) -> str:
    """Returns why nothing is heard of a topic, as a sentence.

    Args:
        topic: its full name.
        kind: the type that is listened for.
        publishers: name and type of each node that publishes it.
    """
    if not publishers:
        return f"no node publishes {topic}: start the robot's nodes, or name the topic that they have"
    others = [f"{name} publishes {theirs}" for name, theirs in publishers if theirs != kind]
    if others:
        return f"{topic} is listened to as {kind}, but {' and '.join(sorted(set(others)))}: set the message type"
    return f"{publishers[0][0]} publishes {topic}, but says nothing"


def _policy(event: Any) -> str:
    kind = event.last_policy_kind
    return str(getattr(kind, "name", kind)).lower().removeprefix("rmw_qos_policy_")


class RosNode:
    """The node of an agent. All methods may be called from any thread; none waits.

    Args:
        agent: the agent's name.
        name: the node's own name.
    """

    def __init__(self, agent: str, name: str = "pancakes") -> None:
        self._name = agent
        self._own_name = name
        self._lock = threading.Lock()
        self._jobs: deque[tuple[Callable[[Any], None], Failed | None]] = deque()
        self._executor: Any = None
        self._context: Any = None
        self._ended = False
        self._came = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"ros-{agent}")
        self._thread.start()

    def do(self, job: Callable[[Any], None], failed: Failed | None = None) -> None:
        """Has `job` called with the rclpy node, in the node's thread, after all that was asked for before.

        Args:
            job: what to do.
            failed: is told what it raised; None: that is of no interest.
        """
        with self._lock:
            self._jobs.append((job, failed))
            executor = self._executor
        self._came.set()
        if executor is not None:
            executor.create_task(_nothing)  # which wakes the thread

    def end(self) -> None:
        """Ends it, after all that was asked for before."""
        self.do(self._end)

    def join(self, timeout_s: float) -> bool:
        """Waits for the end of its thread; returns whether it has ended. No actor calls it."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _end(self, node: Any) -> None:
        self._ended = True

    def _take_job(self) -> tuple[Callable[[Any], None], Failed | None] | None:
        with self._lock:
            return self._jobs.popleft() if self._jobs else None

    def _run(self) -> None:
        try:
            node = self._open()
        except Exception as error:  # a library of others may raise anything when it is loaded
            self._refuse_all(f"ROS 2 does not start: {error}")
            return
        try:
            while True:
                while (job := self._take_job()) is not None:
                    _carry_out(*job, node)
                if self._ended:
                    return
                self._executor.spin_once()
        finally:
            with self._lock:
                executor, self._executor = self._executor, None
            executor.shutdown()
            node.destroy_node()  # before its context: otherwise its sockets stay open
            self._context.try_shutdown()

    def _open(self) -> Any:
        have_fields_checked()
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
        from rclpy.signals import SignalHandlerOptions

        # A context of its own: one process may have several agents, and signals are the agent's.
        context = self._context = Context()
        rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
        node = Node(
            self._own_name,
            namespace=f"/{self._name}",
            context=context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        with self._lock:
            self._executor = executor
        return node

    def _refuse_all(self, reason: str) -> None:
        while not self._ended:
            while (job := self._take_job()) is not None:
                if job[0] == self._end:
                    self._ended = True
                elif job[1] is not None:
                    job[1](reason)
            if not self._ended:
                self._came.wait()
                self._came.clear()


def _nothing() -> None:
    """Wakes the node's thread."""


def _carry_out(job: Callable[[Any], None], failed: Failed | None, node: Any) -> None:
    try:
        job(node)
    except PancakesError as error:
        if failed is not None:
            failed(str(error))
    except Exception as error:  # rclpy raises what it likes, such as for a name that is none
        if failed is not None:
            failed(f"ROS 2 refuses it: {' '.join(str(error).split())}")
