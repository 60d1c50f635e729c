"""The network in virtual time: delay, loss and partitions, exactly when they were asked for."""

from __future__ import annotations

import random

import pytest

from pancakes.mesh.memory_network import MemoryNetwork, Quality


def join(rig, a="a", b="b", address="tcp://b:1"):
    here, there = rig.ear(), rig.ear()
    rig.transport(b).listen(address, lambda: there)
    rig.transport(a).dial(address, here)
    rig.until(lambda: here.connection and there.connection)
    return here, there


def arrivals(rig, ear):
    """Writes down when bytes come in."""
    times = []
    keep = ear.received

    def received(data: bytes) -> None:
        times.append(round(rig.clock.now(), 6))
        keep(data)

    ear.received = received
    return times


def test_bytes_take_their_latency(memory_rig):
    memory_rig.network.set_quality("b", "a", Quality(latency_s=0.25))
    here, there = join(memory_rig)
    times = arrivals(memory_rig, there)
    memory_rig.timeline.run_until(1.0)
    here.connection.send(b"x")
    memory_rig.timeline.run_until(2.0)
    assert times == [1.25]


def test_a_port_that_is_left_to_the_system_is_the_first_that_is_free_as_on_linux(memory_rig):
    transport = memory_rig.transport("a")
    ports = [transport.listen("tcp://a:0", memory_rig.ear).rpartition(":")[2] for _ in range(2)]
    assert ports == ["49152", "49153"]


def test_what_is_sent_at_one_time_arrives_at_once(memory_rig):
    here, there = join(memory_rig)
    times = arrivals(memory_rig, there)
    memory_rig.timeline.run_until(1.0)
    here.connection.send(b"one, ")
    here.connection.send(b"two, ")
    memory_rig.timeline.run_until(2.0)
    here.connection.send(b"three")
    memory_rig.timeline.run_until(3.0)
    assert there.data == b"one, two, three"
    assert times == [1.0005, 2.0005]


def test_jitter_delays_but_never_reorders(memory_rig):
    memory_rig.network.set_quality("a", "b", Quality(latency_s=0.01, jitter_s=1.0))
    here, there = join(memory_rig)
    memory_rig.timeline.run_until(10.0)
    times = arrivals(memory_rig, there)
    for number in range(100):
        memory_rig.timeline.run_until(10.0 + number * 0.01)
        here.connection.send(bytes([number]))
    memory_rig.timeline.run_until(20.0)
    assert there.data == bytes(range(100))
    assert times == sorted(times) and len(set(times)) > 3


def test_a_slow_link_trickles_and_says_when_it_has_room(memory_rig):
    memory_rig.network.set_quality("a", "b", Quality(latency_s=0.0, bytes_per_s=1000.0))
    here, there = join(memory_rig)
    times = arrivals(memory_rig, there)
    start_s = memory_rig.clock.now()
    here.connection.send(bytes(500))
    assert here.connection.unsent() == 500
    memory_rig.timeline.run_until(start_s + 0.4999)
    assert here.drains == 0
    memory_rig.timeline.run_until(start_s + 1.0)
    assert (here.drains, here.connection.unsent(), len(there.data)) == (1, 0, 500)
    assert len(times) == 10 and max(times) == pytest.approx(start_s + 0.5)


def test_a_break_loses_what_was_on_its_way_and_is_seen_at_both_ends(memory_rig):
    here, there = join(memory_rig)
    here.connection.send(b"lost")
    memory_rig.network.break_links("b", "a")
    memory_rig.timeline.run_until(1.0)
    assert there.data == b""
    assert here.closed_for == there.closed_for == ["the link between b and a was broken"]


def test_a_silent_break_is_seen_by_nobody_and_swallows_all(memory_rig):
    here, there = join(memory_rig)
    memory_rig.network.break_links("a", "b", at_once=False)
    here.connection.send(b"lost")
    here.connection.close("gave up")
    memory_rig.timeline.run_until(10.0)
    assert (there.data, there.closed_for, here.closed_for) == (b"", [], ["gave up"])


