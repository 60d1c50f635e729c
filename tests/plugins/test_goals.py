"""Tasks with a goal, the device's settings, and the pipe to the goal keeper: what needs no ROS 2."""

import os
import re
import subprocess
import sys
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

import psutil
import pytest
from devices.driver_context import DriverContext
from pancakes_ros2 import ros_action, ros_call
from pancakes_ros2.action_task import ActionState, ActionTask, pose_goal
from pancakes_ros2.goal_packets import Call, Goal, GoalStatus
from pancakes_ros2.installation import checked_type, type_class
from pancakes_ros2.keeper_pipe import (
    MOST_BACKLOG,
    Command,
    Failure,
    Hold,
    PipeWriter,
    Ready,
    Setup,
    Warned,
    read_all,
)
from pancakes_ros2.ros_action import RosAction
from pancakes_ros2.ros_call import RosCall

from pancakes import Actuator, Task
from pancakes.control import Migrate, Stop
from pancakes.errors import ClassError, PancakesError
from pancakes.packet import SYSTEM
from pancakes.settings import check_settings, make_settings

# Tasks -----------------------------------------------------------------------------------------------------------


class Server(Actuator):
    """Stands for the device and the server: keeps what it is told."""

    type = "ros2.goal"

    def open(self) -> None:
        self.told: list[Any] = HEARD.setdefault(self.context.agent, [])

    def write(self, command: Goal, ttl_s: float, source: str) -> None:
        entry = (command.number, command.fields)
        if not self.told or self.told[-1] != entry:
            self.told.append(entry)

    def safe_stop(self) -> None:
        self.told.append("stands")


HEARD: dict[str, list[Any]] = {}


class Visit(ActionTask[None, ActionState]):
    def on_start(self) -> None:
        self.heard: list[Any] = []
        if not self.state.number:
            self.send_goal({"order": 3})

    def on_goal_feedback(self, status: GoalStatus) -> None:
        self.heard.append(status.feedback)

    def on_goal_end(self, status: GoalStatus) -> None:
        self.heard.append(status.state)


@pytest.fixture
def robot(fleet):
    HEARD.clear()
    return fleet.start("one", devices={"nav": Server}, tasks={"Visit": Visit})


def tell(agent, state, number=1, task="one/client/Visit", **others):
    agent.publish(SYSTEM, GoalStatus("nav", task, number, state, **others))


def test_a_goal_is_commanded_while_it_is_open_and_feedback_and_end_come_once(fleet, robot):
    fleet.run_for(3.0)
    visit = robot.task("Visit")
    assert HEARD["one"] == [(1, {"order": 3})], "it never comes to stand"
    tell(robot, "running")
    tell(robot, "running", feedback={"left": 2})
    tell(robot, "running", feedback={"left": 1}, task="one/client/Other")
    tell(robot, "succeeded", number=0)
    fleet.run_for(0.1)
    assert (visit.goal_is_open, visit.goal_state, visit.heard) == (True, "running", [{"left": 2}])
    tell(robot, "succeeded")
    tell(robot, "succeeded")
    fleet.run_for(1.0)
    assert (visit.goal_is_open, visit.goal_state, visit.heard) == (False, None, [{"left": 2}, "succeeded"])
    assert HEARD["one"][1:] == ["stands"]
    assert not visit.cancel_goal()


def test_a_goal_that_is_held_stays_open_and_one_that_is_cancelled_has_an_end(fleet, robot):
    fleet.run_for(0.5)
    visit = robot.task("Visit")
    tell(robot, "held")
    fleet.run_for(0.5)
    assert visit.goal_is_open and visit.goal_state == "held"
    assert visit.cancel_goal()
    fleet.run_for(0.5)
    assert HEARD["one"][-1] == (1, None)
    tell(robot, "canceled")
    fleet.run_for(0.1)
    assert visit.heard == ["canceled"]


