"""What a test may let go wrong between the agents of a fleet."""

from __future__ import annotations

import pytest

from pancakes.control import Describe
from pancakes.devices import Load
from pancakes.events import Event
from pancakes.packet import NEIGHBOURS
from pancakes.task import Task, every
from pancakes.testing import Fleet, assert_published


class Count(Task):
    """Count aloud, once a second, from 1."""

    @every(hz=1)
    def count(self, tick):
        self.publish("system", Load(round(tick.time_s)), to=NEIGHBOURS)


@pytest.fixture
def pair(fleet: Fleet):
    """Two agents with a link, of which the first counts aloud."""
    a = fleet.start("a")
    b = fleet.start("b")
    fleet.connect()
    return a, b


def count(fleet: Fleet, name: str = "counter", for_s: float = 20.5) -> list[float]:
    """Let a third agent count, and returns what `b` heard of it."""
    fleet.start(name, tasks={"Count": Count})
    fleet.connect()
    fleet.agents["b"].probe.forget()
    fleet.run_for(for_s)
    return [packet.body.cpu for packet in fleet.agents["b"].probe.packets(Load, source=f"{name}/client/Count")]


def test_where_nothing_goes_wrong_everything_comes_once(fleet, pair):
    heard = count(fleet)
    assert len(heard) in (20, 21)
    assert heard == sorted(set(heard))


def test_packets_are_lost_until_that_ends(fleet, pair):
    end = fleet.faults.lose(1.0, Load, source="counter", at="b")
    assert count(fleet) == []
    assert len(fleet.agents["a"].probe.packets(Load)) >= 20, "only what comes to b is lost"
    end()
    end()
    fleet.run_for(5.0)
    assert_published(fleet.agents["b"], Load, times=5)


def test_calm_ends_losses_too(fleet, pair):
    fleet.faults.lose(1.0)
    fleet.faults.double(1.0)
    fleet.faults.calm()
    assert len(count(fleet)) in (20, 21)


def test_a_share_of_them_is_lost_and_the_seed_draws_which(fleet, pair):
    fleet.faults.lose(0.5, at="b")
    heard = count(fleet, for_s=200.0)
    assert 60 < len(heard) < 140

    with Fleet(fleet.seed) as again:
        again.start("a")
        again.start("b")
        again.connect()
        again.faults.lose(0.5, at="b")
        assert count(again, for_s=200.0) == heard


def test_packets_come_twice(fleet, pair):
    fleet.faults.double(1.0, Load)
    heard = count(fleet)
    assert heard[::2] == heard[1::2]
    assert len(heard) >= 40


def test_other_types_sources_and_channels_are_spared(fleet, pair):
    fleet.faults.lose(1.0, Event)
    fleet.faults.lose(1.0, source="count")
    fleet.faults.lose(1.0, channel="ctrl")
    fleet.faults.lose(1.0, at="a")
    assert len(count(fleet)) >= 20


def test_what_agents_say_to_keep_themselves_in_order_is_spared(fleet, pair):
    a, _ = pair
    fleet.faults.lose(1.0)
    assert a.ask(Describe(), to="b").ok


def test_a_delay_holds_for_two_agents_only(fleet, pair):
    fleet.faults.delay("counter", "b", 0.75, jitter_s=0.1)
    fleet.faults.slow("counter", "b", 100_000.0)
    quality = fleet.network.quality("b", "counter")
    assert (quality.latency_s, quality.jitter_s, quality.bytes_per_s) == (0.75, 0.1, 100_000.0)
    assert fleet.network.quality("a", "b").latency_s < 0.01
    fleet.faults.calm()
    assert fleet.network.quality("b", "counter") == fleet.network.quality("a", "b")


def test_agents_that_are_cut_off_meet_again(fleet, pair):
    a, b = pair
    fleet.faults.cut("a", for_s=30.0)
    fleet.run_for(20.0)
    assert a.events("peer_down", peer="b")
    assert b.events("peer_down", peer="a")
    fleet.run_until(lambda: fleet.now() > 30.0)
    fleet.connect(timeout_s=60.0)


def test_a_cut_without_an_end_ends_with_calm(fleet, pair):
    fleet.faults.cut("a", off=("b",))
    assert fleet.network.parted("a", "b")
    assert not fleet.network.parted("a", "c")
    fleet.faults.calm()
    assert not fleet.network.parted("a", "b")


def test_links_break_and_come_again(fleet, pair):
    a, _ = pair
    fleet.faults.break_link("a", "b")
    a.wait_for_event("peer_down", peer="b")
    fleet.connect()

    downs = len(a.events("peer_down"))
    fleet.faults.break_links(3, within_s=60.0)
    fleet.run_for(70.0)
    assert len(a.events("peer_down")) == downs + 3
    fleet.connect()


def test_a_share_is_a_share(fleet):
    with pytest.raises(ValueError, match=r"1\.5 is no share of packets: it must be from 0 to 1"):
        fleet.faults.lose(1.5)