def test_a_partition_begins_and_heals_when_it_was_said_to(memory_rig):
    network = memory_rig.network
    here, there = join(memory_rig)
    network.partition(["a"], ["b", "c"], from_s=5.0, until_s=8.0)
    memory_rig.timeline.run_until(4.9)
    here.connection.send(b"before")
    memory_rig.timeline.run_until(5.1)
    assert network.parted("a", "b") and network.parted("c", "a") and not network.parted("b", "c")
    here.connection.send(b"lost")
    early = memory_rig.ear()
    memory_rig.transport("a").dial("tcp://b:1", early)
    memory_rig.timeline.run_until(20.0)
    assert there.data == b"before"
    assert early.closed_for == ["tcp://b:1 did not answer within 5 s"]
    here.connection.send(b"a stream that lost something is broken for ever")
    again = memory_rig.ear()
    memory_rig.transport("a").dial("tcp://b:1", again)
    memory_rig.timeline.run_until(21.0)
    assert there.data == b"before" and again.connection is not None


def test_a_partition_from_all_others_can_be_healed_early(memory_rig):
    memory_rig.network.partition(["a"])
    assert memory_rig.network.parted("a", "anybody") and not memory_rig.network.parted("x", "y")
    memory_rig.network.heal()
    assert not memory_rig.network.parted("a", "anybody")


def test_a_partition_may_be_seen_at_once(memory_rig):
    here, there = join(memory_rig)
    memory_rig.network.partition(["a"], ["b"], at_once=True)
    memory_rig.timeline.run_until(1.0)
    assert here.closed_for == there.closed_for == ["the network was cut"]


def test_an_exempt_address_takes_part_in_no_fault(memory_rig):
    network = memory_rig.network
    network.exempt("tcp://bus:1")
    network.set_quality("a", "bus", Quality(latency_s=3.0))
    network.partition(["a"])
    here, there = join(memory_rig, b="bus", address="tcp://bus:1")
    network.break_links("a", "bus")
    network.partition(["a"], at_once=True)
    times = arrivals(memory_rig, there)
    memory_rig.timeline.run_until(1.0)
    here.connection.send(b"x")
    memory_rig.timeline.run_until(2.0)
    assert times == [1.0005] and here.closed_for == []


def test_a_closed_transport_is_as_good_as_dead(memory_rig):
    here, _ = join(memory_rig)
    transport = memory_rig.transport("c")
    fired = []
    transport.call_later(1.0, lambda: fired.append(1))
    transport.close()
    memory_rig.timeline.run_until(2.0)
    assert fired == []
    late = memory_rig.ear()
    transport.dial("tcp://b:1", late)
    memory_rig.timeline.run_until(3.0)
    assert late.connection is None and here.closed_for == []


def test_the_same_seed_gives_the_same_jitter(timeline):
    def draws(seed):
        network = MemoryNetwork(timeline.call_at, timeline.clock.now, random.Random(seed))
        return [network.travel_s(Quality(jitter_s=0.1)) for _ in range(5)]

    assert draws(1) == draws(1) != draws(2)


def test_each_end_knows_the_other_by_its_address(memory_rig):
    here, there = join(memory_rig)
    assert (here.connection.remote, there.connection.remote) == ("tcp://b:1", "tcp://a:0")


def test_a_dial_into_a_partition_fails_after_five_seconds(memory_rig):
    memory_rig.network.partition(["a"])
    here = memory_rig.ear()
    memory_rig.transport("b").listen("tcp://b:1", memory_rig.ear)
    memory_rig.transport("a").dial("tcp://b:1", here)
    memory_rig.timeline.run_until(4.999)
    assert here.closed_for == []
    memory_rig.timeline.run_until(5.001)
    assert here.closed_for == ["tcp://b:1 did not answer within 5 s"]


def test_a_partition_has_healed_at_the_time_that_was_named(memory_rig):
    memory_rig.network.partition(["a"], from_s=1.0, until_s=2.0)
    told = []
    for at_s in (0.999, 1.0, 1.999, 2.0):
        memory_rig.timeline.run_until(at_s)
        told.append(memory_rig.network.parted("a", "b"))
    assert told == [False, True, True, False]


def test_nothing_at_all_is_not_sent(memory_rig):
    here, there = join(memory_rig)
    heard = len(there.threads)
    here.connection.send(b"")
    memory_rig.timeline.run_until(1.0)
    assert len(there.threads) == heard
