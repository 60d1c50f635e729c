"""Tasks that outlive their agent: what the journal keeps over a stop, a crash, and an operator's word."""

from dataclasses import dataclass

import pytest

from pancakes.control import Configure, Describe, Reschedule, Start, Stop
from pancakes.devices import Load, Pose
from pancakes.durable.client_service import ClientService
from pancakes.durable.record import Record
from pancakes.durable.register import Wanted
from pancakes.journal import JournalError, MemoryJournal
from pancakes.service import Service
from pancakes.simulation.fleet import DISK_FULL
from pancakes.supervision.task_core import TaskCore
from pancakes.task import Task, TaskSpec, every, on
from pancakes.testing import Fleet, threaded_agent


class Count(Task):
    """Counts its ticks, and says each number."""

    @dataclass
    class Settings:
        step: int = 1

    @dataclass
    class State:
        n: int = 0

    @every(hz=10)
    def tick(self, tick):
        self.state.n += self.settings.step
        self.publish("system", Load(float(self.state.n)))

    @on("system", Pose)
    def fail(self, packet):
        raise RuntimeError("lost")


class Tuned(Task):
    """Has settings and does nothing."""

    @dataclass
    class Settings:
        low: int = 0
        middle: int = 0
        high: int = 0


class Switch(Task):
    """Has a state that others change, and says nothing."""

    @dataclass
    class State:
        on: bool | int | float | dict[str, list[int | float]] = False


class Still(TaskCore, Task):
    """Has no state; a pose makes it slower."""

    __module__ = "pancakes"  # its names are Pancakes' own

    times_written = 0

    def carry(self):
        self.times_written += 1
        return super().carry()

    @every(hz=10)
    def tick(self, tick):
        pass

    @on("system", Pose)
    def slow_down(self, packet):
        self.reschedule(2.0)


@pytest.fixture
def fleet():
    with Fleet(seed=4) as made:
        yield made


def records(fleet, name="a"):
    """What lies on an agent's disk, by task."""
    found = {}
    disk = {key: value for key, value in fleet.disk(name).items() if key != "lock"}
    for entry in MemoryJournal(disk, "").entries("record"):
        record = Record.decode(entry.data)
        found[record.task_id.name] = record
    return found


