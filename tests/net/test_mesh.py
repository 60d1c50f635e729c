"""Agents that meet, talk, lose and find each other again: over TCP and in virtual time."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy
import pytest
from net.conftest import RIGS
from net.meetings import pair, raw_hello

from pancakes.devices import Pose
from pancakes.errors import LocalProtocolError, PeerLostError
from pancakes.mesh.codec import MAX_PAYLOAD_BYTES, encode_link_message, frame
from pancakes.mesh.link import LinkTimes
from pancakes.mesh.memory_network import Quality
from pancakes.mesh.sending import Sending
from pancakes.mesh.session import PeerBusy
from pancakes.packet import NEIGHBOURS, Packet


def bodies(who):
    return [packet.body for packet in who.packets]


@pytest.mark.parametrize("rig", RIGS, indirect=True)
def test_mesh_of_two_exchanges_packets_in_order(rig, agent):
    a, b = pair(rig, agent)
    for number in range(500):
        a.say("b", number)
        b.say("a/client/other", -number)
    rig.until(lambda: len(a.packets) == len(b.packets) == 500)
    assert bodies(b) == list(range(500))
    assert bodies(a) == [-number for number in range(500)]
    assert a.ups == ["b"] and b.ups == ["a"]


def test_bodies_arrive_as_what_they_were(rig, agent):
    a, b = pair(rig, agent)
    a.say("b", Pose(1.0, 2.0, 0.5), kind="pose")
    a.say("b", {"map": numpy.arange(6).reshape(2, 3)}, kind="no-such-type")
    rig.until(lambda: len(b.packets) == 2)
    assert b.packets[0].body == Pose(1.0, 2.0, 0.5)
    assert b.packets[1].body["map"].tolist() == [[0, 1, 2], [3, 4, 5]]


def test_a_third_agent_is_found_through_the_second(rig, agent):
    a, b = pair(rig, agent)
    c = agent("c", [b.address])
    rig.until(lambda: a.knows("b", "c") and b.knows("a", "c") and c.knows("a", "b"))
    assert c.say(NEIGHBOURS, "to all") == 2
    rig.until(lambda: a.packets and b.packets)
    assert bodies(a) == bodies(b) == ["to all"]
    assert c.packets == []


def test_links_are_told_by_the_names_of_the_peers_whoever_came_first(rig, agent):
    a = agent("a")
    agent("z", [a.address])
    rig.until(lambda: a.knows("z"))
    agent("b", [a.address])
    rig.until(lambda: a.knows("b", "z"))
    assert [link["name"] for link in a.mesh.links()] == ["b", "z"]


def test_an_address_can_be_named_while_the_mesh_runs(rig, agent):
    a, b = agent("a"), agent("b")
    b.mesh.learn([a.address])
    rig.until(lambda: a.knows("b") and b.knows("a"))


def test_those_who_are_there_are_told_of_a_newcomer(rig, agent):
    a = agent("a")
    ear = rig.ear()
    rig.transport("old").dial(a.address, ear)
    rig.until(lambda: ear.connection)
    ear.connection.send(raw_hello("old"))
    rig.until(lambda: a.knows("old"))
    newcomer = agent("new", [a.address])
    rig.until(lambda: newcomer.address.encode() in ear.data)


def test_only_agents_are_neighbours_and_clients_are_not_spread(rig, agent):
    a, b = pair(rig, agent)
    world = agent("world", [a.address], role="environment")
    terminal = agent("alice.1", [a.address], role="client")
    everybody = (a, b, world, terminal)
    rig.until(lambda: all(it.knows(*{"a", "b", "alice.1", "world"} - {it.name}) for it in everybody))
    assert a.mesh.neighbours() == ["b"]
    assert world.mesh.neighbours() == ["a", "b"]
    assert a.say(NEIGHBOURS, "hello") == 1
    # The client found the others through a and dialled them; no agent was told where it listens itself.
    for other in (a, b, world):
        assert terminal.address not in [it["address"] for it in other.mesh.describe()["addresses"]]
    assert a.say("alice.1", "an answer to the asker") == 1
    rig.until(lambda: terminal.packets)


def test_when_both_dial_one_link_stays_that_of_the_lower_name(memory_rig):
    a = memory_rig.agent("a", ["tcp://b:1"], listen="tcp://a:1")
    b = memory_rig.agent("b", ["tcp://a:1"], listen="tcp://b:1")
    memory_rig.timeline.run_until(20.0)
    assert a.ups == ["b"] and b.ups == ["a"]
    assert a.downs == [] and b.downs == []
    (peer,) = a.mesh.describe()["peers"]
    assert peer["remote"] == "tcp://b:1", "a dialled it"
    assert len(memory_rig.network.pipes) == 1


def test_both_dialling_over_real_sockets_ends_in_one_link(tcp_rig):
    a = tcp_rig.agent("a")
    b = tcp_rig.agent("b", [a.address])
    c = tcp_rig.agent("c", [a.address, b.address])
    d = tcp_rig.agent("d", [c.address, b.address, a.address])
    everybody = [a, b, c, d]
    tcp_rig.until(lambda: all(len(it.mesh.connected()) == 3 for it in everybody))
    for it in everybody:
        it.say(NEIGHBOURS, it.name)
    tcp_rig.until(lambda: all(len(it.packets) == 3 for it in everybody))
    assert all(it.downs == [] for it in everybody), "no link was given up that had been used"


def test_a_broken_link_is_seen_and_comes_back(memory_rig):
    a = memory_rig.agent("a")
    b = memory_rig.agent("b", [a.address])
    memory_rig.until(lambda: a.knows("b") and b.knows("a"))
    memory_rig.network.break_links("a", "b")
    memory_rig.until(lambda: a.downs and b.downs)
    memory_rig.until(lambda: a.knows("b") and b.knows("a"))
    a.say("b", "again")
    memory_rig.until(lambda: b.packets)


def test_a_peer_that_another_thread_finds_connected_can_be_sent_to(memory_rig, monkeypatch):
    """Looks where the ways of packets change: another thread may look right before that, or right after."""
    change = Sending.change
    ways: dict[Sending, set[str]] = {}
    found: list[tuple[bool, bool]] = []

    def look_and_change(sending, links, neighbours):
        before, after = ways.get(sending, set()), set(links)
        for peer in before | after:
            mesh = (a if peer == "b" else b).mesh
            is_told = peer in mesh.connected() or peer in mesh.neighbours()
            found.append((is_told, peer in before and peer in after))
        change(sending, links, neighbours)
        ways[sending] = after

    monkeypatch.setattr(Sending, "change", look_and_change)
    a, b = memory_rig.agent("a"), memory_rig.agent("b")
    b.mesh.learn((a.address,))
    memory_rig.until(lambda: a.knows("b") and b.knows("a"))
    memory_rig.network.break_links("a", "b")
    memory_rig.until(lambda: a.downs and b.downs)
    assert found == [(False, False)] * 4


def test_a_partition_is_seen_by_its_silence_after_two_seconds_and_heals(memory_rig):
    a = memory_rig.agent("a")
    b = memory_rig.agent("b", [a.address])
    memory_rig.timeline.run_until(1.0)
    memory_rig.network.partition(["a"], ["b"], from_s=10.0, until_s=30.0)
    memory_rig.timeline.run_until(11.4)
    assert a.downs == [] and b.downs == []
    a.say("b", "lost")
    memory_rig.timeline.run_until(12.1)
    assert a.downs == [("b", "nothing was heard from b for 2 s", None)]
    assert b.downs == [("a", "nothing was heard from a for 2 s", None)]
    memory_rig.timeline.run_until(30.0)
    assert not a.knows("b")
    memory_rig.timeline.run_until(41.0)  # 10 s is the longest wait between two dials
    assert a.knows("b") and b.knows("a")
    assert b.packets == []


def test_an_agent_that_is_started_again_replaces_its_old_self(memory_rig):
    """The partition hides the death of the first life; the second comes from another place."""
    a = memory_rig.agent("a", listen="tcp://a:1")
    memory_rig.agent("b", ["tcp://a:1"], listen="tcp://b:1", boot=1)
    memory_rig.until(lambda: a.knows("b"))
    memory_rig.network.break_links("a", "b", at_once=False)  # as when its machine lost power
    again = memory_rig.agent("b", ["tcp://a:1"], listen="tcp://b:2", boot=2)
    memory_rig.until(lambda: again.knows("a"))
    assert memory_rig.clock.now() < 1.0, "it did not wait for the silence"
    assert a.ups == ["b", "b"] and [name for name, _, _ in a.downs] == ["b"]
    (peer,) = a.mesh.describe()["peers"]
    assert peer["boot"] == 2


def test_a_link_whose_other_end_has_gone_unseen_gives_way_to_a_new_one(memory_rig):
    a = memory_rig.agent("a", listen="tcp://a:1")
    b = memory_rig.agent("b", ["tcp://a:1"], listen="tcp://b:1")
    memory_rig.until(lambda: a.knows("b") and b.knows("a"))
    (pipe,) = memory_rig.network.pipes
    pipe.cut = True
    pipe.ends[0].finish_later("only b sees the break")
    memory_rig.until(lambda: b.downs)
    memory_rig.timeline.run_until(memory_rig.clock.now() + 5.0)
    assert a.knows("b") and b.knows("a")
    b.say("a", "on the new link")
    memory_rig.until(lambda: a.packets)


def test_a_second_connection_of_a_peer_is_refused_as_soon_as_the_first_shows_life(memory_rig):
    a, b = memory_rig.agent("a"), memory_rig.agent("b")
    b.mesh.learn([a.address])
    memory_rig.until(lambda: a.knows("b") and b.knows("a"))
    second = memory_rig.ear()
    memory_rig.transport("b").dial(a.address, second)
    memory_rig.until(lambda: second.connection)
    second.connection.send(frame([encode_link_message(b.mesh.identity.hello([b.address]))]))
    b.say("a/client", 1)
    said_s = memory_rig.clock.now()
    memory_rig.until(lambda: second.closed_for)
    assert memory_rig.clock.now() - said_s < 0.1
    assert b"has another link" in second.data
    assert a.knows("b") and [packet.body for packet in a.packets] != []


def test_what_cannot_be_sent_is_an_error_at_the_publisher(rig, agent):
    a, b = pair(rig, agent)
    with pytest.raises(LocalProtocolError, match="'words'.*a/client/test.*bytes"):
        a.say("b", bytes(MAX_PAYLOAD_BYTES))
    with pytest.raises(LocalProtocolError, match="set"):
        a.say("b", {"things": {1, 2}})
    with pytest.raises(PeerLostError, match="no link to it .it is connected to b."):
        a.say("nobody", "?")
    with pytest.raises(LocalProtocolError, match="not for another agent"):
        a.say("a/client/x", "?")
    largest = bytes(MAX_PAYLOAD_BYTES - 200)
    a.say("b", largest)
    rig.until(lambda: b.packets)
    assert bodies(b) == [largest]


def test_a_sleeper_is_not_counted_as_dead(memory_rig):
    a = memory_rig.agent("a")
    b = memory_rig.agent("b", [a.address])
    memory_rig.until(lambda: a.knows("b") and b.knows("a"))
    b.mesh.sleep(for_s=30.0)
    memory_rig.until(lambda: a.downs)
    assert a.downs == [("b", "b sleeps for 30 s", 30.0)]
    start_s = memory_rig.clock.now()
    memory_rig.timeline.run_until(start_s + 20.0)
    assert [it["name"] for it in a.mesh.describe()["asleep"]] == ["b"]
    with pytest.raises(PeerLostError, match="it sleeps for another 1"):
        a.say("b", "?")
    with pytest.raises(PeerLostError, match="the network of b sleeps"):
        b.say("a", "?")
    assert a.ups == ["b"], "it was left alone"
    b.mesh.wake()
    memory_rig.until(lambda: a.knows("b") and b.knows("a"))
    assert a.mesh.describe()["asleep"] == []
    a.say("b", "good morning")
    memory_rig.until(lambda: b.packets)


def test_who_dials_a_sleeper_is_told_for_how_long(memory_rig):
    a = memory_rig.agent("a")
    memory_rig.timeline.run_until(0.1)
    a.mesh.sleep(for_s=30.0)
    memory_rig.timeline.run_until(10.0)
    b = memory_rig.agent("b", [a.address])
    memory_rig.timeline.run_until(11.0)
    ((asleep),) = b.mesh.describe()["asleep"]
    assert asleep["name"] == "a" and 18.0 < asleep["for_s"] < 20.0
    a.mesh.wake()
    memory_rig.timeline.run_until(31.0)
    assert a.knows("b") and b.knows("a")


def test_waking_up_does_not_wait_for_the_next_retry(memory_rig):
    a = memory_rig.agent("a", ["tcp://late:1"])
    memory_rig.timeline.run_until(100.0)
    a.mesh.sleep()
    memory_rig.timeline.run_until(100.1)
    memory_rig.agent("late", listen="tcp://late:1")
    a.mesh.wake()
    memory_rig.timeline.run_until(100.2)
    assert a.knows("late")


def test_stopping_says_goodbye(rig, agent):
    a, b = pair(rig, agent)
    b.mesh.stop()
    b.transport.close()
    rig.until(lambda: a.downs)
    assert a.downs == [("b", "b stopped", None)]


def test_only_mission_packets_are_counted(memory_rig):
    a = memory_rig.agent("a")
    b = memory_rig.agent("b", [a.address])
    c = memory_rig.agent("c", [a.address])
    memory_rig.until(lambda: a.knows("b", "c") and c.knows("a", "b"))
    memory_rig.timeline.run_until(30.0)
    assert a.mesh.mission_packets_sent() == 0, "heartbeats and gossip of the mesh do not count"
    a.say("b", "one")
    a.say(NEIGHBOURS, "one to each")
    a.say("b", "again", retry=True)
    memory_rig.until(lambda: len(b.packets) == 3)
    assert a.mesh.mission_packets_sent() == 3
    a.mesh.announce()
    memory_rig.timeline.run_until(31.0)
    assert a.mesh.mission_packets_sent() == 5, "a beacon to each"
    c.mesh.stop()
    memory_rig.until(lambda: a.knows("b"))
    assert a.mesh.mission_packets_sent() == 5, "also over links that have ended"
    a.mesh.send(Packet("chat", "words", "a/client/test", "b", 0.0, 99, "unless told otherwise it is new"))
    assert a.mesh.mission_packets_sent() == 6


def test_mesh_beacon_brings_back_a_forgotten_address(memory_rig):
    """b came too late to hear of c when it connected; the beacon repeats it. Heartbeats are seldom, to save time."""
    times = LinkTimes(heartbeat_s=50.0, measure_s=500.0)
    a = memory_rig.agent("a", times=times)
    b = memory_rig.agent("b", [a.address], times=times)
    memory_rig.until(lambda: a.knows("b") and b.knows("a"))
    memory_rig.network.partition(["b"], ["c"], until_s=5000.0)
    c = memory_rig.agent("c", [a.address], times=times)
    memory_rig.timeline.run_until(4000.0)
    forgotten = [known["address"] for known in b.mesh.describe()["addresses"]]
    assert c.address not in forgotten, "an address that was learnt and never answered"
    memory_rig.timeline.run_until(5000.0)
    assert not b.knows("a", "c")
    a.mesh.announce()
    memory_rig.until(lambda: b.knows("a", "c") and c.knows("a", "b"))


def test_counters_and_round_trips_can_be_read(rig, agent):
    a, b = pair(rig, agent)
    a.say("b", "one")
    rig.until(lambda: b.packets and a.mesh.rtt_s("b") is not None)
    (of_b,) = a.mesh.describe()["peers"]
    (of_a,) = b.mesh.describe()["peers"]
    assert (of_b["name"], of_b["role"], of_b["packets_out"], of_a["packets_in"]) == ("b", "agent", 1, 1)
    assert of_b["bytes_out"] > 50 and of_a["bytes_in"] > 50
    assert 0 < of_b["rtt_s"] < 1.0
    assert a.mesh.rtt_s("nobody") is None


def test_packets_of_one_turn_leave_together(memory_rig):
    turn_ends: list[Callable[[], None]] = []
    a = memory_rig.agent("a", defer=turn_ends.append)
    b = memory_rig.agent("b", [a.address])
    memory_rig.until(lambda: a.knows("b"))
    for number in range(10):
        a.say("b", number)
    memory_rig.timeline.run_until(memory_rig.clock.now() + 0.1)
    assert b.packets == [] and len(turn_ends) == 1
    turn_ends.pop()()
    memory_rig.until(lambda: len(b.packets) == 10)
    a.say("b", 10)
    assert len(turn_ends) == 1


def test_a_slow_peer_slows_nobody_else(memory_rig):
    a = memory_rig.agent("a")
    b = memory_rig.agent("b", [a.address])
    slow = memory_rig.agent("slow", [a.address])
    everybody = (a, b, slow)
    memory_rig.until(lambda: all(len(it.mesh.connected()) == 2 for it in everybody))
    memory_rig.network.set_quality("a", "slow", Quality(bytes_per_s=20_000.0))
    start_s = memory_rig.clock.now()
    for number in range(300):
        assert a.say(NEIGHBOURS, number, channel="system", kind="reading") == 2
        assert a.say(NEIGHBOURS, bytes(200), channel="log") == 2
        assert a.say(NEIGHBOURS, number, channel="sysctrl", kind="order") == 2
        assert a.say(NEIGHBOURS, number) == 2
    memory_rig.timeline.run_until(start_s + 0.1)
    assert len(b.packets) == 1200
    memory_rig.timeline.run_until(start_s + 1.5)
    orders = [packet.body for packet in slow.packets if packet.channel == "sysctrl"]
    assert orders == list(range(300)), "a lane of its own, before all others"
    a.say("slow", "urgent", channel="sysctrl", kind="order")
    memory_rig.timeline.run_until(start_s + 3.0)
    assert slow.packets[-1].body != "urgent" and "urgent" in bodies(slow), "it overtook what waits"
    (of_slow,) = [it for it in a.mesh.describe()["peers"] if it["name"] == "slow"]
    assert of_slow["waiting"]["log"] > 50
    memory_rig.timeline.run_until(start_s + 60.0)
    words = [packet.body for packet in slow.packets if packet.channel == "chat"]
    assert words == list(range(300)), "within its window a channel loses nothing"
    readings = [packet.body for packet in slow.packets if packet.channel == "system"]
    assert readings == sorted(readings) and len(readings) < 300 and readings[-1] == 299, "the newest"
    (drops,) = [it["dropped"] for it in a.mesh.describe()["peers"] if it["name"] == "slow"]
    assert drops == {"system": 300 - len(readings)}
    assert "slow is slow" in a.log("warning")
    assert slow.downs == []


def test_a_full_window_is_told_to_the_publisher(memory_rig):
    a = memory_rig.agent("a")
    b = memory_rig.agent("b", [a.address])
    memory_rig.until(lambda: a.knows("b") and b.knows("a"))
    memory_rig.network.set_quality("a", "b", Quality(bytes_per_s=20_000.0))
    with pytest.raises(PeerBusy, match="b is slow: .* on chat wait for it"):
        for number in range(3000):
            a.say("b", number)
    assert a.say(NEIGHBOURS, "to whom it may reach") == 0
    assert a.say("b", "another channel", channel="other") == 1
    memory_rig.timeline.run_until(60.0)
    assert bodies(b).index("another channel") < 1000, "channels take turns"
    kept = [body for body in bodies(b) if body != "another channel"]
    assert kept == list(range(len(kept))) and len(kept) >= 1024, "what was taken arrives, and in order"


def test_agents_meet_over_a_link_on_which_even_the_hello_waits(memory_rig):
    memory_rig.network.set_quality("a", "b", Quality(bytes_per_s=400.0))
    a = memory_rig.agent("a")
    b = memory_rig.agent("b", [a.address])
    memory_rig.timeline.run_until(4.0)
    assert a.ups == ["b"] and b.ups == ["a"]
    a.say("b", "slowly")
    memory_rig.until(lambda: b.packets)
    assert a.downs == b.downs == []


def test_a_peer_that_takes_nothing_is_closed(tcp_rig):
    times = LinkTimes(heartbeat_s=0.05, missed=1000, stuck_s=0.3)
    a = tcp_rig.agent("a", times=times)
    b = tcp_rig.agent("b", [a.address], times=times)
    ear, gate = tcp_rig.ear(), threading.Event()
    tcp_rig.transport("stuck").dial(a.address, ear)
    tcp_rig.until(lambda: ear.connection)
    ear.connection.send(raw_hello("stuck"))
    tcp_rig.until(lambda: a.knows("b", "stuck"))
    ear.received = lambda data: gate.wait(20)
    with pytest.raises(PeerBusy):
        while True:
            a.say("stuck", bytes(100_000))
    a.say("b", "meanwhile")
    tcp_rig.until(lambda: b.packets)
    tcp_rig.until(lambda: a.downs)
    gate.set()
    assert a.downs == [("stuck", "stuck took none of the waiting bytes for 0.3 s", None)]
    assert a.knows("b")


def test_a_fault_in_a_callback_costs_no_link(rig, agent):
    a, b = pair(rig, agent)
    b.take = lambda packets: 1 // 0
    a.say("b", "one")
    rig.until(lambda: "ZeroDivisionError" in b.log("error"))
    assert b.knows("a") and b.downs == []


def test_a_run_in_virtual_time_repeats_itself(new_memory_rig):
    def run():
        rig = new_memory_rig()
        network = rig.network
        a = rig.agent("a", ["tcp://b:1"], listen="tcp://a:1")
        b = rig.agent("b", ["tcp://c:1"], listen="tcp://b:1")
        c = rig.agent("c", ["tcp://a:1"], listen="tcp://c:1")
        network.partition(["a"], from_s=5.0, until_s=12.0)
        rig.timeline.call_at(20.0, lambda: network.break_links("b", "c"))
        rig.timeline.run_until(40.0)
        assert a.knows("b", "c") and b.knows("a", "c")
        return [it.lines for it in (a, b, c)], rig.timeline.count

    assert run() == run()
