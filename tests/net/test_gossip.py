"""What agents tell each other of where others can be dialled."""

from __future__ import annotations

import types
from typing import Any

import pytest

from pancakes.mesh.address import Reach, TransportFacts, nameable_from, reach_of, reachable_from
from pancakes.mesh.gossip import Gossiper
from pancakes.mesh.messages import AgentSeen, Gossip, Identity

LOCAL, LOOPBACK, FIELD = "local://a", "tcp://127.0.0.1:7401", "tcp://10.0.0.1:7401"


@pytest.mark.parametrize(
    ("remote", "told"),
    [
        ("local://process-7", (LOCAL, LOOPBACK, FIELD)),
        ("tcp://127.0.0.1:5", (LOOPBACK, FIELD)),
        ("tcp://localhost:5", (LOOPBACK, FIELD)),
        ("tcp://10.0.0.9:5", (FIELD,)),
        ("tcp://robot3:0", (FIELD,)),
        ("tcp://0:0", (FIELD,)),  # no host
    ],
)
def test_an_agent_hears_only_of_addresses_that_it_can_dial(remote, told):
    assert reachable_from(remote, (LOCAL, LOOPBACK, FIELD)) == told


def test_an_agent_says_how_to_dial_it_from_where_its_peer_is(memory_rig):
    a = memory_rig.agent("a", listens=("local://a", "tcp://127.0.0.1:1", "tcp://a:1"))
    near = memory_rig.bare_peer("n", a)
    far = memory_rig.bare_peer("f", a, at="tcp://a:1")
    here = memory_rig.bare_peer("h", a, at="tcp://127.0.0.1:1")
    memory_rig.until(lambda: near.is_up and far.is_up and here.is_up)
    assert near.link.peer.listen == ("local://a", "tcp://127.0.0.1:1", "tcp://a:1")
    assert here.link.peer.listen == ("tcp://127.0.0.1:1", "tcp://a:1")
    assert far.link.peer.listen == ("tcp://a:1",)


def test_of_each_agent_the_best_address_is_told_that_the_hearer_can_dial(memory_rig):
    a = memory_rig.agent("a", listens=("local://a", "tcp://a:1"))
    b = memory_rig.agent("b", ["local://a"], listens=("local://b", "tcp://b:1"))
    c = memory_rig.agent("c", ["tcp://a:1"], listens=("local://c", "tcp://c:1"))
    memory_rig.until(lambda: a.knows("b", "c") and b.knows("a", "c") and c.knows("a", "b"))
    near, far = memory_rig.bare_peer("n", a), memory_rig.bare_peer("f", a, at="tcp://a:1")
    memory_rig.until(lambda: near.told and far.told)
    assert (near.told[0], far.told[0]) == (("local://b", "tcp://c:1"), ("tcp://b:1", "tcp://c:1"))
    assert "local://b" not in [it["address"] for it in c.mesh.describe()["addresses"]]


def test_an_agent_that_can_be_reached_from_its_own_machine_alone_is_no_news_elsewhere(memory_rig):
    a = memory_rig.agent("a", listens=("local://a", "tcp://a:1"))
    b = memory_rig.agent("b", ["local://a"], listens=("local://b",))
    c = memory_rig.agent("c", ["tcp://a:1"], listens=("tcp://c:1",))
    memory_rig.until(lambda: a.knows("b", "c") and b.knows("a", "c"))  # b dials c, whose address a has told it
    memory_rig.timeline.run_until(10.0)
    assert [it["address"] for it in c.mesh.describe()["addresses"]] == ["tcp://a:1"]


def test_who_listens_on_all_interfaces_of_this_machine_is_dialled_elsewhere_at_the_address_of_who_told(memory_rig):
    a = memory_rig.agent("a", listens=("local://a", "tcp://a:1"))
    memory_rig.bare_peer("b", a, listen="tcp://0.0.0.0:2")
    c = memory_rig.agent("c", ["tcp://a:1"], listens=())
    memory_rig.until(lambda: c.knows("a"))
    memory_rig.until(lambda: "tcp://a:2" in [it["address"] for it in c.mesh.describe()["addresses"]])
    assert "tcp://127.0.0.1:2" in [it["address"] for it in a.mesh.describe()["addresses"]]