def test_a_change_outlives_a_failure_the_moment_after(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    fleet.run_for(2.55)  # the next checkpoint is half a second away
    assert agent.ask(Configure("Count", {"step": 2})).ok
    agent.publish("system", Pose(0.0, 0.0, 0.0))
    fleet.run_for(0.11)

    assert agent.task("Count").settings.step == 2


def test_a_stopped_agent_goes_on_where_it_was(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    fleet.run_for(2.55)
    assert agent.ask(Configure("Count", {"step": 2})).ok
    assert agent.ask(Reschedule("Count", 5.0)).ok
    fleet.run_for(1.0)
    n = agent.task("Count").state.n
    fleet.stop("a")
    fleet.run_for(60.0)
    agent = fleet.restart("a")
    assert agent.task("Count").state.n == n
    fleet.run_for(2.0)
    assert agent.task("Count").state.n == n + 2 * 10


def test_what_was_changed_in_the_file_meanwhile_goes_before_the_record_and_all_else_stays(fleet):
    def start(settings):
        return fleet.start("a", tasks={"Tuned": {"type": Tuned, "settings": settings}})

    agent = start({"low": 1, "high": 1})
    assert agent.ask(Configure("Tuned", {"low": 2, "high": 2, "middle": 2})).ok
    fleet.stop("a")
    agent = start({"low": 1, "high": 9, "middle": 5})
    assert agent.task("Tuned").settings == Tuned.Settings(low=2, middle=5, high=9)
    (said,) = [line for line in agent.lines("info") if "a/client/Tuned takes" in line]
    assert said.endswith("what has changed in its configuration: high, middle")
    fleet.stop("a")
    assert start({"low": 1, "middle": 5}).task("Tuned").settings == Tuned.Settings(low=2, middle=5)


def test_not_a_tick_is_lost_however_the_stop_falls_between_two_checkpoints():
    """The last checkpoint may have to wait until the one before it is on disk."""
    for step in range(12):
        with Fleet(seed=step) as fleet:
            agent = fleet.start("a", tasks={"Count": Count})
            fleet.run_for(2.9995 + 0.0005 * step)  # the checkpoint of the third second is being written
            n = agent.task("Count").state.n
            fleet.stop("a")
            assert fleet.restart("a").task("Count").state.n == n


def test_a_crash_costs_no_more_than_the_last_second(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    fleet.run_for(5.55)
    n = agent.task("Count").state.n
    fleet.crash("a")
    fleet.run_for(1.0)
    agent = fleet.restart("a")
    assert n - 12 <= agent.task("Count").state.n < n


def test_a_task_without_state_is_not_looked_at_again_and_again(fleet):
    task = fleet.start("a", tasks={"Still": Still}).task("Still")
    fleet.run_for(20.5)
    assert task.times_written == 1


def test_a_stop_writes_down_what_is_new_and_nothing_else(fleet):
    agent = fleet.start("a", tasks={"Still": Still, "Count": Count})
    fleet.run_for(5.53)
    before = records(fleet)
    agent.publish("system", Pose(0.0, 0.0, 0.0), to="a/client/Still")  # Count would fail on it, and begin anew
    fleet.run_for(0.01)
    fleet.stop("a")
    after = records(fleet)
    assert after["Count"] != before["Count"], "it has counted"
    assert after["Still"] != before["Still"], "it has become slower"

    fleet.restart("a")
    fleet.run_for(3.08)
    before = records(fleet)
    fleet.run_for(0.05)
    fleet.stop("a")
    assert records(fleet)["Still"] == before["Still"], "where in its period it stood is nothing new"
    assert fleet.restart("a").component("client/Still").timers["tick"].rate_hz == 2.0


def test_the_last_state_is_the_one_that_holds_also_where_another_is_still_being_written(fleet):
    """What lies on the disk is the state that it ends with, and what is on the way there is not."""
    agent = fleet.start("a", tasks={"Switch": Switch})
    fleet.run_for(2.5)
    (place,) = agent.component("client").places.values()
    agent.task("Switch").state.on = True
    assert fleet.run_until(lambda: not place.course.settled)
    agent.task("Switch").state.on = False
    fleet.stop("a")
    assert fleet.restart("a").task("Switch").state.on is False


@pytest.mark.parametrize(("before", "after"), [(1, True), (1, 1.0), (0.0, -0.0), ({"a": [2]}, {"a": [2.0]})])
def test_values_that_only_look_alike_are_new(fleet, before, after):
    agent = fleet.start("a", tasks={"Switch": Switch})
    agent.task("Switch").state.on = before
    fleet.run_for(2.5)
    agent.task("Switch").state.on = after
    fleet.stop("a")
    assert repr(fleet.restart("a").task("Switch").state.on) == repr(after)


def test_what_such_a_task_changes_by_itself_outlives_a_crash_all_the_same(fleet):
    agent = fleet.start("a", tasks={"Still": Still})
    fleet.run_for(20.5)
    agent.publish("system", Pose(0.0, 0.0, 0.0))
    fleet.run_for(1.1)
    fleet.crash("a")
    assert fleet.restart("a").component("client/Still").timers["tick"].rate_hz == 2.0


def test_no_number_of_a_packet_comes_again_in_another_life(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    fleet.run_for(3.05)
    before = agent.probe.packets(Load)
    fleet.stop("a")
    agent = fleet.restart("a")
    fleet.run_for(1.0)
    after = agent.probe.packets(Load)
    assert {it.seq for it in before}.isdisjoint(it.seq for it in after)
    assert (before[0].number, after[0].number) == (1, 1)


def test_an_operators_stop_outlives_a_reboot(fleet):
    agent = fleet.start("a", tasks={"Count": Count, "Other": Count})
    assert agent.ask(Stop("Count")).ok
    fleet.stop("a")
    agent = fleet.restart("a")
    assert agent.running() == ["Other"]
    assert agent.ask(Start("Count")).ok
    fleet.stop("a")
    assert fleet.restart("a").running() == ["Count", "Other"]


@pytest.mark.parametrize("how", ["stop", "crash"])
def test_so_does_an_operators_start(fleet, how):
    agent = fleet.start("a", tasks={"Count": {"type": Count, "start": False}})
    assert agent.ask(Start("Count", {"step": 7})).ok
    getattr(fleet, how)("a")
    agent = fleet.restart("a")
    assert agent.running() == ["Count"]
    assert agent.task("Count").settings.step == 7


def test_a_stop_is_answered_once_it_is_on_disk(fleet):
    """Whoever was told that it is stopped may rely on that, whatever dies the moment after."""
    agent = fleet.start("a", tasks={"Count": Count})
    fleet.run_for(1.05)
    assert agent.ask(Stop("Count")).ok
    fleet.crash("a")
    assert fleet.restart("a").running() == []


def test_a_stop_that_cannot_be_written_down_says_so_and_is_written_later(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    fleet.run_for(1.05)
    end = fleet.faults.fill_disk("a")
    reply = agent.ask(Stop("Count"))
    waits = f"what was asked for waits: {DISK_FULL}. It is done as soon as the journal can write"
    assert reply.reason == f"a/client/Count is stopped; {waits}"
    assert agent.running() == []
    end()
    fleet.run_for(2.0)
    fleet.crash("a")
    assert fleet.restart("a").running() == []


def test_a_stop_while_a_task_is_being_restarted_outlives_a_reboot(fleet):
    agent = fleet.start("a", tasks={"Count": {"type": Count, "restart": {"at_most": 9, "pause_s": 0.0}}})
    agent.publish("system", Pose(0.0, 0.0, 0.0))
    fleet.run_for(0.0005)  # it has failed; that it is to run again is being written
    assert agent.ask(Stop("Count")).ok
    assert agent.running() == []
    fleet.stop("a")
    assert fleet.restart("a").running() == []


def test_a_task_that_was_given_up_stays_given_up(fleet):
    agent = fleet.start("a", tasks={"Count": {"type": Count, "restart": {"policy": "no"}}})
    fleet.run_for(3.55)
    agent.publish("system", Pose(0.0, 0.0, 0.0))
    fleet.run_for(0.1)
    fleet.stop("a")
    assert records(fleet)["Count"].wanted is Wanted.FAILED
    agent = fleet.restart("a")
    assert agent.running() == []
    # Its last checkpoint is still good.
    assert agent.ask(Start("Count")).ok
    assert agent.task("Count").state.n >= 25


def test_a_failed_task_begins_from_its_checkpoint(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    fleet.run_for(5.55)
    n = agent.task("Count").state.n
    agent.publish("system", Pose(0.0, 0.0, 0.0))
    fleet.run_for(0.12)
    assert n - 12 <= agent.task("Count").state.n < n
    assert agent.slot("Count").life.incarnation > 1


def test_stopping_the_client_service_is_no_stop_of_its_tasks(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    fleet.run_for(1.05)
    assert agent.ask(Stop("client")).ok
    fleet.crash("a")
    agent = fleet.restart("a")
    assert agent.running() == ["Count"]
    assert agent.task("Count").state.n >= 10


def test_a_client_service_that_fails_loses_no_task(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    fleet.run_for(3.05)

    def fail():
        raise RuntimeError("the service itself")

    agent.may_fail.add("client")
    agent.component("client").call(fail)
    fleet.run_for(1.0)
    assert agent.events("service_failed", service="client")
    assert agent.task("Count").state.n >= 30


def test_a_service_says_with_which_tasks_it_has_started(fleet):
    lines = fleet.start("a", tasks={"Count": Count}).lines("debug")
    assert "a/client started with Count" in lines and "a/device started with no tasks" in lines


def test_a_journal_that_is_in_use_is_not_shared(fleet):
    fleet.start("a")
    with pytest.raises(JournalError, match="two agents cannot share one"):
        fleet.start_config(fleet.agents["a"].agent.config)


def test_a_state_directory_that_is_in_use_is_not_shared(tmp_path):
    with threaded_agent("a", tasks={"Count": Count}, state_dir=tmp_path / "a") as agent:
        assert agent.running() == ["Count"]
        with pytest.raises(JournalError, match="is in use"), threaded_agent("a", state_dir=tmp_path / "a"):
            pass
    with threaded_agent("a", tasks={"Count": Count}, state_dir=tmp_path / "a") as agent:
        assert agent.ask(Stop("Count")).ok
    with threaded_agent("a", tasks={"Count": Count}, state_dir=tmp_path / "a") as agent:
        assert agent.running() == []


def test_on_threads_the_state_outlives_the_agent(tmp_path):
    with threaded_agent("a", tasks={"Count": Count}, state_dir=tmp_path, speed=20.0) as agent:
        agent.wait_for(Load, lambda load: load.cpu >= 20)
    n = int(agent.probe.packets(Load)[-1].body.cpu)
    with threaded_agent("a", tasks={"Count": {"type": Count, "rate_hz": 0.001}}, state_dir=tmp_path) as agent:
        assert agent.ask(Describe("Count")).ok
        assert agent.task("Count").state.n >= n


class Fields(ClientService):
    """A user's own service whose tasks are durable; it brings one itself."""

    def own_tasks(self):
        return [TaskSpec("Own", Count, type="test.Count")]


def test_a_users_own_service_may_keep_durable_tasks_its_own_among_them(fleet):
    tasks = {"Count": {"type": Count, "service": "fields"}}
    agent = fleet.start("a", tasks=tasks, services={"fields": Fields})
    assert isinstance(agent.component("fields").facade, Service)
    assert agent.running("fields") == ["Own", "Count"]
    fleet.run_for(2.05)
    assert agent.ask(Stop("fields/Own")).ok
    fleet.stop("a")
    agent = fleet.restart("a")
    assert agent.running("fields") == ["Count"]
    assert agent.task("Count", "fields").state.n == 20
    assert agent.ask(Start("fields/Own")).ok
    assert agent.task("Own", "fields").state.n == 20
