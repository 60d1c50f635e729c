"""Goals of tasks at action servers of another release, and calls of its services.

The servers are processes that know nothing of Pancakes; a robot says when it begins and ends to move.
"""

import json
import signal
import subprocess
import time

import psutil
import pytest
from pancakes_ros2.keeper_pipe import Command, PipeWriter, Ready, Setup, read_all
from ros2.environments import AGENTS, environment, python_of
from ros2.ros_rig import RosPeer

from pancakes.client import Client
from pancakes.control import Configure, Migrate, Stop

FIBONACCI = "test_msgs/action/Fibonacci"
NAV = """
[device.nav]
driver = "ros2.action"
settings = { action = "test_msgs/action/Fibonacci", name = "go" }
"""
LONG, SHORT = 2000, 5
STARTS_A_KEEPER = """
import subprocess, sys
subprocess.run([sys.executable, "-m", "pancakes_ros2.goal_keeper"])
"""


def errand(*orders, nav=NAV):
    goals = ", ".join(f"'{json.dumps(it if isinstance(it, dict) else {'order': it})}'" for it in orders)
    return f'{nav}[task.Errand]\ntype = "goals.Errand"\nsettings = {{ goals = [{goals}] }}\n'


def begins(peer, agent="agent1"):
    return peer.told.wait(lambda line: line.get("begins") == f"/{agent}/go")


def ends(peer, agent="agent1"):
    return peer.told.wait(lambda line: line.get("ends") == f"/{agent}/go")


def count(peer, what, agent="agent1"):
    return sum(line.get(what) == f"/{agent}/go" for line in peer.told.all)


@pytest.fixture
def serve(domain, domains):
    """Starts robots with an action server, each a process."""
    made = []

    def start(agent="agent1", **order):
        robot = RosPeer(domain, f"robot_{agent}")
        made.append(robot)
        robot.order("serve", action=f"/{agent}/go", type=FIBONACCI, **order)
        robot.told.wait(lambda line: "serves" in line)
        return robot

    yield start
    for robot in made:
        robot.close()


def test_a_goal_is_sent_once_and_the_task_hears_feedback_and_result(start_agent, serve):
    robot = serve()
    agent = start_agent("agent1", errand(20, SHORT))
    agent.wait_for_line("goal_goes_on")
    agent.wait_for_line("goal_ended number=1 state=succeeded")
    agent.wait_for_line("goal_ended number=2 state=succeeded result={'sequence': [1, 2, 3, 4, 5]}")
    assert ends(robot)["state"] == "succeeded"
    assert ends(robot)["steps"] == SHORT
    assert count(robot, "begins") == 2


def test_a_task_cancels_its_goal_and_hears_that_it_has_ended(start_agent, serve):
    robot = serve()
    agent = start_agent("agent1", errand(LONG))
    begins(robot)
    with Client() as client:
        assert client.request("agent1", Configure("Errand", {"cancel": True})).ok
    assert ends(robot)["state"] == "canceled"
    agent.wait_for_line("goal_ended number=1 state=canceled")


def test_a_goal_moves_with_its_task_and_ends_on_the_robot_that_it_leaves(start_agent, serve):
    first, second = serve(), serve("agent2")
    start_agent("agent1", errand(100))
    agent2 = start_agent("agent2", 'peers = ["local://agent1"]\n' + NAV)
    begins(first)
    with Client() as client:
        assert client.request("agent1", Migrate("Errand", to="agent2")).ok
    assert ends(first)["state"] == "canceled"
    begins(second, "agent2")
    assert ends(second, "agent2")["state"] == "succeeded"
    agent2.wait_for_line("goal_ended number=1 state=succeeded")
    assert (count(first, "begins"), count(second, "begins", "agent2")) == (1, 1)


def test_a_goal_ends_when_its_task_is_stopped(start_agent, serve):
    robot = serve()
    start_agent("agent1", errand(LONG))
    begins(robot)
    with Client() as client:
        assert client.request("agent1", Stop("Errand")).ok
    assert ends(robot)["state"] == "canceled"


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM], ids=lambda it: it.name)
def test_a_goal_ends_when_its_agent_does_or_stands_still(start_agent, serve, how):
    robot = serve()
    agent = start_agent("agent1", errand(LONG))
    began = begins(robot)
    keepers = psutil.Process(agent.process.pid).children()
    agent.process.send_signal(how)
    ended = ends(robot)
    assert ended["state"] == "canceled"
    assert ended["steps"] < LONG // 10, f"it went on for {ended['at_s'] - began['at_s']} s"
    agent.process.send_signal(signal.SIGCONT)
    if how != signal.SIGSTOP:
        _, alive = psutil.wait_procs(keepers, timeout=20.0)
        assert not alive
    else:
        assert begins(robot), "an agent that goes on has its goal reached"


def test_all_processes_of_an_agent_are_killed_and_the_next_life_ends_what_they_left(start_agent, serve):
    robot = serve()
    agent = start_agent("agent1", errand(LONG))
    left = begins(robot)["id"]
    for process in [*psutil.Process(agent.process.pid).children(), agent.process]:
        process.kill()
    agent.process.wait()
    start_agent("agent1", NAV)
    ended = ends(robot)
    assert (ended["id"], ended["state"]) == (left, "canceled")


def test_a_keeper_that_is_killed_is_replaced_and_the_goal_begins_again(start_agent, serve):
    robot = serve()
    agent = start_agent("agent1", errand(100))
    left = begins(robot)["id"]
    (keeper,) = psutil.Process(agent.process.pid).children()
    keeper.kill()
    ended = ends(robot)
    assert (ended["id"], ended["state"]) == (left, "canceled")
    agent.wait_for_line("the goal keeper of go has ended with exit code -9")
    assert begins(robot)["at_work"] == 0
    agent.wait_for_line("goal_ended number=1 state=succeeded")


