"""A guarded task outlives its agent: another one goes on with it, from what the guardians hold; never do two act."""

from typing import Any

import pytest
from services.counting import Count
from services.numbered import SINK, Numbered, Sink, numbers, upto

from pancakes.control import Create, Guarding, Migrate, Stop, Take
from pancakes.durable.messages import REGISTRAR, Call, addressed
from pancakes.durable.record import TaskId
from pancakes.durable.register import Epoch, Identity, Standing
from pancakes.durable.register_messages import Guarded
from pancakes.durable.takeovers import CALLED_S
from pancakes.errors import NoPermitError
from pancakes.events import Event
from pancakes.events import record_of as record_of_log
from pancakes.journal.journal import MARK
from pancakes.migration import GuardRule
from pancakes.packet import number_in_life
from pancakes.testing import Fleet

COUNT = TaskId("a", "Count")
GUARDED: Any = {"Count": {"type": Count, "guard": {"copies": 3, "lease_s": 4.0, "checkpoint_s": 0.5}}}


def record(fleet, name):
    return fleet.agents[name].agent.records.get(COUNT)


def record_of(fleet, name):
    return fleet.agents[name].agent.records.get(TaskId("a", "Sink"))


def guards(fleet, name="a"):
    return [sorted(one.agent for one in members) for members in record(fleet, name).register.sets]


@pytest.fixture
def fleet():
    with Fleet(seed=5, classes={"test.Count": Count}) as made:
        made.start("a", tasks=GUARDED)
        made.start("b")
        made.start("c")
        made.connect()
        yield made


@pytest.fixture
def guarded(fleet):
    assert fleet.run_until(lambda: guards(fleet) == [["a", "b", "c"]], 10)
    return fleet


def copy_of(fleet, name):
    """Returns a copy of a disk, as a backup makes one that takes a file at a time."""
    return {file: data for file, data in fleet.disk(name).items() if file not in ("lock", MARK)}


def put(fleet, name, disk):
    fleet.disk(name).clear()
    fleet.disk(name).update(disk)


def guard_row(agent):
    (row,) = agent.ask(Guarding()).result
    return row


def where(fleet):
    return [name for name, agent in fleet.agents.items() if "Count" in agent.running()]


def test_its_agent_chooses_its_guardians(guarded):
    assert where(guarded) == ["a"]
    guarded.run_for(5.0)
    assert where(guarded) == ["a"]
    assert record(guarded, "a").epoch.n == 0


def test_another_agent_goes_on_with_it(guarded):
    guarded.run_for(3.0)
    before = record(guarded, "a").register.no
    guarded.crash("a")
    crashed_s = guarded.now()
    assert guarded.run_until(lambda: where(guarded), 10)
    took_s = guarded.now() - crashed_s
    assert before > 1 and took_s < 5.0
    (taker,) = where(guarded)
    assert record(guarded, taker).epoch.minter.agent == taker
    guarded.restart("a")
    guarded.run_for(8.0)
    assert where(guarded) == [taker]
    assert record(guarded, "a").standing is Standing.MEMBER
    assert record(guarded, taker).standing is Standing.OWNER


def test_a_take_over_is_told_as_an_arrival_with_the_state_and_by_the_guardian_that_arranged_it(guarded):
    guarded.run_for(3.0)
    guarded.crash("a")
    assert guarded.run_until(lambda: where(guarded), 10)
    (taker,) = where(guarded)
    (arrived,) = guarded.agents[taker].events("task_arrived")
    assert (arrived["task"], arrived["source_agent"]) == ("Count", "a") and arrived["state"]["n"] > 20
    packets = [packet for agent in guarded.agents.values() for packet in agent.probe.packets(Event)]
    told = [packet for packet in packets if packet.body.kind == "taken_over"]
    assert [(it.body.fields["by"], it.body.fields["source_agent"]) for it in told] == [(taker, "a")]
    assert record_of_log(told[0])["source"] in ("b/kernel/Registrar", "c/kernel/Registrar")


def test_no_guardian_that_arranged_a_take_over_fails_once_the_taker_had_its_time(guarded):
    guarded.run_for(3.0)
    guarded.crash("a")
    assert guarded.run_until(lambda: where(guarded), 10)
    guarded.run_for(CALLED_S + 1.0)
    assert [line for name in "bc" for line in guarded.agents[name].lines("error")] == []