def test_a_new_goal_replaces_the_one_before_whose_end_is_not_told(fleet, robot):
    fleet.run_for(0.5)
    visit = robot.task("Visit")
    assert visit.send_goal({"order": 4}) == 2
    tell(robot, "held", number=1)
    fleet.run_for(0.5)
    assert HEARD["one"] == [(1, {"order": 3}), (2, {"order": 4})]
    assert visit.heard == []


def test_a_goal_moves_with_its_task(fleet, robot):
    fleet.start("two", devices={"nav": Server}, classes={"Visit": Visit})
    fleet.run_for(1.0)
    assert robot.ask(Migrate("Visit", to="two")).ok
    fleet.run_for(1.0)
    assert HEARD == {"one": [(1, {"order": 3}), "stands", "stands"], "two": [(1, {"order": 3})]}


def test_a_task_that_is_stopped_lets_the_robot_stand(fleet, robot):
    fleet.run_for(1.0)
    assert robot.ask(Stop("Visit")).ok
    assert HEARD["one"][-1] == "stands"


def test_of_several_devices_the_named_one_is_commanded(fleet):
    class Named(Visit):
        goal_device = "dock"

    HEARD.clear()
    robot = fleet.start("one", devices={"nav": Server, "dock": Server}, tasks={"Visit": Named})
    fleet.run_for(1.0)
    assert HEARD["one"] == [(1, {"order": 3})]
    tell(robot, "succeeded")
    fleet.run_for(0.1)
    assert robot.task("Visit").goal_is_open, "that was the other device's"


def test_a_goal_that_cannot_travel_is_refused(fleet, robot):
    with pytest.raises(PancakesError, match="the goal of Visit cannot travel: .*; write numbers, strings, lists and"):
        robot.task("Visit").send_goal({"order": object()})
    for value in (2**70, "\ud800"):
        with pytest.raises(PancakesError, match="the goal of Visit cannot travel: .*; write numbers"):
            robot.task("Visit").send_goal({"order": value})
    assert robot.task("Visit").state.number == 1


def test_a_state_that_cannot_keep_a_goal_is_refused():
    with pytest.raises(ClassError, match=r"Wrong\.State is no ActionState: write `class State\(ActionState\):`"):

        class Wrong(ActionTask):
            @dataclass
            class State:
                goal: str = ""

    assert not issubclass(Task, ActionTask)


def test_a_pose_is_a_goal_of_nav2():
    goal = pose_goal(1.0, 2.0, 3.14159265358979, behavior_tree="b.xml")
    assert goal["behavior_tree"] == "b.xml"
    assert goal["pose"]["header"] == {"frame_id": "map"}
    assert goal["pose"]["pose"]["orientation"] == {"z": pytest.approx(1.0), "w": pytest.approx(0.0)}


# Devices ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cls", "settings", "fault"),
    [
        (
            RosAction,
            {"action": "Fibonacci", "name": "go"},
            "'Fibonacci' is no action type of ROS 2, such as 'nav2_msgs",
        ),
        (RosAction, {"action": "std_msgs/msg/Bool", "name": "go"}, "'std_msgs/msg/Bool' is no action type"),
        (RosAction, {"action": "a/B", "name": "/"}, "the action has no name"),
        (RosCall, {"service": "a/action/B", "name": "x"}, "'a/action/B' is no service type"),
        (RosCall, {"service": "a/B", "name": ""}, "the service has no name"),
    ],
)
def test_what_is_wrong_with_the_settings_of_a_device_is_a_sentence(cls, settings, fault):
    assert fault in "; ".join(str(problem) for problem in check_settings(cls.Settings, settings))


def test_a_type_may_be_named_short():
    assert (
        make_settings(RosAction.Settings, {"action": "nav2_msgs/Spin", "name": "x"}).action == "nav2_msgs/action/Spin"
    )
    assert checked_type("std_srvs/Trigger", "srv") == "std_srvs/srv/Trigger"


def test_a_type_that_is_not_installed_is_named():
    with pytest.raises(
        PancakesError, match="there is no action type nav2_msgs/action/Spin: the package nav2_msgs is not"
    ):
        type_class("nav2_msgs/action/Spin", "action")


