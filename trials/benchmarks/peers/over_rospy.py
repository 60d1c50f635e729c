"""Two processes with rospy, of ROS 1: messages of bytes over TCPROS, published in the caller's thread, none given up.

    python over_rospy.py master
    ROS_MASTER_URI=ADDRESS python over_rospy.py far
    ROS_MASTER_URI=ADDRESS python over_rospy.py near

Each wants ROS_IP=127.0.0.1, and ROS_HOME and ROS_LOG_DIR where it may write.
"""

from __future__ import annotations

import queue
import sys
import warnings
from typing import Any

from talk import Bytes, answering, hear, knock, measure, say, unpack

BUFFER_BYTES = 1 << 22


def master() -> None:
    """Runs the master, at which the nodes find each other."""
    from rosmaster.master import Master

    running = Master(0)
    running.start()
    say(at=running.uri)
    hear()


def node(name: str) -> None:
    """Makes this process a node."""
    import rospy

    rospy.init_node(name, disable_signals=True)


def publisher(topic: str) -> Bytes:
    """Returns what publishes a packet, in the caller's thread, and waits rather than give it up."""
    import rospy
    from std_msgs.msg import UInt8MultiArray

    publish = rospy.Publisher(topic, UInt8MultiArray, queue_size=None, tcp_nodelay=True).publish
    return lambda data: publish(UInt8MultiArray(data=data))


def subscribe(topic: str, take: Bytes) -> None:
    """Has each packet taken."""
    import rospy
    from std_msgs.msg import UInt8MultiArray

    rospy.Subscriber(
        topic, UInt8MultiArray, lambda message: take(message.data), tcp_nodelay=True, buff_size=BUFFER_BYTES
    )


def far() -> None:
    """Answers pings, and acknowledges the last of what comes one way."""
    node("far")
    subscribe("far", answering(publisher("near")))
    say(at="far")
    hear()


def near() -> None:
    """Measures round trips, then packets one way."""
    node("near")
    came: queue.SimpleQueue[Any] = queue.SimpleQueue()
    subscribe("near", lambda data: came.put(unpack(data)))
    publish = publisher("far")
    plan = hear()
    knock(publish, came)
    measure(plan, publish, publish, came.get)


if __name__ == "__main__":
    warnings.simplefilter("ignore", SyntaxWarning)  # that a publisher without a queue publishes in the caller's thread
    {"master": master, "far": far, "near": near}[sys.argv[1]]()