def test_an_owner_without_enough_guardians_asks_its_neighbours_every_two_seconds():
    with Fleet(seed=5, classes={"test.Count": Count}) as fleet:
        fleet.start("a", tasks=GUARDED)
        b = fleet.start("b")
        fleet.connect()
        fleet.run_for(12.0)
        assert guards(fleet) == [["a"]]
        answers = number_in_life(b.kernel.seq_of(f"b/{REGISTRAR}").value) - 1
        assert 4 <= answers <= 7


def test_an_owner_that_restarts_within_the_lease_goes_on(guarded):
    guarded.run_for(3.0)
    guarded.crash("a")
    guarded.run_for(0.3)
    guarded.restart("a")
    assert guarded.run_until(lambda: where(guarded) == ["a"], 1.5)
    assert record(guarded, "a").epoch.n == 0


def test_an_owner_that_is_cut_off_stands_still_before_another_goes_on(guarded):
    a = guarded.agents["a"]
    guarded.run_for(3.0)
    n = a.task("Count").state.n
    assert n > 20
    guarded.faults.cut("a")
    assert guarded.run_until(lambda: a.events("permit_lost"), 5.0)
    assert any("its guardians do not answer (b, c)" in line for line in a.lines("warning"))
    assert where(guarded) == ["a"]  # it is paused
    stood = a.task("Count").state.n
    assert guarded.run_until(lambda: len(where(guarded)) == 2, 5.0)
    guarded.run_for(3.0)
    assert a.task("Count").state.n == stood
    guarded.network.heal()
    assert guarded.run_until(lambda: len(where(guarded)) == 1, 8.0)
    (taker,) = where(guarded)
    assert taker != "a" and record(guarded, "a").standing is Standing.MEMBER
    assert guarded.agents[taker].task("Count").state.n > stood - 20


def test_a_short_cut_is_no_news(guarded):
    a = guarded.agents["a"]
    guarded.run_for(2.0)
    guarded.faults.cut("b", for_s=1.0)
    guarded.faults.cut("c", for_s=1.0)
    guarded.run_for(4.0)
    assert where(guarded) == ["a"] and record(guarded, "a").epoch.n == 0
    assert not a.events("permit_lost")


def test_after_a_long_standstill_of_all_one_goes_on(guarded):
    a = guarded.agents["a"]
    guarded.run_for(2.0)
    guarded.faults.cut("b")
    guarded.faults.cut("c")
    assert guarded.run_until(lambda: a.events("permit_lost"), 5.0)
    n = a.task("Count").state.n
    guarded.run_for(30.0)
    assert where(guarded) == ["a"] and a.task("Count").state.n == n
    guarded.faults.calm()
    guarded.run_for(10.0)
    (owner,) = where(guarded)
    assert guarded.agents[owner].task("Count").state.n > n + 20


def test_it_moves_by_the_word_of_its_guardians(guarded):
    guarded.run_for(2.0)
    n = guarded.agents["a"].task("Count").state.n
    assert guarded.agents["a"].ask(Migrate("Count", to="b")).ok
    assert guarded.run_until(lambda: where(guarded) == ["b"], 5.0)
    assert guarded.agents["b"].task("Count").state.n >= n
    assert guards(guarded, "b") == [["a", "b", "c"]]
    guarded.run_for(5.0)
    assert where(guarded) == ["b"] and record(guarded, "a").standing is Standing.MEMBER
    guarded.crash("b")
    assert guarded.run_until(lambda: where(guarded), 10)