@pytest.mark.parametrize(
    ("driver", "settings"),
    [(RosAction, {"action": "a/B", "name": "go"}), (RosCall, {"service": "a/B", "name": "go"})],
)
def test_without_ros_2_a_device_says_what_to_do(driver, settings):
    device = driver(DriverContext(), make_settings(driver.Settings, settings))
    with pytest.raises(PancakesError, match="this Python has no ROS 2, .*: source the setup file"):
        device.open()
    device.safe_stop()
    device.close()


class MuteService:
    """A node, its client and a service in one, which never answers."""

    def __init__(self) -> None:
        self.pending: list[Any] = []

    def do(self, job, failed=None):
        job(self)

    def take(self, agent, virtual):
        return self

    def create_client(self, kind, name):
        return self

    def service_is_ready(self):
        return True

    def call_async(self, request):
        self.pending.append(Future())
        return self.pending[-1]

    def remove_pending_request(self, future):
        self.pending.remove(future)


def test_a_call_that_is_given_up_is_not_kept(monkeypatch):
    class Kind:
        class Request:
            def get_fields_and_field_types(self):
                return {}

    service = MuteService()
    monkeypatch.setattr(ros_call, "NODES", service)
    monkeypatch.setattr(ros_call, "type_class", lambda name, kind: Kind)
    context = DriverContext()
    device = RosCall(context, make_settings(RosCall.Settings, {"service": "a/B", "name": "go"}))
    device.open()
    device.write(Call(1), 0.5, "t")
    device.write(Call(1), 0.5, "t")
    context.run_until(0.2)
    assert len(service.pending) == 2
    context.run_until(6.0)
    assert [answer.error[:35] for _, answer, _ in context.sent] == ["the service go has not answered wit"] * 2
    assert service.pending == []


# The goal keeper -------------------------------------------------------------------------------------------------

OBEDIENT = """
import sys
from pancakes_ros2.keeper_pipe import *
out = PipeWriter(1)
orders = sys.stdin.buffer
assert next(read_all(orders, Setup)).device == "pose"
out.put(Ready())
for order in read_all(orders, Command | Again | Hold):
    out.put(Status("t", 1, "running", f"{type(order).__name__} {len(getattr(order, 'fields', None) or '')}"))
"""
STANDS_STILL = """
import signal
from pancakes_ros2.keeper_pipe import *
PipeWriter(1).put(Ready())
signal.pause()
"""
NEVER_READY = "import signal; signal.pause()"


@pytest.fixture
def keep(monkeypatch):
    """Returns a device with another program in place of the goal keeper."""
    monkeypatch.setattr(ros_action, "check_possible", lambda agent, virtual: None)
    made = []
    before = set(psutil.Process().children())

    def start(program):
        monkeypatch.setattr(ros_action, "KEEPER", ("-c", program))
        device = RosAction(DriverContext(), make_settings(RosAction.Settings, {"action": "a/B", "name": "go"}))
        made.append(device)
        return device

    yield start
    for device in made:
        device.close()
    for process in set(psutil.Process().children()) - before:
        process.kill()


def heard(context, count):
    """Lets time pass until the keeper has said so much; returns that."""
    while len(context.sent) < count:
        context.run_until(context.time_s + 0.01)
    return [status.text for _, status, _ in context.sent]


def test_a_long_goal_goes_through_the_pipe_once_and_a_hold_comes_after_it(keep):
    device = keep(OBEDIENT)
    device.open()
    goal = Goal(1, {f"pose{number}": "x" * 100 for number in range(8000)})
    device.write(goal, 0.5, "t")
    device.safe_stop()
    assert heard(device.context, 2) == ["Command 8000", "Hold 0"], "though nothing is commanded after it"
    for _ in range(100):
        device.write(goal, 0.5, "t")
    device.write(Goal(1, None), 0.5, "t")
    assert heard(device.context, 103)[2:] == ["Again 0"] * 100 + ["Command 0"]


