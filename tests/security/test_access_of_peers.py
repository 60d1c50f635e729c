"""What an agent lets its peers do, where its own file says so: whole agents in virtual time."""

from __future__ import annotations

import pytest
from services.counting import Count
from services.strangers import owns, tell

from pancakes.control import Configure, Describe, Follow, Migrate, Reschedule, Revive, Shutdown, Start, Stop
from pancakes.devices import Load
from pancakes.durable.host_state import HostState
from pancakes.durable.record import TaskId
from pancakes.packet import CTRL
from pancakes.testing import Fleet

LOOK = """
[[access.allow]]
who = ["b"]
may = ["look"]
"""


def allowed(rights: str, on: str = '["*"]') -> str:
    return f'{LOOK}\n[[access.allow]]\nwho = ["role:agent"]\nmay = {rights}\non = {on}\n'


@pytest.fixture
def fleet():
    with Fleet(seed=3) as made:
        yield made


def two(fleet, access):
    a = fleet.start("a", access, tasks={"Count": Count})
    b = fleet.start("b")
    fleet.connect()
    return a, b


@pytest.mark.parametrize(
    "body", [Stop("Count"), Configure("Count", {}), Reschedule("client/Count", 1.0), Start("a/client/Count")]
)
def test_a_peer_that_may_look_changes_nothing(fleet, body):
    a, b = two(fleet, LOOK)
    reply = b.ask(body, to="a")
    assert not reply.ok
    lacks = "a does not let b (agent) do this: it lacks the right 'change' on 'a/client/Count'"
    assert reply.reason == f"{lacks} (the [access] of its own file)"
    assert a.running("client") == ["Count"]
    assert b.ask(Describe("Count"), to="a").ok
    assert b.ask(Stop("Count", dry_run=True), to="a").ok, "a dry run needs no more than to look"
    assert a.ask(Stop("Count")).ok, "to itself an agent may do all"


def test_a_right_is_for_what_the_rule_names_alone(fleet):
    _, b = two(fleet, allowed('["change"]', '["a/client/*"]'))
    assert b.ask(Reschedule("Count", 2.0), to="a").ok
    refused = b.ask(Reschedule("network/Discovery", 2.0), to="a")
    assert not refused.ok and "'change' on 'a/network/Discovery'" in refused.reason


def test_the_right_to_move_is_for_a_task_too(fleet):
    a, b = two(fleet, allowed('["move"]', '["a/client/*"]'))
    assert b.ask(Migrate("Count", to="b"), to="a").ok
    fleet.run_for(1.0)
    assert b.running("client") == ["Count"] and a.running("client") == []


def test_whole_services_and_the_agent_have_names_too(fleet):
    _, b = two(fleet, allowed('["change", "end"]', '["a/log/*", "a"]'))
    assert b.ask(Stop("log", dry_run=True), to="a").ok
    assert "'change' on 'a/device/'" in b.ask(Stop("device"), to="a").reason
    assert "it does not run as a process of its own" in b.ask(Shutdown(), to="a").reason


def test_a_peer_without_the_right_to_look_sees_nothing(fleet):
    _, b = two(fleet, '[[access.allow]]\nwho = ["c"]\nmay = ["look"]\n')
    for body in (Describe(), Follow("log")):
        assert "it lacks the right 'look' on 'a'" in b.ask(body, to="a").reason


def test_what_the_file_refuses_no_peer_may(fleet):
    a, b = two(fleet, '[access]\nrefuse = ["change"]\n')
    assert b.ask(Stop("Count"), to="a").reason == "a lets no peer do this: its own file refuses the right 'change'"
    assert a.ask(Stop("Count")).ok


def test_commands_and_packets_without_the_right_are_dropped(fleet):
    channels = "[channel.chat]\n[channel.map]\n"
    a = fleet.start("a", channels + allowed('["publish"]', '["chat"]'))
    b = fleet.start("b", channels)
    fleet.connect()
    for channel in ("map", CTRL, "chat"):
        b.publish(channel, Load(0.5), to="a")
    a.wait_for(Load)
    assert [packet.channel for packet in a.probe.packets(Load)] == ["chat"]
    assert any("b (agent) do this: it lacks the right 'publish' on 'map'" in line for line in a.lines("warning"))


def without_host(fleet):
    """Return an agent with a task, and a neighbour that takes no tasks of its type."""
    a = fleet.start("a", tasks={"Count": Count})
    takes_others = '[[access.allow]]\nwho = ["a"]\nmay = ["host"]\non = ["other.*"]\n'
    b = fleet.start("b", allowed('["look", "write", "publish"]') + takes_others)
    fleet.connect()
    return a, b


def test_an_agent_bids_for_tasks_alone_that_its_peer_may_give_it(fleet):
    a, b = without_host(fleet)
    reply = a.ask(Migrate("Count", dry_run=True))
    assert not reply.ok and "b does not let a (agent) do this: it lacks the right 'host' on" in reply.reason
    assert b.events("migration_refused")
    assert not a.ask(Migrate("Count")).ok and a.running("client") == ["Count"]


def test_a_task_of_another_type_than_was_asked_for_is_not_taken(fleet, monkeypatch):
    a, b = without_host(fleet)
    monkeypatch.setattr(HostState, "refusal_of", lambda self, peer, request: None)  # as if another type had been named
    reply = a.ask(Migrate("Count"))
    assert not reply.ok and "it lacks the right 'host' on" in reply.reason
    assert a.running("client") == ["Count"] and b.running("client") == []


def test_a_letter_reaches_a_task_only_with_the_right_to_write_to_it(fleet):
    a, b = two(fleet, allowed('["publish"]') + allowed('["write"]', '["a/Other"]').replace(LOOK, ""))
    b.publish("system", Load(0.5), to="task:a/Count")
    a.wait_until(lambda: any("it lacks the right 'write' on 'a/Count'" in line for line in a.lines("warning")))
    assert a.probe.packets(Load) == []


@pytest.mark.parametrize("believed", [False, True])
def test_a_claim_counts_only_from_a_peer_that_may_host_the_task(fleet, believed):
    a, _ = two(fleet, allowed('["publish", "host"]' if believed else '["publish"]'))
    tell(fleet, "b", "a", owns(fleet, "b", TaskId("a", "Count")))
    fleet.run_for(1.0)
    assert a.running("client") == ([] if believed else ["Count"])
    refused = any("b says that it owns a/Count, and is not believed: a does not" in it for it in a.lines("warning"))
    assert refused != believed


def test_an_agent_claims_for_itself_alone(fleet):
    """A packet under another agent's name does not come in (`speaker`); a terminal is no owner."""
    a = fleet.start("a", tasks={"Count": Count})
    fleet.start("w", role="environment")
    fleet.connect()
    tell(fleet, "w", "a", owns(fleet, "w", TaskId("a", "Count")))
    fleet.run_for(1.0)
    assert a.running("client") == ["Count"] and a.events("task_disputed") == []


def test_to_revive_a_task_needs_the_right_on_the_place_that_it_gets(fleet):
    _, b = two(fleet, allowed('["adopt"]', '["a/client/Sink"]'))
    may_adopt = b.ask(Revive("c/Sink", "test.Sink"), to="a")
    assert "it lacks the right 'host' on 'test.Sink'" in may_adopt.reason
    refused = b.ask(Revive("c/Other", "test.Sink"), to="a")
    assert "it lacks the right 'adopt' on 'a/client/Other'" in refused.reason