@pytest.mark.parametrize("restarts", [False, True])
def test_an_agent_that_was_offered_it_drops_what_it_was_sent_where_another_has_taken_it(restarts):
    task = {"type": Count, "guard": {"copies": 3, "lease_s": 2.0, "guardians": ["c", "d"]}}
    with Fleet(seed=5, classes={"test.Count": Count}) as fleet:
        fleet.start("a", tasks={"Count": task})
        for name in "bcd":
            fleet.start(name)
        fleet.connect()
        assert fleet.run_until(lambda: guards(fleet) == [["a", "c", "d"]], 10)
        fleet.faults.delay("a", "b", 0.1)
        fleet.agents["a"].publish("sysctrl", Migrate("Count", to="b"))
        assert fleet.run_until(lambda: (found := record(fleet, "b")) and found.standing is Standing.HEIR, 10)
        fleet.crash("a")
        fleet.faults.cut("b")
        assert fleet.run_until(lambda: where(fleet), 10)
        (taker,) = where(fleet)
        if restarts:
            fleet.crash("b")
            fleet.restart("b")
        fleet.run_for(10.0)
        assert taker != "b" and record(fleet, "b").standing is Standing.HEIR  # it cannot know
        fleet.network.heal()
        assert fleet.run_until(lambda: record(fleet, "b").standing is Standing.RELEASED, 10)
        assert record(fleet, "b").peer == taker and record(fleet, "b").snapshot == b""
        dropped = f"a/Count runs on {taker}: what a has sent of it is dropped"
        assert [line for line in fleet.agents["b"].lines("info") if "dropped" in line] == [dropped]
        fleet.restart("a")
        fleet.run_for(10.0)
        assert where(fleet) == [taker] and record(fleet, "a").standing is Standing.MEMBER
        assert fleet.agents[taker].ask(Migrate("Count", to="b")).ok
        assert fleet.run_until(lambda: where(fleet) == ["b"], 5.0)


def test_a_goodbye_ends_the_wait(guarded):
    guarded.run_for(2.0)
    n = guarded.agents["a"].task("Count").state.n
    guarded.stop("a")
    assert guarded.run_until(lambda: where(guarded), 1.5)
    (taker,) = where(guarded)
    assert guarded.agents[taker].task("Count").state.n >= n


@pytest.mark.parametrize("after_s", [0.0, 0.05, 0.3, 1.0])
def test_a_packet_that_was_acknowledged_is_not_lost_with_the_owner(after_s):
    with Fleet(seed=3) as fleet:
        sink = {"type": Sink, "guard": {"copies": 3, "lease_s": 2.0}, "durability": "each"}
        fleet.start("a", tasks={"Sink": sink})
        fleet.start("b")
        fleet.start("c")
        fleet.connect()
        assert fleet.run_until(lambda: len(record_of(fleet, "a").members) == 3, 10)
        fleet.run_for(1.0)
        for n in upto(20):
            fleet.agents["c"].publish("system", Numbered(n), to=SINK)
            fleet.run_for(0.02)
        fleet.run_for(after_s)
        fleet.crash("a")
        for n in upto(40)[20:]:
            fleet.agents["c"].publish("system", Numbered(n), to=SINK)
        fleet.run_for(20.0)
        assert numbers(fleet) == upto(40)
        assert not fleet.agents["c"].agent.outbox.waiting()


def test_task_goes_on_if_its_offer_to_a_guardian_cannot_be_written(guarded):
    """What its agent remembers of the offer is undone with it, or it would never count leases again."""
    guarded.run_for(1.0)
    calm = guarded.faults.fill_disk("a")
    refused = guarded.agents["a"].ask(Migrate("Count", to="b"))
    assert not refused.ok and "no space" in refused.reason
    calm()
    guarded.run_for(3.0)
    before = guarded.agents["a"].task("Count").state.n
    guarded.run_for(1.0)
    assert guarded.agents["a"].task("Count").state.n > before and record(guarded, "a").epoch.n == 0


def test_a_guardian_that_is_called_while_it_writes_something_else_runs_the_task(guarded):
    """What it writes still knows no service for the task, and must not make it forget the one of the call."""
    b = guarded.agents["b"]
    assert guarded.agents["c"].ask(Create("Other", "test.Count")).ok  # so b bids less
    guarded.run_for(2.0)
    guarded.faults.slow_disk("b", 8.0)
    guarded.run_for(1.0)  # it writes what its owner has sent last
    guarded.crash("a")
    assert guarded.run_until(lambda: b.events("task_called"), 10)
    guarded.faults.calm()
    guarded.run_for(10.0)
    assert record(guarded, "b").owned and where(guarded) == ["b"]


def test_a_lease_that_a_service_changes_while_its_task_is_written_holds(guarded):
    guarded.run_for(2.0)
    guarded.faults.slow_disk("a", 2.0)
    guarded.run_for(1.0)  # a checkpoint is being written
    a, rule = guarded.agents["a"], GuardRule(copies=3, lease_s=6.0, checkpoint_s=0.5)
    a.kernel.tell(REGISTRAR, Guarded(COUNT, "test.Count", rule, guarded.now()))
    guarded.faults.calm()
    guarded.run_for(5.0)
    assert record(guarded, "a").lease_s == 6.0 and where(guarded) == ["a"]


