"""Which links an agent has that keeps a few alone: decisions, and meshes in virtual time."""

from __future__ import annotations

import random

import pytest
from net.conftest import MemoryRig
from seeded import for_each

from pancakes.errors import PeerLostError
from pancakes.mesh.messages import AgentSeen, Goodbye, Gossip
from pancakes.mesh.partial_mesh import (
    AVOIDED_S,
    FORGOTTEN_S,
    FRESH_S,
    LATE_S,
    LOOK_S,
    MADE_S,
    MANY,
    MOST_KNOWN,
    REST_S,
    SOON_S,
    WALK_S,
    DropWaiting,
    EndLink,
    FewLinks,
    LinkUse,
    MakeLink,
)
from pancakes.mesh.peers import MAX_AGENTS, QUIET_S, RESTS_S
from pancakes.mesh.sending import MOST_WAITED_FOR, MOST_WAITING_BYTES
from pancakes.mesh.session import PeerBusy

IN_USE, IDLE, STATIC = LinkUse(True, 0.0), LinkUse(True, REST_S), LinkUse(False, REST_S)


def few(*known, most=3, seed=1):
    made = FewLinks(most, random.Random(seed), 0.0)
    for name in known:
        made.on_sighting(name, (f"tcp://{name}:1",), 0.0, 0.0)
    return made


def made(decisions):
    return sorted(it.name for it in decisions if isinstance(it, MakeLink))


def ended(decisions):
    return [it.name for it in decisions if isinstance(it, EndLink)]


def test_it_makes_links_until_they_are_enough_and_draws_the_agents():
    names = [f"n{number}" for number in range(10)]
    first = made(few(*names).tick(0.0, {}))
    assert len(first) == 3 and set(first) <= set(names)
    assert {tuple(made(few(*names, seed=seed).tick(0.0, {}))) for seed in range(9)} > {tuple(first)}
    assert made(few("a", "b").tick(0.0, {})) == ["a", "b"], "there are no more"
    it = few("a", "b", "c", "d")
    assert made(it.tick(0.0, {"a": IN_USE, "z": IN_USE})) != [] and it.due_s == LOOK_S
    assert made(it.tick(1.0, {"a": IN_USE, "z": IN_USE})) == [], "one is being made"


def test_a_newcomer_looks_again_soon_after_it_hears_of_the_first_agents_and_others_do_not():
    it = few()
    it.tick(0.0, {})
    it.on_sighting("a", ("tcp://a:1",), 0.0, 1.0)
    it.on_sighting("b", ("tcp://b:1",), 0.0, 1.1)
    assert it.due_s == 1.0 + SOON_S < LOOK_S
    assert made(it.tick(it.due_s, {})) == ["a", "b"], "of three that it is to have"
    it.on_sighting("a", ("tcp://a:1",), 0.0, 1.3)
    assert it.due_s == 1.0 + SOON_S + LOOK_S, "nothing new"
    it.on_sighting("c", ("tcp://c:1",), 0.0, 1.4)
    assert made(it.tick(it.due_s, {"a": IN_USE, "b": IN_USE})) == ["c"] and it.due_s == 1.4 + SOON_S + LOOK_S
    it.on_sighting("d", ("tcp://d:1",), 0.0, 1.7)
    assert it.due_s == 1.4 + SOON_S + LOOK_S, "it has enough"
    it = few()
    it.tick(0.0, {})
    assert it.tick(1.0, dict.fromkeys("xyz", IN_USE)) == []
    it.on_sighting("a", ("tcp://a:1",), 0.0, 1.1)
    assert it.due_s == 1.0 + LOOK_S, "others have dialled it"


def test_where_a_link_takes_long_another_agent_is_drawn_as_well():
    it = few(*"abcdef")
    first = made(it.tick(0.0, {}))
    linked = {first[0]: IN_USE}
    assert made(it.tick(LATE_S - 0.1, linked)) == [], "the two others may stand soon"
    others = made(it.tick(LATE_S, linked))
    assert len(others) == 2 and not {*first} & {*others}
    assert made(it.tick(LATE_S + 0.1, {**linked, others[0]: IN_USE})) == []
    linked = dict.fromkeys((*others, first[0]), IN_USE)
    assert made(it.tick(2 * LATE_S, linked)) == [], "it has enough, whatever becomes of the first"
    assert {row.name for row in it.tick(MADE_S, linked) if isinstance(row, DropWaiting)} == {*first[1:]}


