"""The nodes of an agent's tasks, and the thread that serves them.

A request of ROS 2 is answered once the agent has carried it out; so this thread waits, and the one that hears readings
does not.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any, Final

from pancakes.control import Reply
from pancakes.errors import PancakesError
from pancakes_ros2.installation import ros_name
from pancakes_ros2.newest import Newest
from pancakes_ros2.ros_node import Failed, RosNode
from pancakes_ros2.task_node import TaskNode, TaskView

ANSWER_S: Final = 5.0
"""The agent has so long to answer, in seconds of the host."""
AskLater = Callable[[Any], "Future[Reply]"]


class TaskNodes:
    """The nodes of the tasks. All methods may be called from any thread.

    Args:
        agent: the agent's name.
        node: the agent's node, whose context they share.
        ask: asks the agent something.
        failed: is told where they cannot be made.
        ended: called in their thread when they are gone, or were never made.
    """

    def __init__(self, agent: str, node: RosNode, ask: AskLater, failed: Failed, ended: Callable[[], None]) -> None:
        self._agent = agent
        self._ask_later = ask
        self._failed = failed
        self._ended = ended
        self._lock = threading.Lock()
        self._executor: Any = None
        self._nodes: dict[tuple[str, str], TaskNode] = {}
        self._left_out: set[tuple[str, str]] = set()
        self._views: Newest[Sequence[TaskView]] = Newest(1, self._wake)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(node,), name=f"ros-tasks-{agent}")
        self._thread.start()

    def show(self, views: Sequence[TaskView]) -> None:
        """Takes the agent's tasks: makes nodes of new ones, and takes away those of which none is left."""
        self._views.put(views)

    def end(self) -> None:
        """Takes all nodes away."""
        self._closed.set()
        self._wake()

    def _wake(self) -> None:
        with self._lock:
            executor = self._executor
        if executor is not None:
            executor.create_task(_look_again)

    def _run(self, node: RosNode) -> None:
        found: Future[Any] = Future()
        node.do(lambda made: found.set_result(made.context), lambda reason: found.set_exception(PancakesError(reason)))
        try:
            self._serve(found.result())
        except Exception as error:  # a library of others may raise anything
            self._failed(f"tasks are no nodes of ROS 2: {error}")
        finally:
            self._ended()

    def _serve(self, context: Any) -> None:
        from rclpy.executors import SingleThreadedExecutor

        executor = SingleThreadedExecutor(context=context)
        with self._lock:
            self._executor = executor
        try:
            while not self._closed.is_set():
                self._update(context)
                executor.spin_once()
        finally:
            with self._lock:
                self._executor = None
            executor.shutdown()
            for task in self._nodes.values():
                task.node.destroy_node()

    def _update(self, context: Any) -> None:
        newest, _ = self._views.take()
        for views in newest:
            there = {(view.service, view.name): view for view in views}
            for key in [key for key in self._nodes if key not in there]:
                task = self._nodes.pop(key)
                self._executor.remove_node(task.node)
                task.node.destroy_node()
            for key, view in there.items():
                if key in self._nodes:
                    self._nodes[key].show(view)
                elif self._is_free(view):
                    self._nodes[key] = self._made(context, view)

    def _is_free(self, view: TaskView) -> bool:
        """Returns whether no other node of this agent has a task's name; if one has, says so once."""
        place = place_of(self._agent, view)
        taken = {place_of(self._agent, task.view): f"the task {task.view.target}" for task in self._nodes.values()}
        taken[f"/{self._agent}", "pancakes"] = "the node of the agent itself"
        other = taken.get(place)
        key = (view.service, view.name)
        if other is None:
            self._left_out.discard(key)
        elif key not in self._left_out:
            self._left_out.add(key)
            self._failed(
                f"the task {view.target} is no node of ROS 2: it would be {'/'.join(place)}, as {other} is. Rename one"
            )
        return other is None

    def _made(self, context: Any, view: TaskView) -> TaskNode:
        from rclpy.node import Node

        space, name = place_of(self._agent, view)
        node = Node(
            name,
            namespace=space,
            context=context,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._executor.add_node(node)
        return TaskNode(node, view, self._ask)

    def _ask(self, body: Any) -> Reply:
        try:
            return self._ask_later(body).result(ANSWER_S)
        except TimeoutError:
            raise PancakesError(f"{self._agent} did not answer within {ANSWER_S:g} s") from None


def place_of(agent: str, view: TaskView) -> tuple[str, str]:
    """Returns the namespace and the name that a task has as a node."""
    space = f"/{agent}" if view.service == "client" else f"/{agent}/{ros_name(view.service)}"
    return space, ros_name(view.name)


def _look_again() -> None:
    """Wakes the thread."""
