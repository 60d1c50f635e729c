"""Actors share nothing but tables: what mypy cannot see of that.

`Registry` hands out a `Reference`, so mypy finds a read of any other attribute. These tests find the ways around: a
type that is asked for at run time, a function that one actor hands another, and a lock that is held over a call.
"""

import ast
import builtins
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

LOOK_FROM_OUTSIDE = {
    "simulation/agent_handle.py": "it looks between two turns, or a test looks inside",
    "simulation/simulation.py": "it looks between two turns, on the thread that gives all turns",
    "testing/agent_in_test.py": "a test looks inside",
    "pytest_plugin.py": "a test looks inside",
    "tools/recording/virtual_recorder.py": "it looks between two turns, on the thread that gives all turns",
    "tools/replay/virtual_replay.py": "it looks between two turns, on the thread that gives all turns",
    "tools/web/virtual_watch.py": "it looks between two turns, on the thread that gives all turns",
}
"""The files that ask what an actor is, and why they may."""

HAND_TO_THEIR_OWN = {
    "bodies/sim/bus_server.py": "a connection gives the world, whose part it is, what came in",
    "runtime/hosting/mover.py": "a part of the service that it calls",
    "runtime/services/actuator_fence.py": "a part of the actuator's task",
    "runtime/services/device.py": "a driver, which is a part of its task",
    "runtime/services/service_keeper.py": "a part of the root",
    "runtime/services/traces.py": "a part of the Log Service",
    "runtime/supervision/startup.py": "a part of its service",
    "tools/replay/rerun.py": "it is no actor: it leads the one task that it runs again",
    "pancakes_ros2/ros_motors.py": "a driver, which is a part of its task",
    "pancakes_ros2/ros_sensors.py": "a driver, which is a part of its task",
    "pancakes_sensor_field/drivers.py": "a driver, which is a part of its task",
    "pancakes_sensor_field/tiny_nodes.py": "a part of the task that simulates the nodes",
}
"""The files that give a function to an actor of another name, and what they are to it."""

OWN_TABLES = {
    "runtime/hosting/host_state.py": "its reservations, a table without a lock, and the clock",
    "runtime/hosting/shared_outbox.py": "the outbox, which is pure",
    "runtime/kernel/channel_queue.py": "the queue's own limits",
    "runtime/kernel/dead_letters.py": "the keep of a queue, which is data",
    "runtime/kernel/pinned.py": "the wake-up of a thread, which is a queue",
    "runtime/kernel/pool.py": "the threads of the pool, which the lock guards",
    "runtime/kernel/stream.py": "the subscriptions of the stream, which the lock guards",
}
"""The files that call more than containers under a lock, and what they call."""

CONTAINERS = frozenset(
    (
        "acquire",
        "add",
        "append",
        "appendleft",
        "clear",
        "copy",
        "count",
        "difference",
        "discard",
        "extend",
        "get",
        "index",
        "is_set",
        "items",
        "keys",
        "join",
        "locked",
        "notify",
        "notify_all",
        "pop",
        "popitem",
        "popleft",
        "release",
        "remove",
        "setdefault",
        "startswith",
        "endswith",
        "update",
        "values",
        "wait",
    )
)


@cache
def trees() -> dict[str, ast.Module]:
    """Returns the files of the product, by their paths without the name of their distribution."""
    roots = [ROOT / "pancakes", *sorted(ROOT.glob("plugins/*/"))]
    return {
        path.relative_to(root).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
        for root in roots
        for path in sorted(root.rglob("*.py"))
    }


def calls(tree: ast.AST) -> Iterator[ast.Call]:
    return (node for node in ast.walk(tree) if isinstance(node, ast.Call))


def names(types: ast.expr) -> set[str]:
    """Returns the names of the classes that `isinstance` is given."""
    parts = types.elts if isinstance(types, ast.Tuple) else [types]
    return {part.id for part in parts if isinstance(part, ast.Name)}


def actor_classes() -> set[str]:
    classes = [node for tree in trees().values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    found = {"Component"}
    while more := {cls.name for cls in classes if {ast.unparse(base) for base in cls.bases} & found} - found:
        found |= more
    return found


def is_foreign(call: ast.Call) -> bool:
    """Returns whether a call goes to more than a container, a class, a builtin, or a method of the same object."""
    function = call.func
    if isinstance(function, ast.Attribute):
        own = ast.unparse(function.value) == "self" and function.attr.startswith("_")
        return not own and function.attr not in CONTAINERS
    name = ast.unparse(function)
    return name not in dir(builtins) and not name.lstrip("_")[0].isupper()


def test_no_code_asks_an_actor_what_it_is() -> None:
    actors = actor_classes()
    assert {"Task", "Service", "Root", "NetworkService", "DeviceTask", "ScanTarget"} <= actors
    asks = {
        file
        for file, tree in trees().items()
        for call in calls(tree)
        if ast.unparse(call.func) == "isinstance" and names(call.args[1]) & actors
    }
    assert asks == set(LOOK_FROM_OUTSIDE)
    assert [file for file, tree in trees().items() if "runtime_checkable" in ast.dump(tree)] == []


def test_what_an_actor_tells_another_is_data() -> None:
    for file, tree in trees().items():
        for call in calls(tree):
            if ast.unparse(call.func) == "tell" and len(call.args) == 2:
                told = list(ast.walk(call.args[1]))
                functions = [node for node in told if isinstance(node, ast.Lambda) or ast.unparse(node) == "partial"]
                assert functions == [], f"{file}:{call.lineno}"
        if file.endswith("_messages.py"):
            assert "Callable" not in ast.dump(tree), f"{file}: a message is data"


def test_an_actor_is_handed_a_function_by_its_own_parts_alone() -> None:
    hands = {
        file
        for file, tree in trees().items()
        for call in calls(tree)
        if isinstance(call.func, ast.Attribute)
        and call.func.attr == "call"
        and ast.unparse(call.func.value) not in ("self", "subprocess")
    }
    assert hands == set(HAND_TO_THEIR_OWN)


def test_no_lock_is_held_over_a_call() -> None:
    holds = {
        file
        for file, tree in trees().items()
        if file.startswith("runtime/") or file in ("service.py", "task.py")
        for block in ast.walk(tree)
        if isinstance(block, ast.With) and any("lock" in ast.unparse(it.context_expr) for it in block.items)
        for statement in block.body
        if any(is_foreign(call) for call in calls(statement))
    }
    assert holds == set(OWN_TABLES)