def test_an_agent_for_which_there_is_something_gets_a_link_where_it_is_known():
    it = few("a", "b", "c", "d")
    linked = dict.fromkeys("abc", IN_USE)
    assert it.tick(0.0, linked) == [] and it.seek("x", 0.0) == [DropWaiting("x", ())]
    assert it.seek("d", 0.0) == [MakeLink("d", ("tcp://d:1",))] and it.seek("d", 0.5) == []
    assert it.tick(1.0, {**linked, "d": IN_USE}) == []
    assert it.seek("d", 2.0) != [], "its link may end"
    it.on_link_up("d")
    assert it.seek("d", 2.1) != [], "at once, too"


def test_what_does_not_become_a_link_is_given_up_and_not_tried_unasked_for_a_while():
    it = few("d", most=1)
    it.tick(0.0, {})
    assert it.tick(MADE_S - 0.1, {}) == []
    assert it.tick(MADE_S, {}) == [DropWaiting("d", ("tcp://d:1",))]
    assert it.tick(MADE_S + 1, {}) == [] and it.tick(MADE_S + AVOIDED_S - 1, {}) == []
    assert it.seek("d", MADE_S + 2) != [], "somebody asks"
    it = few("d", most=1)
    it.tick(0.0, {})
    it.tick(MADE_S, {})
    assert made(it.tick(MADE_S + AVOIDED_S, {})) == ["d"]


def test_links_that_are_too_many_end_where_they_are_unused_and_its_own():
    it = few(most=2)
    linked = {"a": IN_USE, "b": STATIC, "c": IDLE, "d": LinkUse(True, REST_S + 9), "e": LinkUse(True, REST_S - 1)}
    assert ended(it.tick(0.0, linked)) == ["d"]
    linked["f"] = IN_USE
    assert ended(it.tick(1.0, linked)) == ["d", "c"]
    del linked["d"], linked["f"]
    assert ended(it.tick(2.0, linked)) == [], "twice as many as are to be kept are not too many"


def test_now_and_then_it_meets_an_agent_unasked():
    it = few("a", "b", "c", most=2)
    linked = dict.fromkeys("ab", IN_USE)
    met = [at_s for at_s in range(int(2 * WALK_S)) if made(it.tick(float(at_s), linked)) and it.seek("c", 0.0) == []]
    assert met and met[0] <= WALK_S


def test_what_is_old_is_told_to_no_peer_and_forgotten():
    it = few("a", "b")
    it.on_sighting("b", ("tcp://b:2",), 10.0, 50.0)
    it.on_sighting("b", ("tcp://b:3",), 60.0, 50.0)  # older than what it knows
    assert it.fresh(100.0) == [("a", ("tcp://a:1",), 100.0), ("b", ("tcp://b:2",), 60.0)]
    assert it.fresh(FRESH_S) == [("b", ("tcp://b:2",), 80.0)]
    assert made(few("a").tick(FRESH_S, {})) == []
    it.on_sighting("old", ("tcp://old:1",), FRESH_S, 100.0)
    assert not it.knows("old") and it.knows("a")
    it.tick(FORGOTTEN_S, {})
    assert not it.knows("a") and it.knows("b")


def test_each_agent_is_told_of_in_its_turn():
    it = few(*(f"n{number}" for number in range(10)))
    told = [name for _ in range(3) for name, _, _ in it.some(4, 0.0)]
    assert len(told) == 10 and len(set(told)) == 10
    assert len(it.some(4, 0.0)) == 4 and it.some(4, FRESH_S) == []


def test_so_many_agents_are_known_at_most():
    it = few(*(f"n{number}" for number in range(MOST_KNOWN + 5)))
    assert len(it.fresh(0.0)) == MOST_KNOWN and not it.knows(f"n{MOST_KNOWN}")
    it.on_sighting("n0", ("tcp://new:1",), 0.0, 1.0)
    assert it.fresh(1.0)[0][1] == ("tcp://new:1",)


# In a mesh -----------------------------------------------------------------------------------------------------------


def crowd(rig, count, links=3):
    first = rig.agent("a00", links=links)
    agents = [first, *(rig.agent(f"a{number:02d}", [first.address], links=links) for number in range(1, count))]
    rig.timeline.run_until(30.0)
    beacons(rig, agents, 10)
    return agents


def beacons(rig, agents, seconds):
    for _ in range(seconds):
        for agent in agents:
            agent.mesh.announce()
        rig.timeline.run_until(rig.clock.now() + 1.0)


