"""What a mesh of many agents costs: nothing grows with the square of the fleet but the links themselves."""

from __future__ import annotations

from pancakes.mesh.gossip import ADDRESSES as GOSSIP_ADDRESSES
from pancakes.mesh.gossip import BEACON_ADDRESSES

MANY = 3 * BEACON_ADDRESSES


def crowd(rig, count):
    first = rig.agent("a00")
    agents = [first, *(rig.agent(f"a{number:02d}", [first.address]) for number in range(1, count))]
    rig.until(lambda: all(len(agent.mesh.connected()) == count - 1 for agent in agents))
    run_for(rig, 1.0)
    return agents


def run_for(rig, duration_s):
    rig.timeline.run_until(rig.clock.now() + duration_s)


def test_a_beacon_names_a_few_agents_and_the_next_ones_the_others(memory_rig):
    agents = crowd(memory_rig, MANY)
    watcher = memory_rig.bare_peer("w", agents[0])
    run_for(memory_rig, 1.0)
    watcher.told.clear()
    for _ in range(4):
        agents[0].mesh.announce()
        run_for(memory_rig, 1.0)
    assert len(watcher.told) == 4
    assert all(len(addresses) == BEACON_ADDRESSES + 1 for addresses in watcher.told), "some, and itself"
    everybody = {agent.address for agent in agents}
    assert {address for addresses in watcher.told for address in addresses} == everybody


def test_a_newcomer_hears_of_all_agents_and_the_others_hear_of_it_from_one(memory_rig):
    agents = crowd(memory_rig, MANY)
    watchers = [memory_rig.bare_peer(f"w{number:02d}", agent) for number, agent in enumerate(agents)]
    run_for(memory_rig, 1.0)
    newcomer = memory_rig.bare_peer("w", agents[0], listen="tcp://w:1")
    run_for(memory_rig, 1.0)
    assert set(newcomer.told[0]) == {agent.address for agent in agents[1:]}
    tellers = [watcher for watcher in watchers if ("tcp://w:1",) in watcher.told]
    assert tellers == watchers[:1], "not the square"


def test_more_addresses_than_a_message_may_hold_are_told_in_several(memory_rig):
    a = memory_rig.agent("a")
    for number in range(2 * GOSSIP_ADDRESSES + 1):
        memory_rig.bare_peer(f"b{number}", a, listen=f"tcp://x:{number + 1}")
    memory_rig.until(lambda: len(a.mesh.connected()) == 2 * GOSSIP_ADDRESSES + 1)
    last = memory_rig.bare_peer("c", a)
    memory_rig.until(lambda: last.is_up)
    run_for(memory_rig, 1.0)
    assert [len(addresses) for addresses in last.told] == [GOSSIP_ADDRESSES, GOSSIP_ADDRESSES, 1]


def test_the_heartbeats_of_many_links_are_served_by_few_wake_ups(memory_rig):
    agents = crowd(memory_rig, MANY)
    woken = []
    transport = agents[0].transport
    call_later = transport.call_later

    def noted(delay_s, function):
        return call_later(delay_s, lambda: woken.append(function()))

    transport.call_later = noted
    run_for(memory_rig, 10.0)
    assert 10 < len(woken) < 100, "and not two a second for each link"
    assert all(agent.downs == [] for agent in agents)
