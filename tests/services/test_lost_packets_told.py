"""A packet that was for somebody and that nobody got is told at its publisher, with the name that was meant."""

import pytest

from pancakes.control import Describe, Stop
from pancakes.devices import Pose, Twist
from pancakes.devices.builtin_drivers import NullMotors
from pancakes.packet import CTRL, SYSCTRL, SYSTEM, task_address
from pancakes.task import Task, on
from pancakes.testing import Fleet


class Steer(Task):
    requires = ("motors",)


class Reader(Task):
    @on(SYSTEM, Pose, addressed=True)
    def pose(self, packet):
        pass


POSE = Pose(0.0, 0.0, 0.0)


@pytest.fixture
def fleet():
    with Fleet(5) as made:
        made.start("agent1", tasks={"Reader": Reader, "Steer": Steer}, devices={"motors": NullMotors})
        made.start("agent2", tasks={"Reader": Reader})
        made.connect()
        yield made


def lost(fleet, name="agent1"):
    return [line.partition(" is lost: ")[2] for line in fleet.agents[name].lines("warning") if " is lost: " in line]


@pytest.mark.parametrize(
    ("to", "said"),
    [
        ("agnt2", "no agent 'agnt2' was ever linked, did you mean 'agent2'?"),
        ("agnt2/client/Reader", "no agent 'agnt2' was ever linked, did you mean 'agent2'?"),
        ("somebody", "no agent 'somebody' was ever linked; linked are agent2"),
        ("agent1/client/Raeder", "agent1 has no 'agent1/client/Raeder', did you mean 'agent1/client/Reader'?"),
        ("agent1/client/Steer", "agent1/client/Steer does not read 'pose' on 'system'"),
    ],
)
def test_a_destination_that_nobody_is_at_is_told_once(fleet, to, said):
    agent = fleet.agents["agent1"]
    for _ in range(3):
        agent.task("Reader").publish(SYSTEM, POSE, to=to)
    fleet.run_for(0.1)
    assert lost(fleet) == [said]


def test_another_agent_tells_of_what_reaches_nobody_there(fleet):
    for name in ("Raeder", "Other"):  # of another agent it tells only one in a while
        fleet.agents["agent1"].task("Reader").publish(SYSTEM, POSE, to=f"agent2/client/{name}")
    fleet.run_for(0.1)
    assert lost(fleet, "agent2") == ["agent2 has no 'agent2/client/Raeder', did you mean 'agent2/client/Reader'?"]


@pytest.mark.parametrize("body", [("fast", 0.0), (float("nan"), 0.0), (0.1, None)])
def test_a_command_with_a_bad_field_is_told_with_its_sender(fleet, body):
    fleet.agents["agent1"].task("Steer").publish(CTRL, Twist(*body))
    fleet.run_for(0.1)
    (line,) = [line for line in fleet.agents["agent1"].lines("warning") if "refused a command" in line]
    assert "agent1/client/Steer" in line


def test_what_is_lost_without_a_mistake_is_not_told(fleet):
    agent = fleet.agents["agent1"]
    reader = agent.task("Reader")
    reader.publish(SYSTEM, POSE)  # for whoever reads it
    reader.publish(SYSCTRL, Describe())  # its answer has no handler
    assert agent.ask(Stop("Steer")).ok
    reader.publish(SYSTEM, POSE, to="agent1/client/Steer")  # stopped
    fleet.stop("agent2")
    assert fleet.run_until(lambda: not agent.agent.mesh.connected())
    reader.publish(SYSTEM, POSE, to="agent2/client/Reader")  # away
    fleet.run_for(0.1)
    assert lost(fleet) == []


@pytest.mark.parametrize(
    ("to", "said"),
    [
        ("agnt2/Reader", "no agent that is linked has that task, did you mean 'agent2/Reader'?"),
        ("agent2/Ghost", "no agent that is linked has that task"),
        ("agent1/Raeder", "no agent that is linked has that task, did you mean 'agent1/Reader'?"),
    ],
)
def test_a_packet_for_a_task_that_no_agent_has_is_told_once(fleet, to, said):
    agent = fleet.agents["agent1"]
    agent.task("Steer").publish(SYSTEM, POSE, to=task_address(to))
    agent.task("Steer").publish(SYSTEM, POSE, to=task_address("agent2/Reader"))
    fleet.run_for(60.0)
    assert [line for line in agent.lines("warning") if " wait: " in line] == [f"packets for {to} wait: {said}"]
