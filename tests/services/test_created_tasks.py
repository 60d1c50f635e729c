"""Tasks that no configuration file names: created and removed by control packets, and like any other in between."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
from services.created import COUNT, Count, Drive, count_of
from services.numbered import Sink

from pancakes.control import Configure, Create, Describe, Migrate, Migrations, Remove, Revive, Start, Stop
from pancakes.durable.record import TaskId
from pancakes.durable.register import Standing
from pancakes.mesh.memory_network import Quality
from pancakes.simulation.fleet import DISK_FULL
from pancakes.task import Task, Tick, every
from pancakes.testing import Fleet, threaded_agent


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet(seed=18, classes={"test.Count": Count, "test.Drive": Drive, "test.Sink": Sink}) as made:
        yield made


def test_a_task_is_created_with_its_settings_and_its_rate(fleet: Fleet) -> None:
    a = fleet.start("a")
    created = a.ask(COUNT)
    assert created.ok, created.reason
    assert created.result == {"task_id": "a/Count", "epoch": 1, "silent": []}
    fleet.run_for(4.05)
    assert count_of(a) == 40


def test_it_says_of_which_agents_nothing_was_heard(fleet: Fleet) -> None:
    a, _ = fleet.start("a"), fleet.start("b")
    fleet.connect()
    assert a.ask(COUNT).ok and a.ask(Remove("Count")).ok
    assert not any("is created" in line for line in a.lines("warning"))
    fleet.network.set_quality("a", "b", Quality(latency_s=1.2))
    created = a.ask(COUNT)
    assert created.ok and created.result["silent"] == ["b"]
    warned = [line for line in a.lines("warning") if "is created" in line]
    assert warned == ["a/Count is created, although nothing was heard of it from b"]


def test_it_comes_back_with_its_state_where_its_agent_ends_or_crashes(fleet: Fleet) -> None:
    a = fleet.start("a")
    assert a.ask(COUNT).ok
    fleet.run_for(2.0)
    before = count_of(a)
    fleet.stop("a")
    a = fleet.restart("a")
    assert before <= count_of(a) <= before + 2
    fleet.run_for(3.0)
    before = count_of(a)
    fleet.crash("a")
    a = fleet.restart("a")
    assert before - 12 <= count_of(a) <= before + 2
    found = a.ask(Describe("Count")).result
    assert (found["settings"], found["rate_hz"]) == ({"step": 2}, 5.0)


def test_a_stop_of_it_outlives_its_agent_and_a_start_brings_it_back(fleet: Fleet) -> None:
    a = fleet.start("a")
    assert a.ask(COUNT).ok and a.ask(Stop("Count")).ok
    fleet.stop("a")
    a = fleet.restart("a")
    assert a.running() == []
    assert a.ask(Start("Count")).ok and a.running() == ["Count"]


def test_a_crash_before_it_is_written_down_leaves_nothing_of_it(fleet: Fleet) -> None:
    a = fleet.start("a")
    a.publish("sysctrl", COUNT)
    assert not fleet.disk("a").get("record")
    while not a.events("asked", what="create"):
        assert fleet.dispatcher.step()
    fleet.crash("a")
    a = fleet.restart("a")
    assert a.running() == [] and a.ask(COUNT).ok


def test_it_moves_away_and_back_and_is_not_born_again_meanwhile(fleet: Fleet) -> None:
    a, b = fleet.start("a"), fleet.start("b")
    fleet.connect()
    assert a.ask(COUNT).ok
    fleet.run_for(2.0)
    assert a.ask(Migrate("Count", to="b")).ok
    assert b.running() == ["Count"] and count_of(b) >= 18
    fleet.stop("a")
    a = fleet.restart("a")
    fleet.connect()
    fleet.run_for(2.0)
    assert a.running() == []
    assert b.ask(Describe("Count")).result["rate_hz"] == 5.0
    fleet.run_for(10.0)
    assert b.ask(Migrate("Count", to="a")).ok
    assert a.running() == ["Count"] and b.running() == [] and count_of(a) > 100


def test_what_was_done_is_an_event_and_an_account(fleet: Fleet) -> None:
    a = fleet.start("a")
    assert a.ask(COUNT).ok and a.ask(Remove("Count")).ok
    told = [(it["kind"], it.get("what")) for it in a.events() if it.get("task") == "Count"]
    assert [it for it in told if it[0].startswith(("asked", "task_created", "task_removed"))] == [
        ("asked", "create"),
        ("task_created", None),
        ("asked", "remove"),
        ("task_removed", None),
    ]
    accounts = [(it["task_id"], it["outcome"], it["asked_by"]) for it in a.ask(Migrations()).result]
    assert accounts == [("a/Count", "created", "a/test/Probe"), ("a/Count", "removed", "a/test/Probe")]


@pytest.mark.parametrize(
    ("body", "why"),
    [
        (Create("Count", ""), "[task.Count] type: is missing"),
        (
            Create("Count", "test.Cuont"),
            "[task.Count] type: unknown task type 'test.Cuont', did you mean 'test.Count'?",
        ),
        (Create("Count", "test.Count", {"stepp": 1}), "[task.Count] settings.stepp: unknown key, did you mean 'step'?"),
        (Create("Count", "test.Count", {"step": "x"}), "[task.Count] settings.step: expected"),
        (Create("Count", "test.Count", rate_hz=-1.0), "[task.Count] rate_hz: expected"),
        (
            Create("Count", "test.Count", rate_hz=10_001.0),
            "[task.Count] rate_hz: expected a number <= 10000, not 10001",
        ),
        (Create("Count", "test.Count", keys={"guard": {"copies": 4}}), "[task.Count] guard.copies: expected"),
        (Create("Count", "test.Count", keys={"lease_s": 9.0}), "[task.Count] lease_s: unknown key"),
        (Create("Count", "test.Count", keys={"restart": {"pause_s": -1.0}}), "[task.Count] restart.pause_s: expected"),
        (Create("Count", "test.Count", keys={"start": False}), "[task.Count] start: is none of the other keys"),
        (
            Create("Count", "test.Drive"),
            "[task.Count] type: needs a device of the type motors; this agent has no device",
        ),
        (Create("a b", "test.Count"), "'a b' is not a name"),
        (Create("a/b/c/d", "test.Count"), "'a/b/c/d' is no target"),
        (Create("log/Count", "test.Count"), "a/log is a service and cannot be asked for create"),
        (Create("nothing/Count", "test.Count"), "a/nothing is not there"),
    ],
)
def test_what_cannot_be_is_said_and_nothing_is_left_of_it(fleet: Fleet, body: Create, why: str) -> None:
    a = fleet.start("a")
    refused = a.ask(body)
    assert not refused.ok and why in refused.reason, refused.reason
    assert a.running() == [] and not any("record" in name for name in fleet.disk("a"))


def test_a_dry_run_says_whether_it_would_be_and_changes_nothing(fleet: Fleet) -> None:
    a = fleet.start("a", devices={"motors": "null.motors"})
    would = Create("Drive", "test.Drive", dry_run=True)
    assert a.ask(would).result["task_id"] == "a/Drive"
    assert a.running() == [] and a.ask(Create("Other", "test.Drive")).ok
    assert "is held by" in a.ask(would).reason
    assert not a.ask(Create("X", "test.Count", {"step": "x"}, dry_run=True)).ok
    assert a.ask(Remove("Other", dry_run=True)).ok and a.running() == ["Other"]


def test_a_name_that_is_there_is_refused_here_and_elsewhere(fleet: Fleet) -> None:
    a, b = fleet.start("a", tasks={"Sink": "test.Sink"}), fleet.start("b")
    fleet.connect()
    assert a.ask(COUNT).ok
    assert a.ask(COUNT).reason == "a/client/Count is there already, and running: choose another name"
    assert a.ask(Create("Sink", "test.Count")).reason.startswith("a/client/Sink is there already")
    assert a.ask(Migrate("Count", to="b")).ok
    assert "a/Count is on b (epoch 2@b): choose another name, or end that one" in a.ask(COUNT).reason
    assert b.ask(COUNT).reason.startswith("b/client/Count is there already")
    assert b.ask(Create("Sink", "test.Sink")).ok  # each agent may have its own


def test_two_that_are_asked_for_at_once_make_one(fleet: Fleet) -> None:
    a = fleet.start("a")
    fleet.start("b")
    fleet.connect()
    first, second = a.publish("sysctrl", COUNT), a.publish("sysctrl", COUNT)
    assert a.reply_to(first).ok
    assert a.reply_to(second).reason == "a/Count is being created already"


def test_of_two_that_need_the_same_actuator_at_once_one_is_created(fleet: Fleet) -> None:
    a = fleet.start("a", devices={"motors": "null.motors"})
    fleet.start("b")
    fleet.connect()
    asked = [a.publish("sysctrl", Create(name, "test.Drive")) for name in ("One", "Two")]
    first, second = (a.reply_to(it) for it in asked)
    assert first.ok and a.running() == ["One"]
    assert second.reason.startswith("Two cannot run on a: motors is ")


def test_where_an_agent_that_may_have_it_is_cut_off_it_is_not_created_a_second_time(fleet: Fleet) -> None:
    a = fleet.start("a")
    fleet.start("b")
    fleet.connect()
    assert a.ask(COUNT).ok and a.ask(Migrate("Count", to="b")).ok
    fleet.run_for(1.0)
    fleet.crash("b")
    fleet.run_for(3.0)
    assert a.ask(COUNT).reason == (
        "a/Count is on b (epoch 2@b), as far as is known, and b is not connected: choose another name, or connect b"
    )


def test_a_task_that_is_removed_stays_away_and_a_later_one_has_a_higher_epoch(fleet: Fleet) -> None:
    a = fleet.start("a", devices={"motors": "null.motors"})
    assert a.ask(Create("Count", "test.Drive")).ok
    fleet.run_for(2.0)
    removed = a.ask(Remove("Count"))
    assert removed.ok and removed.result == {"task_id": "a/Count"}
    assert a.running() == [] and a.kernel.registry.holder("motors") == ""
    assert "has no task or service 'Count'" in a.ask(Start("Count")).reason
    fleet.crash("a")
    a = fleet.restart("a")
    assert a.running() == []
    again = a.ask(Create("Count", "test.Drive"))
    assert again.result["epoch"] == 2
    assert a.ask(Describe("Count")).result["fence"] == {"task_id": "a/Count", "epoch": 2}
    fleet.run_for(1.05)
    assert count_of(a) == 10


def test_a_task_that_stands_still_is_removed_too(fleet: Fleet) -> None:
    a = fleet.start("a")
    assert a.ask(COUNT).ok and a.ask(Stop("Count")).ok and a.ask(Remove("Count")).ok
    assert "has no task" in a.ask(Start("Count")).reason


def test_migrated_task_is_removed_and_created_again(fleet: Fleet) -> None:
    a, b = fleet.start("a"), fleet.start("b")
    fleet.connect()
    assert a.ask(COUNT).ok and a.ask(Migrate("Count", to="b")).ok
    assert b.ask(Describe("Count")).result["task_id"] == "a/Count"
    assert b.ask(Remove("Count")).ok
    assert [row for row in b.tasks() if row["task"] == "Count"] == [], "nothing is left to be started"
    created = a.ask(COUNT)
    assert created.ok and created.result["epoch"] == 3, created.reason
    fleet.run_for(2.0)
    assert a.running() == ["Count"] and b.running() == []


def test_a_task_that_a_file_names_is_not_removed(fleet: Fleet) -> None:
    a, b = fleet.start("a", tasks={"Count": "test.Count"}), fleet.start("b")
    fleet.connect()
    assert a.ask(Remove("Count")).reason.startswith(
        "a/client/Count is in the configuration of a: take [task.Count] out of its file, start a again"
    )
    assert a.ask(Migrate("Count", to="b")).ok
    assert b.ask(Remove("Count")).reason.startswith("a/Count was born from the configuration of a, ")
    assert b.running() == ["Count"]


def test_a_task_that_was_taken_out_of_the_file_is_removed(fleet: Fleet) -> None:
    fleet.start("a", tasks={"Count": "test.Count"})
    fleet.stop("a")
    a = fleet.start("a")
    assert a.running() == ["Count"] and a.ask(Remove("Count")).ok
    assert a.running() == []


def test_a_task_that_was_taken_out_of_the_file_while_it_was_away_is_removed_where_it_was_born(
    fleet: Fleet,
) -> None:
    a, b = fleet.start("a", tasks={"Count": "test.Count"}), fleet.start("b")
    fleet.connect()
    assert a.ask(Migrate("Count", to="b")).ok
    fleet.stop("a")
    a = fleet.start("a")
    fleet.connect()
    fleet.run_for(10.0)
    assert "move it to a, and remove it there" in b.ask(Remove("Count")).reason
    assert b.ask(Migrate("Count", to="a")).ok
    assert a.ask(Remove("Count")).ok and a.running() == b.running() == []


def test_a_file_that_names_a_removed_task_later_has_it_begin_anew(fleet: Fleet) -> None:
    a = fleet.start("a")
    assert a.ask(COUNT).ok and a.ask(Remove("Count")).ok
    fleet.stop("a")
    a = fleet.start("a", tasks={"Count": "test.Count"})
    assert a.running() == ["Count"]
    assert a.ask(Describe("Count")).result["fence"] == {"task_id": "a/Count", "epoch": 2}
    assert a.agent.resting == {}


def test_a_removed_task_that_a_file_names_and_does_not_start_begins_once_it_is_asked_for(fleet: Fleet) -> None:
    a = fleet.start("a")
    assert a.ask(COUNT).ok and a.ask(Remove("Count")).ok
    fleet.stop("a")
    a = fleet.start("a", tasks={"Count": {"type": "test.Count", "start": False}})
    assert a.running() == []
    assert a.ask(Start("Count")).ok
    assert a.ask(Describe("Count")).result["fence"] == {"task_id": "a/Count", "epoch": 2}


def test_a_created_task_that_a_file_names_later_goes_on_with_its_state(fleet: Fleet) -> None:
    a = fleet.start("a")
    assert a.ask(COUNT).ok
    fleet.run_for(2.0)
    before = count_of(a)
    fleet.stop("a")
    a = fleet.start("a", tasks={"Count": {"type": "test.Count", "settings": {"step": 3}}})
    assert count_of(a) >= before
    assert a.ask(Describe("Count")).result["settings"] == {"step": 3}
    assert "is in the configuration of a" in a.ask(Remove("Count")).reason


@pytest.mark.parametrize("said", [{}, {"step": 1}], ids=["no settings", "all settings"])
def test_a_created_task_keeps_what_was_set_where_a_file_that_names_it_says_what_it_began_with(
    fleet: Fleet, said: dict[str, int]
) -> None:
    a = fleet.start("a")
    assert a.ask(Create("Count", "test.Count")).ok
    assert a.ask(Configure("Count", {"step": 7})).ok
    fleet.run_for(2.0)
    fleet.stop("a")
    a = fleet.start("a", tasks={"Count": {"type": "test.Count", "settings": said}})
    assert a.ask(Describe("Count")).result["settings"] == {"step": 7}
    fleet.run_for(2.0)
    fleet.stop("a")
    a = fleet.start("a", tasks={"Count": {"type": "test.Count", "settings": {"step": 3}}})
    assert a.ask(Describe("Count")).result["settings"] == {"step": 3}


def test_devices_and_services_are_not_removed(fleet: Fleet) -> None:
    a = fleet.start("a", devices={"motors": "null.motors"})
    assert a.ask(Remove("motors")).reason == (
        "a/device/motors cannot be removed: what a/device looks after is not created"
    )
    assert "is a service: name one of its tasks" in a.ask(Remove("client")).reason


def test_what_is_created_is_in_the_configuration_that_its_agent_tells(fleet: Fleet) -> None:
    a = fleet.start("a", tasks={"Sink": "test.Sink"})
    keys = {"guard": {"copies": 3, "lease_s": 4.0}, "restart": {"policy": "no"}}
    assert a.ask(Create("Count", "test.Count", {"step": 2}, 5.0, keys)).ok
    fleet.run_for(2.0)
    tasks = a.ask(Describe(config=True)).result["config"]["task"]
    assert sorted(tasks) == ["Count", "Sink"]
    count = tasks["Count"]
    assert (count["type"], count["settings"], count["rate_hz"]) == ("test.Count", {"step": 2}, 5.0)
    assert (count["guard"]["copies"], count["guard"]["lease_s"], count["restart"]["policy"]) == (3, 4.0, "no")
    assert TaskId("a", "Count") in a.agent.records.all()


def test_while_it_is_handed_over_it_is_not_removed(fleet: Fleet) -> None:
    a, b = fleet.start("a"), fleet.start("b")
    fleet.connect()
    assert a.ask(COUNT).ok
    fleet.run_for(1.0)
    a.publish("sysctrl", Migrate("Count", to="b"))
    record = b.agent.records.get
    while (kept := record(TaskId("a", "Count"))) is None or kept.standing is not Standing.HEIR:
        assert fleet.dispatcher.step()
    assert a.ask(Remove("Count")).reason == "a/client/Count is being handed over between a and b"
    fleet.run_for(2.0)
    assert b.running() == ["Count"] and b.ask(Remove("Count")).ok


def test_where_the_disk_is_full_it_is_created_and_removed_once_it_is_not(fleet: Fleet) -> None:
    a = fleet.start("a")
    end = fleet.faults.fill_disk("a")
    waits = a.ask(COUNT)
    assert not waits.ok and f"waits: {DISK_FULL}" in waits.reason and a.running() == []
    end()
    a.wait_for_event("task_created")
    assert a.running() == ["Count"]
    fleet.run_for(2.0)
    end = fleet.faults.fill_disk("a")
    assert f"waits: {DISK_FULL}" in a.ask(Remove("Count")).reason
    end()
    a.wait_for_event("task_removed")
    assert a.running() == [] and a.ask(COUNT).ok


def test_a_removal_that_cannot_be_written_down_is_refused_and_the_task_is_there(fleet: Fleet) -> None:
    a = fleet.start("a")
    assert a.ask(COUNT).ok and a.ask(Stop("Count")).ok
    end = fleet.faults.fill_disk("a")
    assert a.ask(Remove("Count")).reason == f"a/Count is not removed: {DISK_FULL}"
    end()
    assert a.ask(Start("Count")).ok and a.running() == ["Count"]


def test_what_is_asked_of_a_task_that_is_being_removed_is_refused(fleet: Fleet) -> None:
    a = fleet.start("a")
    assert a.ask(COUNT).ok
    removal, start = a.publish("sysctrl", Remove("Count")), a.publish("sysctrl", Start("Count"))
    assert a.reply_to(start).reason == "a/Count is being removed"
    assert a.reply_to(removal).ok and a.running() == []


def test_of_a_task_whose_whereabouts_are_not_known_it_is_said(fleet: Fleet) -> None:
    a, b = fleet.start("a"), fleet.start("b")
    fleet.connect()
    assert b.ask(Revive("a/Other", "test.Count")).ok
    assert "a/Other is on b (epoch" in a.ask(Create("Other", "test.Count")).reason
    fleet.crash("b")
    fleet.run_for(3.0)
    refused = a.ask(Create("Other", "test.Count")).reason
    assert "a/Other is on b (epoch 1000000@b), as far as is known, and b is not connected" in refused


def test_after_a_removal_too_a_full_disk_puts_it_off(fleet: Fleet) -> None:
    a = fleet.start("a")
    assert a.ask(COUNT).ok and a.ask(Remove("Count")).ok
    end = fleet.faults.fill_disk("a")
    assert f"waits: {DISK_FULL}" in a.ask(COUNT).reason
    end()
    assert a.wait_for_event("task_created", epoch=2)["task"] == "Count"
    assert a.running() == ["Count"]


def test_a_peer_creates_what_it_may_change_and_host(fleet: Fleet) -> None:
    allow = '[[access.allow]]\nwho = ["b"]\nmay = {}\n'
    a = fleet.start("a", allow.format('["look", "change"]') + allow.format('["host"]') + 'on = ["test.Count"]\n')
    b = fleet.start("b")
    fleet.connect()
    assert "it lacks the right 'host' on 'test.Sink'" in b.ask(Create("Sink", "test.Sink"), to="a").reason
    assert b.ask(COUNT, to="a").ok and a.running() == ["Count"]
    c = fleet.start("c")
    fleet.connect()
    assert "it lacks the right 'change' on 'a/client/Count'" in c.ask(Remove("Count"), to="a").reason
    assert "it lacks the right 'change' on 'a/client/More'" in c.ask(Create("More", "test.Count"), to="a").reason
    assert b.ask(Remove("Count"), to="a").ok


class Stubborn(Task):
    """Fails whenever it begins."""

    def on_start(self) -> None:
        raise RuntimeError("not today")


def test_a_task_that_fails_at_once_is_there_and_can_be_removed(fleet: Fleet) -> None:
    a = fleet.start("a", classes={"test.Stubborn": Stubborn})
    failed = a.ask(Create("Stubborn", "test.Stubborn", keys={"restart": {"policy": "no"}}))
    assert not failed.ok and "a/Stubborn was created, and does not run: " in failed.reason
    assert "not today" in failed.reason and "`pancakes task remove a/Stubborn` ends it" in failed.reason
    assert a.ask(Remove("Stubborn")).ok
    assert "has no task" in a.ask(Describe("Stubborn")).reason


def test_a_device_that_does_not_run_now_is_missed(fleet: Fleet) -> None:
    a = fleet.start("a", devices={"motors": "null.motors"})
    assert a.ask(Stop("motors")).ok
    refused = a.ask(Create("Drive", "test.Drive"))
    assert refused.reason == "Drive cannot run on a: a lacks the device types motors, which Drive requires"
    assert a.ask(Start("motors")).ok and a.ask(Create("Drive", "test.Drive")).ok


ENTERED, RELEASED = threading.Event(), threading.Event()


class Waits(Task):
    """Does not come back from what it does until it is let."""

    blocking = True

    @every(hz=20)
    def wait(self, tick: Tick) -> None:
        ENTERED.set()
        RELEASED.wait(20.0)


def test_a_task_that_is_stuck_is_not_removed_until_it_has_ended() -> None:
    try:
        with threaded_agent(classes={"test.Waits": Waits}) as a:
            assert a.ask(Create("Waits", "test.Waits")).ok
            assert ENTERED.wait(10.0)
            assert "a/client/Waits is stuck" in a.ask(Remove("Waits")).reason
            RELEASED.set()
            a.wait_until(lambda: a.slot("Waits").life.at_rest, what="its end")
            assert a.ask(Remove("Waits")).ok and a.running() == []
    finally:
        RELEASED.set()