def test_a_task_whose_guardians_are_being_changed_is_not_paused_to_be_moved(fleet):
    for name in "bc":
        fleet.faults.slow_disk(name, 0.5)
    a = fleet.agents["a"]
    assert fleet.run_until(lambda: len(guards(fleet)) == 2, 10)
    answer = a.ask(Migrate("Count", to="b"))
    assert not answer.ok and "the guardians of a/Count are being changed" in answer.reason
    assert not a.events("handoff_failed") and where(fleet) == ["a"]
    assert guard_row(a)["changing"]
    fleet.faults.calm()
    assert fleet.run_until(lambda: len(guards(fleet)) == 1, 10)
    assert a.ask(Migrate("Count", to="b")).ok


def test_a_stopped_task_is_not_taken_over(guarded):
    guarded.run_for(2.0)
    assert guarded.agents["a"].ask(Stop("client/Count")).ok
    guarded.run_for(1.0)
    guarded.crash("a")
    guarded.run_for(8.0)
    assert where(guarded) == []
    assert not record(guarded, "b").owned and not record(guarded, "c").owned


@pytest.mark.parametrize("off", [("a",), ("a", "c")], ids=["from the owner", "from all"])
def test_a_guardian_that_is_alone_with_its_opinion_calls_no_agent(guarded, off):
    guarded.faults.cut("b", off=off)
    guarded.run_for(12.0)
    asked = [agent.events("migration_bid") for agent in guarded.agents.values()]
    assert asked == [[], [], []] and where(guarded) == ["a"]


def test_a_task_without_a_permit_publishes_nothing_but_log_lines(guarded):
    a = guarded.agents["a"]
    task, core = a.task("Count"), a.component("client/Count")
    a.kernel.permits.revoke(core.fence)
    with pytest.raises(NoPermitError, match="a/client/Count may not act until its guardians answer"):
        task.publish("system", Numbered(1))
    task.log("info", "said all the same")
    guarded.run_for(0.1)
    assert any("said all the same" in line for line in a.lines("info"))


def test_a_person_has_a_task_taken_over_that_waits_for_one():
    with Fleet(seed=5, classes={"test.Count": Count}) as fleet:
        fleet.start("a", tasks={"Count": {"type": Count, "guard": {**GUARDED["Count"]["guard"], "takeover": "ask"}}})
        fleet.start("b")
        fleet.start("c")
        fleet.connect()
        assert fleet.run_until(lambda: guards(fleet) == [["a", "b", "c"]], 10)
        b = fleet.agents["b"]
        assert "a has a lease on it" in b.ask(Take("Count")).reason
        assert "does not guard Nope, but a/Count" in b.ask(Take("Nope")).reason
        fleet.crash("a")
        fleet.run_for(10.0)
        assert where(fleet) == []
        assert any("waits for you" in line for line in b.lines("warning"))
        would = b.ask(Take("Count", dry_run=True))
        assert would.ok and would.result["winner"] in "bc" and where(fleet) == []
        took = b.ask(Take("Count"))
        assert took.ok and fleet.run_until(lambda: where(fleet) == [took.result["winner"]], 5)


def test_what_guardians_know_can_be_asked(guarded):
    guarded.run_for(3.0)
    (owner,) = guarded.agents["a"].ask(Guarding()).result
    assert owner["owner"] == "a" and owner["guardians"] == ["a", "b", "c"]
    assert 1.0 < owner["permit_s"] <= 3.6 and owner["lease"]
    (row,) = guarded.agents["b"].ask(Guarding()).result
    assert row["checkpoint"] > 1 and row["age_s"] < 1.0 and row["silent_s"] < 1.0
    assert "guardians" not in row
    guarded.crash("a")
    guarded.run_for(1.0)
    refused = guarded.agents["b"].ask(Take("Count")).reason
    assert "a has a lease on it" in refused


def test_the_guardian_of_its_owner_alone_tells_what_the_owner_knows(guarded):
    assert guarded.agents["a"].ask(Migrate("Count", to="c")).ok
    guarded.run_for(3.0)
    rows = {name: guard_row(agent) for name, agent in guarded.agents.items()}
    assert {row["owner"] for row in rows.values()} == {"c"}
    assert [name for name, row in rows.items() if "guardians" in row] == ["c"]


