"""Which agents of this process have a node, so that the drivers and services of an agent share one."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from pancakes.errors import PancakesError
from pancakes_ros2.installation import check_agent_name, check_installed
from pancakes_ros2.ros_node import RosNode


@dataclass
class _Shared:
    """A node, and how many use it."""

    node: RosNode
    users: int = 0


def check_possible(agent: str, virtual: bool) -> None:
    """Makes sure that an agent can be a node.

    Args:
        agent: the agent's name.
        virtual: whether the agent lives in virtual time.

    Raises:
        PancakesError: there is no ROS 2, the agent lives in virtual time, or its name is none in ROS 2.
    """
    if virtual:
        raise PancakesError(
            f"{agent} lives in virtual time, where no robot of ROS 2 can follow it: run it live,"
            " or give its devices other drivers, such as `null.*`, for this run"
        )
    check_agent_name(agent)
    check_installed()


class NodeTable:
    """The nodes of the agents of a process. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._nodes: dict[str, _Shared] = {}

    def take(self, agent: str, virtual: bool) -> RosNode:
        """Returns the node of an agent, which is made for its first user. Each user gives it back once.

        Args:
            agent: the agent's name.
            virtual: whether the agent lives in virtual time.

        Raises:
            PancakesError: there is no ROS 2, the agent lives in virtual time, or its name is none in ROS 2.
        """
        check_possible(agent, virtual)
        with self._lock:
            shared = self._nodes.get(agent)
            if shared is None:
                shared = self._nodes[agent] = _Shared(RosNode(agent))
            shared.users += 1
            return shared.node

    def give_back(self, agent: str) -> None:
        """A user needs the node no more; the last one ends it."""
        with self._lock:
            shared = self._nodes[agent]
            shared.users -= 1
            if shared.users:
                return
            del self._nodes[agent]
        shared.node.end()


NODES = NodeTable()
"""Those of this process."""


def fail(reason: str) -> None:
    """Fails the actor that calls it.

    Raises:
        PancakesError: always, with the reason.
    """
    raise PancakesError(reason)
