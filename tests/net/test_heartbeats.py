"""Heartbeats that are not the usual ones."""

from __future__ import annotations

from pancakes.mesh.address import Reach, TransportFacts
from pancakes.mesh.codec import RowEncoder, frame, head_of, run_of
from pancakes.mesh.link import LinkTimes
from pancakes.packet import Packet
from pancakes.testing import Fleet

NEWS = Packet("chat", "words", "a/client/test", "b", 0.0, 1, "news")


def test_agents_with_other_heartbeats_than_their_peers_lose_nobody(memory_rig):
    """The end that expects to hear something sooner asks, and the other answers."""
    a = memory_rig.agent("a", times=LinkTimes(heartbeat_s=0.5))
    b = memory_rig.agent("b", [a.address], times=LinkTimes(heartbeat_s=20.0))
    c = memory_rig.agent("c", [a.address], times=LinkTimes(heartbeat_s=0.5))
    memory_rig.timeline.run_until(120.0)
    assert all(len(each.mesh.connected()) == 2 and each.downs == [] for each in (a, b, c))


def test_where_the_transport_tells_deaths_heartbeats_rest(memory_rig):
    """A peer that says nothing at all is a second look's, after eighty seconds."""
    a = memory_rig.agent("a")
    a.transport.facts = lambda address: TransportFacts(Reach.NETWORK, tells_deaths=True)
    silent = memory_rig.bare_peer("n", a)
    memory_rig.until(lambda: silent.is_up)
    silent.act = lambda actions: None
    began_s = memory_rig.clock.now()
    memory_rig.timeline.run_until(began_s + 75.0)
    assert a.knows("n")
    memory_rig.until(lambda: a.downs)
    assert memory_rig.clock.now() - began_s < 105.0


def test_who_sends_packets_sends_no_heartbeats(memory_rig):
    times = LinkTimes(measure_s=1000.0, first_s=1500.0)
    a = memory_rig.agent("a", times=times)
    b = memory_rig.agent("b", [a.address], times=times)
    memory_rig.timeline.run_until(10.0)

    def bytes_from(time_s):
        before = a.mesh.describe()["peers"][0]["bytes_out"]
        for quarter in range(1, 5):
            a.say("b", "news")
            b.say("a", "news")
            memory_rig.timeline.run_until(time_s + quarter / 4)
        return a.mesh.describe()["peers"][0]["bytes_out"] - before

    head = head_of(NEWS)
    one = len(frame([run_of(head, [RowEncoder(head).encode(NEWS)])]))
    assert [bytes_from(10.0 + second) for second in range(5)] == [4 * one] * 5


def test_the_configuration_says_how_long_a_peer_may_be_silent():
    def gone_after_s(settings):
        with Fleet() as fleet:
            silent = {"network": {"settings": {"discovery_hz": 0.0, **settings}}}
            a = fleet.start("a", services=silent)
            fleet.start("b", services=silent)
            a.wait_for_event("peer_up", peer="b")
            cut_s = fleet.now()
            fleet.network.partition(["a"], ["b"])
            a.wait_for_event("peer_down", timeout_s=100.0, peer="b")
            return fleet.now() - cut_s

    assert 1.0 < gone_after_s({}) <= 2.1
    assert 10.0 < gone_after_s({"heartbeat_s": 5.0}) <= 20.6