def test_calls_to_take_made_up_tasks_leave_nothing(guarded):
    b, c = guarded.agents["b"], guarded.agents["c"]
    members, epoch = record(guarded, "a").register.sets, Epoch(5, Identity("c", c.agent.mesh.identity.journal))
    entries = b.component("kernel/Registrar").entries
    for n in range(100):
        call = Call(TaskId("c", f"Made{n}"), "test.Count", "client", epoch, members)
        c.publish("network", addressed(call, b.agent.mesh.identity.journal), to=f"b/{REGISTRAR}")
    guarded.run_for(0.5)
    assert 0 < len(entries) - 1 <= 64
    guarded.run_for(5.0)
    assert list(entries) == [COUNT]
    assert where(guarded) == ["a"]


def test_an_owner_whose_disk_was_restored_goes_on_from_what_the_guardians_have(guarded):
    before = {file: data for file, data in guarded.disk("a").items() if file != "lock"}
    guarded.run_for(5.0)
    n = guarded.agents["a"].task("Count").state.n
    guarded.crash("a")
    guarded.disk("a").clear()
    guarded.disk("a").update(before)
    a = guarded.restart("a")
    assert guarded.run_until(lambda: where(guarded), 12)
    (owner,) = where(guarded)
    assert guarded.agents[owner].task("Count").state.n >= n - 10
    assert any("is an old copy" in line for line in a.lines("error"))
    guarded.run_for(5.0)
    assert where(guarded) == [owner]


def test_guardians_of_which_one_is_a_copy_and_the_other_has_lagged_do_not_go_on_without_what_was_kept(guarded):
    c = guarded.agents["c"]
    copy = copy_of(guarded, "b")
    guarded.run_for(1.0)
    guarded.faults.cut("c", off=("a",))
    guarded.run_for(5.0)
    n, kept = guarded.agents["a"].task("Count").state.n, record(guarded, "a").register.no
    guarded.crash("a")
    guarded.crash("b")
    guarded.faults.calm()
    guarded.run_for(12.0)
    put(guarded, "b", copy)
    guarded.restart("b")
    guarded.connect()
    guarded.run_for(20.0)
    assert where(guarded) == [] and guard_row(c)["checkpoint"] < kept - 5
    guarded.restart("a")
    assert guarded.run_until(lambda: where(guarded) == ["a"], 10)
    assert guarded.agents["a"].task("Count").state.n >= n - 10


def test_a_task_does_not_go_on_from_a_copy_of_its_owners_disk_but_from_what_the_guardians_have(guarded):
    guarded.run_for(2.0)
    n = guarded.agents["a"].task("Count").state.n
    guarded.crash("a")
    del guarded.disk("a")[MARK]
    a = guarded.restart("a")
    assert any("a/Count is paused on a, whose disk is a copy: its guardians (b, c)" in it for it in a.lines("warning"))
    assert guarded.run_until(lambda: where(guarded), 12)
    (owner,) = where(guarded)
    assert record(guarded, owner).epoch.n > 0 and guarded.agents[owner].task("Count").state.n >= n - 10
    copy = a.agent.mesh.identity.copy

    def guards_again():
        return copy in [it.copy for members in record(guarded, owner).register.sets[-1:] for it in members]

    assert guarded.run_until(guards_again, 75.0), "the guardian that it was is gone for a minute"
    assert where(guarded) == [owner]


def test_a_task_that_was_not_guarded_is_guarded_on_a_copy_too():
    with Fleet(seed=5, classes={"test.Count": Count}) as fleet:
        fleet.start("a", tasks={"Count": Count})
        fleet.start("b")
        fleet.start("c")
        fleet.connect()
        fleet.run_for(2.0)
        fleet.crash("a")
        del fleet.disk("a")[MARK]
        fleet.start("a", tasks=GUARDED)
        fleet.connect()
        assert fleet.run_until(lambda: guards(fleet) == [["a", "b", "c"]], 10)
        fleet.crash("a")
        fleet.restart("a")
        assert fleet.run_until(lambda: where(fleet) == ["a"], 2.0), "it is the owner by this copy"