def linked(agents):
    return {agent.name: set(agent.mesh.connected()) for agent in agents}


def stranger_of(fleet):
    """Returns an agent, and one to which it has no link."""
    sender = fleet[5]
    return sender, next(it for it in fleet if it is not sender and it.name not in sender.mesh.connected())


def reached(links, first):
    seen, to_see = {first}, [first]
    while to_see:
        new = links[to_see.pop()] - seen
        seen |= new
        to_see += new
    return seen


FLEET = 16


@pytest.fixture
def fleet(memory_rig):
    return crowd(memory_rig, FLEET)


def test_few_links_join_a_fleet_that_knows_all(memory_rig, fleet):
    links = linked(fleet)
    assert all(len(others) >= 3 for others in links.values())
    assert sum(map(len, links.values())) < FLEET * 8, "a full mesh has FLEET * (FLEET - 1)"
    assert reached(links, "a05") == set(links)
    far = {agent.name: set(links) - links[agent.name] - {agent.name} for agent in fleet}
    assert all(agent.mesh.seek(name) for agent in fleet[:3] for name in far[agent.name])


def check_newcomer(name):
    rig = MemoryRig()
    fleet = crowd(rig, 12)
    rig.network.partition([agent.name for agent in fleet[1:9]])
    newcomer = rig.agent(name, [fleet[0].address], links=3)
    rig.timeline.run_until(rig.clock.now() + 20.0)
    assert len(newcomer.mesh.connected()) >= 3


def test_few_links_newcomer_among_silent_agents():
    """Each name draws other agents; test_few_links_full.py has more."""
    for_each(["z1"], check_newcomer)


def test_few_links_packets_without_a_link_arrive_in_order(memory_rig, fleet):
    sender, receiver = stranger_of(fleet)
    for number in range(5):
        assert sender.say(f"{receiver.name}/client/test", number) == 1
    memory_rig.until(lambda: len(receiver.packets) == 5)
    sender.say(f"{receiver.name}/client/test", 5)
    memory_rig.until(lambda: len(receiver.packets) == 6)
    assert [packet.body for packet in receiver.packets] == list(range(6))


def test_few_links_unused_one_ends_and_comes_back(memory_rig, fleet):
    sender, _ = stranger_of(fleet)
    before = set(sender.mesh.connected())
    for name in sorted(set(linked(fleet)) - before - {sender.name}):
        sender.say(f"{name}/client/test")
    memory_rig.until(lambda: len(sender.mesh.connected()) == len(fleet) - 1)
    memory_rig.timeline.run_until(memory_rig.clock.now() + REST_S + 2 * LOOK_S)
    assert len(sender.mesh.connected()) <= max(MANY * 3, len(before))
    name = sender.downs[-1][0]
    peer = next(agent for agent in fleet if agent.name == name)
    assert (sender.name, f"{sender.name} has no use for it now", None) in peer.downs
    _, peer = stranger_of(fleet)
    sender.say(f"{peer.name}/client/test", "again")
    memory_rig.until(lambda: peer.packets and peer.packets[-1].body == "again")


def test_few_links_packets_for_a_dead_agent_are_lost(memory_rig):
    fleet = crowd(memory_rig, 9)
    sender, receiver = stranger_of(fleet)
    name = receiver.name
    receiver.mesh.stop()
    memory_rig.timeline.run_until(memory_rig.clock.now() + 5.0)
    assert sender.say(f"{name}/client/test") == 1 and sender.say(f"{name}/client/test") == 1
    memory_rig.timeline.run_until(memory_rig.clock.now() + MADE_S + 2 * LOOK_S)
    assert f"2 packets for {name} are lost: no link to it could be made" in sender.log("warning")
    with pytest.raises(PeerLostError, match="has no link to it"):
        sender.say("unknown/client/test")


def test_few_links_packet_at_sleep_is_lost_later_ones_arrive(memory_rig, fleet):
    sender, receiver = stranger_of(fleet)
    sender.mesh.sleep(5.0)
    assert sender.say(f"{receiver.name}/client/test", "lost") == 1, "its own thread has not got to that yet"
    memory_rig.timeline.run_until(memory_rig.clock.now() + 1.0)
    assert f"a packet for {receiver.name} is lost: no link" in sender.log("warning")
    sender.mesh.wake()
    memory_rig.until(lambda: sender.mesh.connected())
    sender.say(f"{receiver.name}/client/test", "after")
    memory_rig.until(lambda: receiver.packets)
    assert [packet.body for packet in receiver.packets] == ["after"]


