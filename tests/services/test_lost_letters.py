"""What a sender is told where packets that were acknowledged are lost with the agent that had the task."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from services.numbered import SINK, Numbered, Sink, Source, numbers, upto

from pancakes.control import Guarding, Migrate, Revive, Start, Stop
from pancakes.durable.courier import COURIER
from pancakes.durable.delivery import StreamsBegan
from pancakes.testing import Fleet

GUARDED = {"type": "test.Sink", "guard": {"copies": 3, "lease_s": 2.0, "checkpoint_s": 30.0, "guardians": ["b", "c"]}}


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with made(GUARDED) as fleet:
        assert fleet.run_until(lambda: is_guarded(fleet), 10)
        yield fleet


def made(sink: dict[str, Any]) -> Fleet:
    fleet = Fleet(seed=5, classes={"test.Sink": Sink, "test.Source": Source})
    fleet.start("a", tasks={"Sink": sink})
    for name in "bc":
        fleet.start(name)
    fleet.start("d", tasks={"Source": {"type": "test.Source", "start": False}})
    fleet.connect()
    return fleet


def is_guarded(fleet: Fleet) -> bool:
    rows = fleet.agents["a"].ask(Guarding()).result
    return len(rows) == 1 and len(rows[0]["guardians"]) == 3


def send(fleet: Fleet, *seqs: int) -> None:
    for n in seqs:
        fleet.agents["d"].publish("system", Numbered(n), to=SINK)
    fleet.run_for(1.0)


def told(fleet: Fleet, name: str = "d") -> list[tuple[Any, ...]]:
    """What an agent has said of lost packets: the task, the sender, the first and the last one."""
    events = fleet.agents[name].events("packets_lost")
    return [(it["task"], it["sender"], it["first"], it["last"]) for it in events]


def waiting(fleet: Fleet) -> dict[str, int]:
    found: dict[str, int] = fleet.agents["d"].agent.outbox.waiting()
    return found


def test_a_sender_that_says_nothing_more_is_told_what_may_be_lost(fleet: Fleet):
    send(fleet, *upto(20))
    assert not waiting(fleet)
    fleet.crash("a")
    fleet.run_for(8.0)
    assert numbers(fleet) == []
    assert told(fleet) == [("a/Sink", "d", 1, 20)]
    (line,) = [line for line in fleet.agents["d"].lines("warning") if "packets 1 to 20" in line]
    assert "that d has sent to a/Sink may be lost: they were acknowledged" in line
    send(fleet, 21, 22)
    fleet.run_for(3.0)
    assert numbers(fleet) == [21, 22] and len(told(fleet)) == 1


def test_what_a_checkpoint_at_the_guardians_has_is_not_lost(fleet: Fleet):
    send(fleet, *upto(5))
    fleet.run_for(35.0)
    send(fleet, 6, 7)
    fleet.crash("a")
    fleet.run_for(8.0)
    assert numbers(fleet) == upto(5) and told(fleet) == [("a/Sink", "d", 6, 7)]


def test_a_sender_that_was_cut_off_meanwhile_is_told_once_it_is_linked(fleet: Fleet):
    send(fleet, *upto(3))
    fleet.faults.cut("d")
    fleet.crash("a")
    fleet.run_for(10.0)
    assert told(fleet) == []
    fleet.faults.calm()
    fleet.run_for(12.0)
    assert told(fleet) == [("a/Sink", "d", 1, 3)]


def test_one_that_goes_on_sending_is_told_too_and_what_it_sends_arrives(fleet: Fleet):
    send(fleet, *upto(3))
    fleet.crash("a")
    send(fleet, 4, 5, 6)
    assert waiting(fleet) == {"a/Sink": 3}
    fleet.run_for(12.0)
    assert numbers(fleet) == [4, 5, 6] and told(fleet) == [("a/Sink", "d", 1, 3)] and not waiting(fleet)


def test_a_task_that_sends_is_named(fleet: Fleet):
    d = fleet.agents["d"]
    assert d.ask(Start("client/Source")).ok
    fleet.run_for(1.0)
    fleet.crash("a")
    fleet.run_for(8.0)
    assert d.ask(Stop("client/Source")).ok
    ((task, sender, first, last),) = told(fleet)
    assert (task, sender, first) == ("a/Sink", "d/Source", 1)
    fleet.run_for(3.0)
    found = numbers(fleet)
    assert found is not None and found[0] == last + 1


def test_nothing_is_lost_where_each_is_acknowledged_at_a_quorum():
    with made({**GUARDED, "durability": "each"}) as fleet:
        assert fleet.run_until(lambda: is_guarded(fleet), 10)
        send(fleet, *upto(20))
        fleet.crash("a")
        fleet.run_for(8.0)
        assert numbers(fleet) == upto(20) and told(fleet) == []


@pytest.mark.parametrize("sink", [GUARDED, {"type": "test.Sink"}], ids=["guarded", "unguarded"])
def test_a_move_loses_nothing(sink: dict[str, Any]):
    with made(sink) as fleet:
        fleet.run_for(6.0)
        send(fleet, *upto(5))
        assert fleet.agents["a"].ask(Migrate("Sink", to="b")).ok
        send(fleet, 6)
        assert fleet.agents["b"].ask(Migrate("Sink", to="c")).ok
        send(fleet, 7)
        fleet.run_for(3.0)
        assert numbers(fleet) == upto(7) and told(fleet) == []


def test_a_task_that_is_revived_without_its_state_has_lost_all():
    with made({"type": "test.Sink"}) as fleet:
        send(fleet, *upto(5))
        fleet.crash("a")
        fleet.run_for(3.0)
        assert fleet.agents["b"].ask(Revive("a/Sink", "test.Sink")).ok
        fleet.run_for(3.0)
        assert told(fleet) == [("a/Sink", "d", 1, 5)]


def test_an_agent_that_was_not_asked_is_not_believed(fleet: Fleet):
    send(fleet, *upto(5))
    (stream,) = fleet.agents["a"].component("client/Sink").carry().heard
    fleet.agents["c"].publish("network", StreamsBegan("a/Sink", 9, {stream: 0}), to=f"d/{COURIER}")
    fleet.run_for(1.0)
    assert told(fleet) == []


@pytest.mark.parametrize("speaks", [False, True], ids=["says nothing more", "goes on"])
def test_sender_is_told_after_each_crash_of_one_agent(speaks: bool):
    """The task stays under its epoch, and begins from its last checkpoint: what came since is gone."""
    with made({"type": "test.Sink"}) as fleet:
        expected: list[tuple[Any, ...]] = []
        sent = 0
        for _ in range(3):
            send(fleet, *range(sent + 1, sent + 4))
            fleet.run_for(3.0)
            fleet.faults.fill_disk("a")
            send(fleet, *range(sent + 4, sent + 7))
            assert not waiting(fleet)
            fleet.crash("a")
            fleet.faults.calm()
            fleet.restart("a")
            fleet.connect()
            expected.append(("a/Sink", "d", sent + 4, sent + 6))
            sent += 6
            if speaks:
                send(fleet, sent + 1)
                sent += 1
            fleet.run_for(5.0)
            assert told(fleet) == expected


def test_sender_is_told_nothing_if_an_agent_ends_in_good_order():
    with made({"type": "test.Sink"}) as fleet:
        send(fleet, *upto(5))
        fleet.stop("a")
        fleet.restart("a")
        fleet.connect()
        send(fleet, 6)
        fleet.run_for(5.0)
        assert told(fleet) == [] and numbers(fleet) == upto(6)
