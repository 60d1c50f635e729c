"""Who follows a channel gets each packet at once, or the newest of each source and type so many times a second."""

import math

import pytest

from pancakes.control import Follow, Unfollow
from pancakes.devices import Load, Pose
from pancakes.packet import NEIGHBOURS, Packet
from pancakes.services.network import LEAST_HZ, SOON_S
from pancakes.testing import Fleet


@pytest.fixture
def fleet():
    with Fleet(1) as made:
        made.start("b")
        made.start("a")
        made.connect()
        yield made


def loads(agent):
    return [packet.body.cpu for packet in agent.probe.packets(Load)]


def test_nothing_leaves_in_the_turn_of_the_publisher_and_all_that_waits_leaves_at_once(fleet):
    a, b = fleet.agents["a"], fleet.agents["b"]
    assert a.ask(Follow("system", most_hz=10.0), to="b").ok
    b.publish("system", Load(0.1))
    b.publish("system", Pose(0.0, 0.0, 0.0))
    b.publish("system", Load(0.2))
    assert SOON_S == 0.0075  # between two ticks of 5 ms
    fleet.run_for(SOON_S - 0.001)
    assert loads(a) == [] and a.probe.packets(Pose) == []
    fleet.run_for(0.002)
    assert loads(a) == [0.2] and len(a.probe.packets(Pose)) == 1
    came = [packet.seq for packet in a.probe.packets() if packet.type in ("load", "pose")]
    assert came == sorted(came), "in the order in which they were published"


def test_where_no_rate_is_set_all_that_is_published_at_one_moment_arrive(fleet):
    a, b = fleet.agents["a"], fleet.agents["b"]
    assert a.ask(Follow("system"), to="b").ok
    for number in range(3):
        b.publish("system", Load(number / 10))
    fleet.run_for(0.1)
    assert loads(a) == [0.0, 0.1, 0.2]


def test_the_last_of_what_was_published_arrives_also_where_nothing_follows(fleet):
    a, b = fleet.agents["a"], fleet.agents["b"]
    assert a.ask(Follow("system", most_hz=2.0), to="b").ok
    for number in range(3):
        b.publish("system", Load(number / 10))
        fleet.run_for(0.1)
    assert loads(a) == [0.0]
    fleet.run_for(10.0)
    assert loads(a) == [0.0, 0.2]


@pytest.mark.parametrize("most_hz", [0.5, 10.0, 1000.0])
def test_no_more_come_than_were_asked_for(fleet, most_hz):
    a, b = fleet.agents["a"], fleet.agents["b"]
    assert a.ask(Follow("system", most_hz=most_hz), to="b").ok
    count = 400
    for number in range(count):
        b.publish("system", Load(number / count))
        fleet.run_for(0.01)
    fleet.run_for(5.0)
    wanted = min(count, 0.01 * count * most_hz)
    assert wanted <= len(loads(a)) <= wanted + 1
    assert loads(a)[-1] == (count - 1) / count


@pytest.mark.parametrize("most_hz", [5e-324, LEAST_HZ / 2, -0.5, -1.0, math.inf, math.nan])
def test_a_rate_that_is_none_is_refused_and_nobody_who_publishes_suffers(fleet, most_hz):
    a, b = fleet.agents["a"], fleet.agents["b"]
    reply = a.ask(Follow("system", most_hz=most_hz), to="b")
    assert not reply.ok and "most_hz must be 0 (all), or 0.001 or more a second" in reply.reason
    b.publish("system", Load(0.1))
    fleet.run_for(1.0)
    assert loads(a) == []


def test_of_very_many_sources_only_so_many_wait(fleet):
    a, b = fleet.agents["a"], fleet.agents["b"]
    assert a.ask(Follow("system", most_hz=2.0), to="b").ok
    for number in range(4101):
        b.kernel.stream.publish(Packet("system", "load", f"b/client/T{number}", "", fleet.now(), 1, Load(number)))
    fleet.run_for(2.0)
    assert loads(a) == list(range(4096))


def test_what_came_from_elsewhere_is_not_sent_on(fleet):
    a = fleet.agents["a"]
    c = fleet.start("c")
    fleet.connect()
    assert a.ask(Follow("system"), to="b").ok
    c.publish("system", Load(0.5), to=NEIGHBOURS)
    fleet.run_for(2.0)
    assert loads(a) == [0.5] and a.lines("warning") == []


def test_who_follows_no_more_gets_nothing_of_what_waits(fleet):
    a, b = fleet.agents["a"], fleet.agents["b"]
    assert a.ask(Follow("system", most_hz=0.1), to="b").ok
    b.publish("system", Load(0.1))
    fleet.run_for(0.1)
    b.publish("system", Load(0.2))
    assert a.ask(Unfollow("system"), to="b").ok
    fleet.run_for(20.0)
    assert loads(a) == [0.1]
    assert b.kernel.stream.followers("system") == []


def test_an_agent_that_has_gone_follows_no_more_and_others_go_on(fleet):
    a, b, c = fleet.agents["a"], fleet.agents["b"], fleet.start("c")
    fleet.connect()
    for agent in (a, c):
        assert agent.ask(Follow("system"), to="b").ok
    fleet.crash("a")
    assert fleet.run_until(lambda: "a" not in b.agent.mesh.neighbours())
    fleet.run_for(0.1)
    assert b.kernel.stream.followers("system") == [c.probe.address]
    b.publish("system", Load(0.1))
    fleet.run_for(0.1)
    assert loads(c) == [0.1]


def test_of_a_fast_rate_the_first_packet_waits_no_longer_than_a_quarter_of_its_period(fleet):
    a, b = fleet.agents["a"], fleet.agents["b"]
    assert a.ask(Follow("system", most_hz=100.0), to="b").ok
    b.publish("system", Load(0.1))
    fleet.run_for(0.002)
    assert loads(a) == []
    fleet.run_for(0.001)
    assert loads(a) == [0.1]
