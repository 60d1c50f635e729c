"""Processes with rclpy, of ROS 2, over Fast DDS: reliable, and none given up.

    python over_rclpy.py far
    python over_rclpy.py near ADDRESS
    python over_rclpy.py paced EXECUTOR RATE_HZ SPEAKS SUBSCRIBERS

EXECUTOR is `single` or `events`; the first two run with `single`. Each wants ROS_DOMAIN_ID, and
ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST.

The third publishes a vector of three numbers in a timer, if SPEAKS is 1, and has so many subscribers. It says how many
vectors these have had whenever it is told anything.
"""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import rclpy
from geometry_msgs.msg import Vector3
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import UInt8MultiArray
from talk import Bytes, answering, hear, knock, measure, say, unpack

DEPTH = 200_000
"""As many as a run sends at most: nothing falls out."""


def quality(depth: int = DEPTH) -> QoSProfile:
    """Returns how packets travel: all of them, in order."""
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=ReliabilityPolicy.RELIABLE)


def node(name: str) -> Any:
    """Makes this process a node."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # a signal ends it at once, without an error
    return rclpy.create_node(name)


def spin(kind: str, of: Any, beside: Callable[[], None]) -> None:
    """Runs the callbacks of a node on this thread, and a function on another.

    With `events` that function must not publish: it may wait for ever for a lock that the executor holds.
    """
    if kind == "events":
        from rclpy.experimental.events_executor import EventsExecutor

        executor = EventsExecutor()
    else:
        executor = SingleThreadedExecutor()
    executor.add_node(of)
    threading.Thread(target=beside, daemon=True).start()
    with suppress(ExternalShutdownException):
        while rclpy.ok():  # the `spin` of `events` does not come back to its timers
            executor.spin_once(timeout_sec=1.0)


def publisher(of: Any, topic: str) -> Bytes:
    """Returns what publishes a packet."""
    publish = of.create_publisher(UInt8MultiArray, topic, quality()).publish
    return lambda data: publish(UInt8MultiArray(data=data))


def subscribe(of: Any, topic: str, take: Bytes) -> None:
    """Has each packet taken."""
    of.create_subscription(UInt8MultiArray, topic, lambda message: take(bytes(message.data)), quality())


def far() -> None:
    """Answers pings, and acknowledges the last of what comes one way."""
    it = node("far")
    subscribe(it, "far", answering(publisher(it, "near")))

    def wait() -> None:
        say(at="far")
        hear()

    spin("single", it, wait)


def near() -> None:
    """Measures round trips, then packets one way."""
    it = node("near")
    came: queue.SimpleQueue[Any] = queue.SimpleQueue()
    subscribe(it, "near", lambda data: came.put(unpack(data)))
    publish = publisher(it, "far")

    def run() -> None:
        plan = hear()
        knock(publish, came)
        measure(plan, publish, publish, came.get)

    spin("single", it, run)


def paced(kind: str, rate_hz: float, speaks: bool, subscribers: int) -> None:
    """Publishes at a rate, or takes what comes, or both."""
    it = node("speaker" if speaks else "hearer")
    counts = [0] * subscribers

    def taker(number: int) -> Any:
        def take(vector: Any) -> None:
            counts[number] += 1

        return take

    for number in range(subscribers):
        it.create_subscription(Vector3, "paced", taker(number), quality(10))
    if speaks:
        to = it.create_publisher(Vector3, "paced", quality(10))
        it.create_timer(1.0 / rate_hz, lambda: to.publish(Vector3(x=1.0, y=2.0, z=0.5)))

    def tell() -> None:
        say(at="here")
        while True:
            hear()
            say(count=sum(counts))

    spin(kind, it, tell)


if __name__ == "__main__":
    role, *rest = sys.argv[1:]
    if role == "paced":
        paced(rest[0], float(rest[1]), rest[2] == "1", int(rest[3]))
    else:
        {"far": far, "near": near}[role]()
