"""The client that all verbs use: one request, one reply from the agent itself."""

from collections.abc import Callable

import pytest
from cli.processes import Rig, Running
from msgspec import Struct

from pancakes.client import Client
from pancakes.client.session import FleetSession, Session
from pancakes.client.subscriptions import Subscription, SubscriptionSpec
from pancakes.control import Describe, Reschedule, Stop
from pancakes.errors import UnreachableError
from pancakes.packet import packet_type

SOIL = """
from dataclasses import dataclass

from pancakes.packet import packet_type
from pancakes.task import Task, every


@packet_type("test.soil")
@dataclass(frozen=True)
class Soil:
    depth_m: float


class Dig(Task):
    @every(hz=50)
    def tick(self, tick):
        self.publish("system", Soil(1.0))
"""
SOIL_ENTRY_POINTS = "[pancakes.tasks]\nsoil.Dig = plugin_soil:Dig\n"
LOAD = '[device.load]\ndriver = "host.load"\nrate_hz = 2\n'


@pytest.fixture
def agent(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> Running:
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(rig.runtime))
    return rig.ready("a", LOAD)


def test_client_request_is_done_and_answered(agent: Running):
    with Client(timeout_s=10.0) as client:
        assert client.request("a", Reschedule("load", rate_hz=20.0)).ok
        assert client.request("a", Describe("load")).result["rate_hz"] == 20.0
        by = agent.hear("rate_changed").partition("by=")[2].split()[0]

        reply = client.request("a", Stop("lode"))
        assert not reply.ok and "did you mean 'load'?" in reply.reason
    assert client.is_own(by)


@packet_type("test.soil")
class Soil(Struct, frozen=True):
    """A packet type whose name is that of the plug-in below, with another field."""

    temperature: str


def test_client_reports_unreadable_packets_once(rig: Rig, agent: Running):
    rig.install("soil", SOIL_ENTRY_POINTS, SOIL)
    rig.ready("b", '[task.Dig]\ntype = "soil.Dig"\n')
    said: list[str] = []
    spec = SubscriptionSpec(channel="system", agents=("b",))
    with Session(timeout_s=10.0) as session, Subscription(session, spec, said.append) as subscription:
        end_s = session.now() + 10.0
        while not said and session.now() < end_s:
            assert subscription.next(session.now() + 0.1) is None
        subscription.next(session.now() + 0.5)
        assert subscription.away() == []
    (sentence,) = said
    assert "cannot be read here" in sentence and "type 'test.soil'" in sentence and "`temperature`" in sentence


def test_client_does_not_wait_for_an_agent_that_dies(
    agent: Running, freeze: Callable[[Running], None], monkeypatch: pytest.MonkeyPatch
):
    send = FleetSession.request

    def request(session: FleetSession, name: str, body: object) -> int:
        number = send(session, name, body)
        agent.process.kill()
        return number

    with Client(timeout_s=60.0) as client:
        client.request("a", Describe())
        freeze(agent)  # so that it cannot answer before it dies
        monkeypatch.setattr(FleetSession, "request", request)
        with pytest.raises(UnreachableError, match="a did not answer: the link to it ended before it answered"):
            client.request("a", Stop("load"))


def test_client_has_a_time_limit_for_each_request(agent: Running, freeze: Callable[[Running], None]):
    with Client(timeout_s=10.0) as client:
        client.request("a", Describe())
        freeze(agent)
        with pytest.raises(UnreachableError, match=r"a did not answer: nothing came within 0\.2 s"):
            client.request("a", Describe(), timeout_s=0.2)
