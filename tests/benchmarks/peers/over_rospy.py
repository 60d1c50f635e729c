"""Two processes with rospy, of ROS 1: messages of bytes over TCPROS, published in the caller's thread, none given up.

    python over_rospy.py master
    ROS_MASTER_URI=ADDRESS python over_rospy.py far
    ROS_MASTER_URI=ADDRESS python over_rospy.py near

Each wants ROS_IP=127.0.0.1, and ROS_HOME and ROS_LOG_DIR where it may write.
"""

from __future__ import annotations

import queue
import sys
import time
import warnings
from typing import Any

from talk import body_of, encode, hear, kind_of, say, unpack

KNOCK_S = 0.1
"""How often the other is called until it answers."""
BUFFER_BYTES = 1 << 22


def master() -> None:
    """Runs the master, at which the nodes find each other."""
    from rosmaster.master import Master

    running = Master(0)
    running.start()
    say(at=running.uri)
    hear()


def far() -> None:
    """Answers pings, and acknowledges the last of what comes one way."""
    import rospy
    from std_msgs.msg import UInt8MultiArray

    rospy.init_node("far", disable_signals=True)
    answers = rospy.Publisher("near", UInt8MultiArray, queue_size=None, tcp_nodelay=True)
    count = 0

    def take(message: Any) -> None:
        nonlocal count
        packet = unpack(message.data)
        kind, body = kind_of(packet), body_of(packet)
        if kind == "ping":
            count = 0
            answers.publish(UInt8MultiArray(data=encode("pong", body["number"], body["data"])))
        else:
            count += 1
            if body["number"] < 0:
                answers.publish(UInt8MultiArray(data=encode("got", count, b"")))

    rospy.Subscriber("far", UInt8MultiArray, take, tcp_nodelay=True, buff_size=BUFFER_BYTES)
    say(at="far")
    hear()


def near() -> None:
    """Measures round trips, then packets one way."""
    import rospy
    from std_msgs.msg import UInt8MultiArray

    rospy.init_node("near", disable_signals=True)
    came: queue.SimpleQueue[Any] = queue.SimpleQueue()
    rospy.Subscriber(
        "near",
        UInt8MultiArray,
        lambda message: came.put(unpack(message.data)),
        tcp_nodelay=True,
        buff_size=BUFFER_BYTES,
    )
    publisher = rospy.Publisher("far", UInt8MultiArray, queue_size=None, tcp_nodelay=True)
    plan = hear()
    data = bytes(plan["size"])
    while True:  # until both know of each other
        publisher.publish(UInt8MultiArray(data=encode("ping", -1, data)))
        try:
            came.get(timeout=KNOCK_S)
            break
        except queue.Empty:
            continue
    time.sleep(2 * KNOCK_S)
    while not came.empty():
        came.get()
    times_s = []
    for number in range(plan["round_trips"]):
        asked_s = time.perf_counter()
        publisher.publish(UInt8MultiArray(data=encode("ping", number, data)))
        came.get()
        times_s.append(time.perf_counter() - asked_s)
    packets = plan["packets"]
    began_s = time.perf_counter()
    for number in range(packets):
        number = number if number + 1 < packets else -1
        publisher.publish(UInt8MultiArray(data=encode("load", number, data)))
    count = body_of(came.get())["number"]
    say(times_s=times_s, per_s=packets / (time.perf_counter() - began_s), received=count)
    hear()


if __name__ == "__main__":
    warnings.simplefilter("ignore", SyntaxWarning)  # that a publisher without a queue publishes in the caller's thread
    {"master": master, "far": far, "near": near}[sys.argv[1]]()