def test_a_guardian_whose_disk_is_full_tells_an_owner_what_it_was_told(guarded):
    """The owner comes back with an old disk, and hears that one alone: it does not go on as if nothing were lost."""
    b, c = guarded.agents["b"], guarded.agents["c"]
    guarded.run_for(3.0)
    make_room = guarded.faults.fill_disk("b")
    guarded.run_for(2.0)
    before = {file: data for file, data in guarded.disk("a").items() if file != "lock"}
    guarded.run_for(3.0)
    had = guard_row(b)["checkpoint"]
    assert guard_row(c)["checkpoint"] > had + 2
    guarded.crash("a")
    guarded.crash("c")
    guarded.run_for(12.0)  # what b was to write is given up
    make_room()
    assert guard_row(b)["checkpoint"] == had
    guarded.disk("a").clear()
    guarded.disk("a").update(before)
    a = guarded.restart("a")
    guarded.run_for(3.0)
    assert any("the disk of a is an old copy" in line for line in a.lines("error"))
    assert not a.events("permit_given"), "a and b are a quorum, and what c holds is newer"


def test_a_guardian_that_denies_leases_for_a_minute_is_replaced(guarded):
    guarded.crash("b")
    disk = guarded.disk("b")
    name = "record.a%2FCount.rec"
    disk[name] = disk[name][:-3] + b"???"
    b = guarded.restart("b")
    guarded.start("d")
    guarded.connect()
    assert any("a/Count" in line for line in b.lines("error"))
    guarded.run_for(50.0)
    assert guards(guarded) == [["a", "b", "c"]]
    assert guarded.run_until(lambda: guards(guarded) == [["a", "c", "d"]], 20)


@pytest.mark.parametrize("name", ["a", "b"], ids=["its owner", "a guardian"])
def test_an_agent_that_guards_a_task_sleeps_for_half_a_lease_at_most(guarded, name):
    guarded.run_for(1.0)
    agent = guarded.agents[name]
    for for_s in (2.5, None):
        assert "must not sleep longer than 2 s of the host's time, because this agent guards a/Count" in (
            agent.ask(Stop("network", for_s=for_s)).reason
        )
    assert agent.ask(Stop("network", for_s=1.5)).ok
    guarded.run_for(4.0)
    assert where(guarded) == ["a"] and record(guarded, "a").epoch.n == 0
    assert not guarded.agents["a"].events("permit_lost")


def test_an_agent_that_guards_no_task_any_more_sleeps_as_it_likes(guarded):
    guarded.run_for(1.0)
    assert guarded.agents["a"].ask(Stop("client/Count")).ok
    guarded.crash("a")
    guarded.run_for(5.0)
    assert guarded.agents["b"].ask(Stop("network")).ok


def test_restored_disk_takes_a_task_born_elsewhere(fleet):
    """It was born elsewhere, and nobody else can run it: c keeps it, paused, as an old copy, and is called."""
    for name in "de":
        fleet.start(name, role="environment")
    fleet.connect()
    assert fleet.run_until(lambda: len(guards(fleet)[0]) == 3, 10)
    assert fleet.agents["a"].ask(Migrate("Count", to="c")).ok
    for name, left in (("a", ["b", "c", "d"]), ("b", ["c", "d", "e"])):
        fleet.crash(name)
        assert fleet.run_until(lambda left=left: guards(fleet, "c") == [left], 80)
    before = copy_of(fleet, "c")
    fleet.run_for(3.0)
    n = fleet.agents["c"].task("Count").state.n
    fleet.crash("c")
    put(fleet, "c", before)
    c = fleet.restart("c")
    fleet.connect()
    assert any("a/Count is paused on c, whose disk is a copy" in it for it in c.lines("warning"))
    assert fleet.run_until(lambda: where(fleet) == ["c"], 15)
    assert c.task("Count").state.n >= n - 10 and record(fleet, "c").standing is Standing.OWNER


def test_restored_disk_lets_go_of_a_task_taken_over(guarded):
    assert guarded.agents["a"].ask(Migrate("Count", to="c")).ok
    before = copy_of(guarded, "c")
    guarded.run_for(3.0)
    guarded.crash("c")
    put(guarded, "c", before)
    guarded.run_for(9.0)
    assert where(guarded) in (["a"], ["b"])
    (owner,) = where(guarded)
    c = guarded.restart("c")
    guarded.connect()
    guarded.run_for(75.0)
    assert where(guarded) == [owner]
    assert guarded.agents[owner].ask(Migrate("Count", to="c")).ok
    assert guarded.run_until(lambda: where(guarded) == ["c"], 5) and c.task("Count").state.n > 70
