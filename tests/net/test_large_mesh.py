"""What a mesh of many agents costs: nothing grows with the square of the fleet but the links themselves."""

from __future__ import annotations

from pancakes.net.mesh import BEACON_ADDRESSES, GOSSIP_ADDRESSES
from pancakes.wire.link import Learnt

MANY = 3 * BEACON_ADDRESSES


def crowd(rig, count):
    first = rig.agent("a00")
    agents = [first, *(rig.agent(f"a{number:02d}", [first.mesh.listen]) for number in range(1, count))]
    rig.until(lambda: all(len(agent.mesh.connected()) == count - 1 for agent in agents))
    rig.timeline.run_until(rig.clock.now() + 1.0)
    return agents


def noted(agent):
    """Returns a list to which goes what the agent is told from now on: each time the addresses."""
    told = []
    act = agent.mesh._act

    def listen(session, actions):
        told.extend(action.addresses for action in actions if isinstance(action, Learnt))
        act(session, actions)

    agent.mesh._act = listen
    return told


def test_a_beacon_names_a_few_agents_and_the_next_ones_the_others(memory_rig):
    agents = crowd(memory_rig, MANY)
    told = noted(agents[1])
    for _ in range(4):
        agents[0].mesh.announce()
        memory_rig.timeline.run_until(memory_rig.clock.now() + 1.0)
    assert len(told) == 4
    assert all(len(addresses) <= BEACON_ADDRESSES + 1 for addresses in told), "some, and itself"
    everybody = {agent.mesh.listen for agent in agents} - {agents[1].mesh.listen}
    assert {address for addresses in told for address in addresses} == everybody


def test_who_comes_is_told_of_all_and_the_others_only_by_who_did_not_know_it(memory_rig):
    agents = crowd(memory_rig, MANY)
    told = [noted(agent) for agent in agents]
    newcomer = memory_rig.agent("new", [agents[0].mesh.listen])
    heard = noted(newcomer)
    memory_rig.until(lambda: len(newcomer.mesh.connected()) == MANY)
    memory_rig.timeline.run_until(memory_rig.clock.now() + 1.0)
    of_newcomer = [addresses for each in told for addresses in each if addresses == (newcomer.mesh.listen,)]
    assert len(of_newcomer) < 2 * MANY, "not the square"
    assert len(heard[0]) == MANY - 1
    assert all(len(agent.mesh.connected()) == MANY for agent in agents)


def test_more_addresses_than_a_message_may_hold_are_told_in_several(memory_rig):
    a = memory_rig.agent("a")
    told = noted(a)
    b = memory_rig.agent("b")
    memory_rig.timeline.run_until(0.1)
    many = tuple(f"tcp://x:{number}" for number in range(2 * GOSSIP_ADDRESSES + 1))
    b.mesh._peers.gossip = lambda: many
    b.mesh.learn([a.mesh.listen])
    memory_rig.until(lambda: a.knows("b") and b.knows("a"))
    memory_rig.timeline.run_until(1.0)
    assert [len(addresses) for addresses in told] == [GOSSIP_ADDRESSES, GOSSIP_ADDRESSES, 1]


def test_the_heartbeats_of_many_links_are_served_by_few_wake_ups(memory_rig):
    agents = crowd(memory_rig, MANY)
    woken = []
    alarm, run = agents[0].mesh._links_alarm, agents[0].mesh._run_links
    alarm._function = lambda: woken.append(run())
    memory_rig.timeline.run_until(memory_rig.clock.now() + 10.0)
    assert 10 < len(woken) < 100, "and not two a second for each link"
    assert all(agent.downs == [] for agent in agents)