@pytest.mark.parametrize(
    ("at", "dialled"),
    [
        ("local://a", ["local://victim", "tcp://127.0.0.1:9", "tcp://10.0.0.9:9"]),
        ("tcp://127.0.0.1:1", ["tcp://127.0.0.1:9", "tcp://10.0.0.9:9"]),
        ("tcp://a:1", ["tcp://10.0.0.9:9"]),
    ],
)
@pytest.mark.parametrize("by", ["hello", "gossip"])
def test_a_peer_elsewhere_sends_no_agent_to_places_of_its_own_machine(memory_rig, by, at, dialled):
    a = memory_rig.agent("a", listens=("local://a", "tcp://127.0.0.1:1", "tcp://a:1"))
    named = ["local:///run/victim", "local://victim", "tcp://127.0.0.1:9", "tcp://10.0.0.9:9"]
    peer = memory_rig.bare_peer("z", a, at=at, listen=named if by == "hello" else "")
    memory_rig.until(lambda: peer.is_up)
    if by == "gossip":
        said = Gossip(tuple(AgentSeen("v", it) for it in named))
        peer.act(peer.link.tell(said, memory_rig.clock.now()))
    memory_rig.timeline.run_until(1.0)
    assert [it["address"] for it in a.mesh.describe()["addresses"]] == dialled


@pytest.mark.parametrize("dialler", ["a", "c"])
def test_an_agent_that_is_dialled_at_two_addresses_has_one_link(memory_rig, dialler):
    b = memory_rig.agent("b", listens=("local://b", "tcp://127.0.0.1:2"))
    a = memory_rig.agent(dialler, ["tcp://127.0.0.1:2", "local://b"], listens=(f"local://{dialler}",))
    memory_rig.until(lambda: a.ups and b.ups)
    memory_rig.timeline.run_until(30.0)
    assert (a.ups, a.downs, b.ups, b.downs) == (["b"], [], [dialler], [])
    memory_rig.network.break_links(dialler, "b")
    memory_rig.timeline.run_until(60.0)
    assert a.knows("b") and b.knows(dialler) and len(a.ups) == len(a.downs) + 1
    assert len(memory_rig.network.pipes) == 1


def test_what_is_behind_routers_and_what_is_not():
    def reach(address):
        return Reach.ROUTERS if address.startswith("zenoh://") else reach_of(address)

    every = (LOCAL, LOOPBACK, FIELD, "zenoh://a:1")
    assert reachable_from("zenoh://1f:0", every, reach) == ("zenoh://a:1",), "a network is not seen from behind routers"
    assert reachable_from("tcp://10.0.0.9:5", every, reach) == (FIELD, "zenoh://a:1")
    assert nameable_from("zenoh://1f:0", every, reach) == ("zenoh://a:1",), "nor may one behind them name what is in it"


class RoutedWays:
    """What a transport says of addresses, of which some go through routers."""

    def facts(self, address):
        return (
            TransportFacts(Reach.ROUTERS, cost=14.0)
            if address.startswith("zenoh://")
            else TransportFacts(reach_of(address))
        )

    def reach(self, address):
        return self.facts(address).reach


@pytest.mark.parametrize(
    ("remote", "listens", "told"),
    [
        ("tcp://10.0.0.9:5", ("tcp://10.0.0.9:1",), ("tcp://10.0.0.3:1",)),  # of that behind routers alone, nothing
        ("tcp://10.0.0.9:5", ("tcp://10.0.0.9:1", "zenoh://n:1"), ("tcp://10.0.0.3:1", "zenoh://far:1")),
        ("zenoh://1f:0", ("zenoh://n:1",), ("zenoh://both:1", "zenoh://far:1")),
        ("zenoh://1f:0", (), ("zenoh://both:1", "zenoh://far:1")),  # it dialled, and listens nowhere
    ],
)
def test_a_gateway_tells_each_side_what_that_side_can_dial(remote, listens, told):
    said: list[tuple[AgentSeen, ...]] = []
    hello = Identity("n", "journal").hello(listens)
    session: Any = types.SimpleNamespace(hello=hello, remote=remote, number=1)
    links: Any = [session]
    ways: Any = RoutedWays()
    gossiper = Gossiper("agent", links, lambda session, message: said.append(message.agents), ways, None)
    both = ("zenoh://both:1", "tcp://10.0.0.3:1")  # in any order: the cheapest way is told
    agents = [("both", both, 0.0), ("far", ("zenoh://far:1",), 0.0)]
    peers: Any = types.SimpleNamespace(gossip=lambda: agents, is_news=lambda number: False)
    gossiper.on_link_up(session, peers, 0.0)
    assert tuple(it.address for it in said[0]) == told
