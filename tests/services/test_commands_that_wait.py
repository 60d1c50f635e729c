"""A command that waits for the one before it is answered too where its service ends first: nobody waits for ever."""

import pytest

from pancakes.control import Describe, Reply, Restart, Start, Stop
from pancakes.devices import Pose
from pancakes.durable.client_service import ClientService
from pancakes.kernel.handlers import on
from pancakes.task import Task
from pancakes.testing import AgentHandle, Fleet


class Count(Task):
    """Does nothing; it is only started and stopped."""


class Fragile(ClientService):
    """A service that fails when it sees a pose."""

    @on("system", Pose)
    def pose(self, packet):
        raise RuntimeError("no map")


def replies(agent: AgentHandle, *bodies: object) -> list[str]:
    """Asks for several things at once; returns what each was refused for, an empty string where it was done."""
    asked = [agent.publish("sysctrl", body) for body in bodies]
    return [agent.reply_to(packet).reason for packet in asked]


def test_where_their_service_is_stopped():
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Count": Count})

        reasons = replies(agent, Stop("Count"), Start("Count"), Restart("Count"), Stop("client/"))

        assert reasons[0] == reasons[3] == ""
        assert all("its service stops" in reason or "was stopped before it" in reason for reason in reasons[1:3])
        assert agent.ask(Start("client/")).ok
        assert agent.running() == []
        assert agent.ask(Start("Count")).ok


@pytest.mark.parametrize(
    ("heard", "reason"),
    [
        (True, "a/fragile failed before it had done that: RuntimeError: no map"),
        (False, ("a/fragile ended before it came to that", "a/fragile is restarting, and Count with it")),
    ],
)
def test_where_their_service_fails(heard: bool, reason: str):
    with Fleet() as fleet:
        agent = fleet.start("a", services={"fragile": Fragile}, tasks={"Count": {"type": Count, "service": "fragile"}})
        asked = [agent.publish("sysctrl", body) for body in (Stop("Count"), Start("Count"))]
        if heard:
            agent.wait_for_event("asked", what="stop")
        agent.publish("system", Pose(0.0, 0.0, 0.0))

        reasons = [agent.reply_to(packet).reason for packet in asked]

        assert reasons[1].startswith(reason)
        agent.wait_until(lambda: len(agent.events("service_started", service="fragile")) == 2)
        assert agent.ask(Restart("Count")).ok


def test_more_than_there_is_room_for_is_refused_and_not_forgotten():
    with Fleet() as fleet:
        agent = fleet.start("a", tasks={"Count": Count})
        other = fleet.start("b")
        fleet.connect()
        asked = [other.publish("sysctrl", Describe("Count"), to="a") for _ in range(3000)]

        replies = [other.reply_to(packet) for packet in asked[::100]]
        fleet.run_until(lambda: len(other.probe.packets(Reply)) >= len(asked))

        found = [packet.body for packet in other.probe.packets(Reply)]
        assert len(found) == len(asked)
        assert len({reply.number for reply in found}) == len(asked)
        refused = [reply.reason for reply in found if not reply.ok]
        assert all("has no room for" in it or "sends more than 1000 requests in a second" in it for it in refused)
        assert any(reply.ok for reply in replies)
        assert agent.ask(Describe("Count")).ok


def test_what_became_of_a_command_that_was_put_off_is_told_and_a_failure_is_a_warning():
    with Fleet() as fleet:
        tasks = {name: {"type": Count, "service": "fragile", "start": False} for name in ("One", "Two")}
        agent = fleet.start("a", services={"fragile": Fragile}, tasks=tasks)
        agent.may_fail.add("fragile")

        end = fleet.faults.fill_disk("a")
        assert "what was asked for waits: " in agent.ask(Start("One")).reason
        end()
        fleet.run_for(5.0)
        assert "what a/test/Probe asked for (#1) is done" in agent.lines("info")

        fleet.faults.fill_disk("a")
        assert "what was asked for waits: " in agent.ask(Start("Two")).reason
        agent.publish("system", Pose(0.0, 0.0, 0.0))
        fleet.run_for(0.1)
        why = "a/fragile failed before it had done that: RuntimeError: no map"
        lines = agent.lines("warning")
        assert any(it.startswith(f"what a/test/Probe asked for (#2) was not done: {why}") for it in lines)
