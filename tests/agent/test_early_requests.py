"""What is asked of an agent whose network does not run yet is answered once it does."""

from pancakes.control import Describe, Reply
from pancakes.packet import SYSCTRL, Packet
from pancakes.simulation.fleet import config_of


def test_request_before_the_network_runs_is_answered(fleet):
    a = fleet.start_config(config_of("a"), settle=False)
    asked = Packet(SYSCTRL, "describe", a.probe.address, "a", 0.0, 7, Describe())
    a.agent.receive("b", [asked], 100)
    assert not a.agent.ready.is_set()
    reply = a.wait_for(Reply, lambda reply: reply.result is not None, channel=SYSCTRL)
    assert reply.cause == (a.probe.address, 7) and reply.body.result["agent"] == "a"