@pytest.mark.parametrize(
    ("value", "why"),
    [
        ("x" * MOST_BACKLOG, rf"it has \d+ bytes, and at most {MOST_BACKLOG} are taken"),
        (2**70, "it cannot be told to the goal keeper: .*"),
    ],
    ids=["long", "no number"],
)
def test_a_goal_that_the_keeper_cannot_be_told_is_refused(keep, value, why):
    device = keep(OBEDIENT)
    device.open()
    device.write(Goal(2, {"order": value}), 0.5, "t")
    ((channel, status, _),) = device.context.sent
    assert (channel, status.task, status.number, status.state) == (SYSTEM, "t", 2, "refused")
    assert re.fullmatch(why, status.text)
    assert heard(device.context, 2)[1] == "Hold 0"


def test_a_keeper_that_does_not_start_is_killed(keep, monkeypatch):
    monkeypatch.setattr(ros_action, "STARTS_WITHIN_S", 0.1)
    before = set(psutil.Process().children())
    device = keep(NEVER_READY)
    with pytest.raises(PancakesError, match=r"the goal keeper of go has not started within 0\.1 s"):
        device.open()
    _, alive = psutil.wait_procs(set(psutil.Process().children()) - before, timeout=20.0)
    assert not alive


def test_a_keeper_that_stands_still_is_killed_and_its_device_fails(keep, monkeypatch):
    monkeypatch.setattr(ros_action, "LOOK_S", 0.01)
    device = keep(STANDS_STILL)
    device.open()
    with pytest.raises(PancakesError, match="the goal keeper of go has ended with exit code -9"):
        while True:
            device.context.run_until(device.context.time_s + 0.01)
    assert device.context.lines == [("warning", "the goal keeper of go stands still, and is killed")]


def test_a_keeper_without_ros_2_says_so_and_ends_in_good_order():
    """Here is no ROS 2. Its input stays open, and a thread of it reads from there."""
    path = os.pathsep.join(sys.path)
    process = subprocess.Popen(
        [sys.executable, *ros_action.KEEPER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert process.stdin and process.stdout and process.stderr
    PipeWriter(process.stdin.fileno()).put(Setup("one", "nav", "a/action/B", "go", 10.0))
    (failure,) = read_all(process.stdout, Ready | Warned | Failure)
    assert "ROS 2 does not start: No module named 'rclpy'" in failure.text
    assert process.wait() == 0, process.stderr.read()
    for stream in (process.stdin, process.stdout, process.stderr):
        stream.close()


# The pipe --------------------------------------------------------------------------------------------------------


@pytest.fixture
def pipe():
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as stream, os.fdopen(writing, "wb", buffering=0) as end:
        yield stream, end


def test_what_goes_into_the_pipe_comes_out_until_it_is_closed(pipe):
    stream, end = pipe
    orders = [
        Command("one/client/Go", 1, {"x": float("inf"), "data": b"\x00"}, 2.5),
        Hold(),
        Command("t", 2, None, 1.0),
    ]
    out = PipeWriter(end.fileno())
    assert all(out.put(order) for order in orders)
    os.write(end.fileno(), b"\x00\x00\x00\x10torn")
    end.close()
    assert list(read_all(stream, Command | Hold)) == orders


def test_one_who_does_not_read_keeps_nobody_waiting(pipe):
    stream, end = pipe
    out = PipeWriter(end.fileno())
    order = Command("t", 1, {"text": "x" * 1000}, 0.0)
    taken = 0
    while out.put(order):
        taken += 1
        assert taken * 1000 < 2 * MOST_BACKLOG
    reader = read_all(stream, Command)
    assert next(reader) == order
    for _ in range(taken - 1):
        out.flush()
        assert next(reader) == order
    assert out.put(order), "there is room again"


def test_one_who_is_gone_is_an_error(pipe):
    stream, end = pipe
    stream.close()
    with pytest.raises(OSError, match="Broken pipe"):
        PipeWriter(end.fileno()).put(Hold())