def test_a_keeper_whose_agent_is_gone_ends_the_goal_although_its_pipe_is_open(serve, domain):
    """A process that the agent forked may have its end of the pipe."""
    robot = serve()
    agent = subprocess.Popen(
        [python_of(AGENTS), "-c", STARTS_A_KEEPER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment(domain),
    )
    assert agent.stdin and agent.stdout
    with agent.stdin, agent.stdout:
        out = PipeWriter(agent.stdin.fileno())
        out.put(Setup("agent1", "nav", FIBONACCI, "go", 10.0))
        assert isinstance(next(read_all(agent.stdout, Ready)), Ready)
        out.put(Command("agent1/client/Errand", 1, {"order": LONG}, time.monotonic() + 3600.0))
        begins(robot)
        (keeper,) = psutil.Process(agent.pid).children()
        agent.kill()
        agent.wait()
        assert ends(robot)["state"] == "canceled"
        _, alive = psutil.wait_procs([keeper], timeout=20.0)
        assert not alive


# What goes wrong -------------------------------------------------------------------------------------------------


def test_what_is_wrong_with_a_goal_or_a_server_is_one_sentence(start_agent, serve):
    """Each device has its own trouble; their agents are independent of each other."""
    agents = {}
    for name, goal, nav in (
        ("nobody", SHORT, NAV),
        ("another", SHORT, NAV.replace("Fibonacci", "NestedMessage").replace('"go"', '"/refuses/go"')),
        ("refuses", SHORT, NAV),
        ("fields", {"order": "a lot", "more": 1}, NAV.replace('"go"', '"/refuses/go"')),
        ("unknown", {"more": 1}, NAV.replace('"go"', '"/refuses/go"')),
        ("fails", SHORT, NAV),
        ("absent", SHORT, NAV.replace("test_msgs/action/Fibonacci", "nav2_msgs/action/NavigateToPose")),
        ("missing", SHORT, NAV.replace("Fibonacci", "Navigate")),
    ):
        if name in ("refuses", "fails"):
            serve(name, **{name: True})
        agents[name] = start_agent(name, errand(goal, nav=nav))
    for name, text in {
        "nobody": "there is no action server /nobody/go: start it, or name the one that the robot has",
        "another": f"the action server /refuses/go has the type {FIBONACCI}, not test_msgs/action/NestedMessage",
        "refuses": "state=refused result=None why=the server of /refuses/go refuses it",
        "fields": f"state=refused result=None why=it is no goal of {FIBONACCI}: 'a lot' does not fit the field 'order'",
        "unknown": f"state=refused result=None why=it is no goal of {FIBONACCI}: the message has no field 'more'",
        "fails": "goal_ended number=1 state=aborted result={'sequence': [1]}",
        "absent": "there is no action type nav2_msgs/action/NavigateToPose: the package nav2_msgs is not installed:"
        " install it, or source the workspace that has it",
        "missing": "there is no action type test_msgs/action/Navigate: test_msgs of this ROS 2 has no action Navigate",
    }.items():
        agents[name].wait_for_line(text, timeout_s=60.0)


def test_a_server_that_does_not_cancel_is_named_and_gets_no_other_goal(start_agent, serve):
    robot = serve(keeps_on=True)
    agent = start_agent("agent1", errand(200, SHORT))
    begins(robot)
    with Client() as client:
        assert client.request("agent1", Configure("Errand", {"cancel": True})).ok
    agent.wait_for_line("the server of /agent1/go does not end a goal that was cancelled: the robot may still move")
    assert ends(robot)["state"] == "succeeded"
    agent.wait_for_line("goal_ended number=1 state=succeeded")
    assert begins(robot)["at_work"] == 0


def test_a_server_that_dies_loses_its_goal(start_agent, serve):
    robot = serve()
    agent = start_agent("agent1", errand(LONG))
    begins(robot)
    robot.close()
    agent.wait_for_line("goal_ended number=1 state=lost result=None why=the server of /agent1/go is gone", 60.0)


# Services --------------------------------------------------------------------------------------------------------

CALLS = """
[device.{name}]
driver = "ros2.service"
settings = {{ service = "test_msgs/srv/BasicTypes", name = "/{name}", timeout_s = 3.0 }}
[task.Caller]
type = "goals.Caller"
settings = {{ calls = {calls} }}
"""


def test_a_service_is_called_once_and_answers(start_agent, peer):
    peer.order("echo", service="/echo", type="test_msgs/srv/BasicTypes")
    agent = start_agent("agent1", CALLS.format(name="echo", calls="""['{"int32_value": 7}', '{"int32_value": "x"}']"""))
    assert peer.told.wait(lambda line: line.get("called") == "/echo")["fields"]["int32_value"] == 7
    agent.wait_for_line("call_answered number=1 response={'bool_value': False")
    agent.wait_for_line("call_answered number=2 response=None why=it is no call of test_msgs/srv/BasicTypes: 'x' does")


def test_a_service_that_is_not_there_or_does_not_answer_is_an_error(start_agent, peer):
    peer.order("echo", service="/mute", type="test_msgs/srv/BasicTypes", never=True)
    mute = start_agent("agent1", CALLS.format(name="mute", calls="['{}']"))
    none = start_agent("agent2", CALLS.format(name="none", calls="['{}']"))
    mute.wait_for_line("why=the service /mute has not answered within 3 s; whether the call had an effect is not known")
    none.wait_for_line("why=there is no service /none: start it, or name the one that the robot has")