def test_what_waits_for_a_link_is_bounded(memory_rig):
    a = memory_rig.agent("a", links=2)
    peer = memory_rig.bare_peer("b", a)
    memory_rig.until(lambda: peer.is_up)
    gone = tuple(AgentSeen(f"n{number}", f"tcp://n{number}:1") for number in range(MOST_WAITED_FOR + 1))
    peer.act(peer.link.tell(Gossip(gone), memory_rig.clock.now()))
    memory_rig.timeline.run_until(memory_rig.clock.now() + 0.1)
    with pytest.raises(PeerBusy, match="already wait for the link to n0, which is being made"):
        for _ in range(100):
            a.say("n0/client/test", bytes(MOST_WAITING_BYTES // 50))
    for number in range(1, MOST_WAITED_FOR):
        assert a.say(f"n{number}/client/test") == 1
    with pytest.raises(PeerLostError):
        a.say(f"n{MOST_WAITED_FOR}/client/test")


def test_few_links_full_agent_gives_unused_place_to_newcomer(memory_rig):
    a = memory_rig.agent("a", links=2)
    peers = [memory_rig.bare_peer(f"n{number:03d}", a) for number in range(MAX_AGENTS - 1)]
    memory_rig.until(lambda: all(peer.is_up for peer in peers))
    for peer in peers:
        a.say(f"{peer.own.name}/client/test")
    early = memory_rig.bare_peer("o", a)
    memory_rig.until(lambda: early.over)
    assert "is full" in early.over.reason and not any(peer.over for peer in peers)
    memory_rig.timeline.run_until(memory_rig.clock.now() + QUIET_S / 2)
    for peer in peers[:-1]:
        a.say(f"{peer.own.name}/client/test")
    memory_rig.timeline.run_until(memory_rig.clock.now() + QUIET_S / 2 + 2 * LOOK_S)
    late = memory_rig.bare_peer("p", a)
    memory_rig.until(lambda: late.is_up and peers[-1].over)
    assert [peer.own.name for peer in peers if peer.over] == [peers[-1].own.name]
    assert peers[-1].over.goodbye == Goodbye("rest", RESTS_S)


def test_few_links_full_agent_reaches_whom_it_has_packets_for(memory_rig):
    a, z = memory_rig.agent("a", links=2), memory_rig.agent("z", links=2)
    peers = [memory_rig.bare_peer(f"n{number:03d}", a) for number in range(MAX_AGENTS - 1)]
    memory_rig.until(lambda: all(peer.is_up for peer in peers))
    peers[0].act(peers[0].link.tell(Gossip((AgentSeen("z", z.address),)), memory_rig.clock.now()))
    memory_rig.timeline.run_until(memory_rig.clock.now() + 0.1)
    a.say("z/client/test", "for z")
    for _ in range(round(MADE_S)):
        for peer in peers:
            if peer.over is None:
                a.say(f"{peer.own.name}/client/test")
        memory_rig.timeline.run_until(memory_rig.clock.now() + 1.0)
    assert [it.body for it in z.packets] == ["for z"]
    assert [peer.over.goodbye for peer in peers if peer.over] == [Goodbye("rest", RESTS_S)], "one has lost its place"


def test_few_links_packets_on_their_way_arrive_as_link_ends(memory_rig):
    fleet = crowd(memory_rig, 12, links=2)
    ender, others = fleet[5], [one for one in fleet if one.name != "a05"]
    sent = dict.fromkeys((one.name for one in others), 0)

    def ends():
        return sum(reason == "a05 has no use for it now" for _, reason, _ in ender.downs)

    for _ in range(3):
        for one in others:
            ender.say(f"{one.name}/client/test")
        memory_rig.until(lambda: len(ender.mesh.connected()) == len(others))
        before = ends()
        memory_rig.until(lambda count=before: ends() > count)
        for one in others:  # they have not heard of it yet
            sent[one.name] += 1
            assert one.say("a05/client/test", sent[one.name]) == 1
        memory_rig.timeline.run_until(memory_rig.clock.now() + MADE_S)
    heard = {name: [it.body for it in ender.packets if it.source.startswith(f"{name}/")] for name in sent}
    assert heard == {name: list(range(1, count + 1)) for name, count in sent.items()}
