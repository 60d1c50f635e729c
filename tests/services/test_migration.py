"""Tasks that move: found a host, frozen, carried over with all they have, and started there; or left where they are."""

from dataclasses import dataclass

import pytest
from seeded import for_each

from pancakes.control import Configure, Describe, Migrate, Migrations, Reschedule, Restart, Start, Stop
from pancakes.devices import Battery, Load, Pose, Twist
from pancakes.durable.record import TaskId
from pancakes.durable.register import Standing
from pancakes.mesh.memory_network import Quality
from pancakes.packet import SYSCTRL
from pancakes.task import Task, every, on
from pancakes.testing import Fleet


class Circle(Task):
    """Drives, counts, and keeps what it has learnt."""

    requires = ("motors",)

    @dataclass
    class Settings:
        radius_m: float = 0.5

    @dataclass
    class State:
        n: int = 0
        centre_m: tuple[float, float] | None = None

    @every(hz=10)
    def drive(self, tick):
        self.state.n += 1
        self.publish("ctrl", Twist(0.1, 0.0))
        self.publish("system", Load(float(self.state.n)))

    @on("system", Pose)
    def pose(self, packet):
        self.state.centre_m = (packet.body.x_m, packet.body.y_m)
        if packet.body.x_m < 0:
            raise RuntimeError("lost")


class Home(Task):
    requires = ("motors",)

    @every(hz=10)
    def drive(self, tick):
        self.publish("ctrl", Twist(-0.1, 0.0))


CLASSES = {"test.Circle": Circle, "test.Home": Home}
WHEELS = {"wheels": "null.motors"}


def fleet_of(seed=1, robots=("a", "b"), tasks=None, **others):
    """A fleet with wheels each, whose first robot runs `Circle`."""
    fleet = Fleet(seed, classes=CLASSES, **others)
    for name in robots:
        mine = tasks if tasks is not None else {"Circle": Circle, "Home": {"type": Home, "start": False}}
        fleet.start(name, devices=WHEELS, tasks=mine if name == robots[0] else {})
    fleet.connect()
    return fleet


@pytest.fixture
def fleet():
    with fleet_of() as made:
        yield made


def phase(fleet, agent, name="Circle", birthplace="a"):
    """What an agent's record of a task says."""
    place = fleet.agents[agent].component("client").places.get(TaskId(birthplace, name))
    return place.record.standing if place is not None else Standing.NONE


def hosts(fleet, name="Circle"):
    """The agents on which a task has an actor that does not stand still."""
    return [
        agent.name
        for agent in fleet.agents.values()
        if (task := agent.component(f"client/{name}")) is not None and not task.is_frozen
    ]


def test_migration_carries_settings_state_and_rate(fleet):
    a, b = fleet.agents["a"], fleet.agents["b"]
    assert a.ask(Configure("Circle", {"radius_m": 0.8})).ok
    assert a.ask(Reschedule("Circle", 5.0)).ok
    a.publish("system", Pose(1.0, 2.0, 0.0))
    fleet.run_for(3.0)
    reply = a.ask(Migrate("Circle"))
    assert reply.ok and reply.result["winner"] == "b"
    fleet.run_for(1.0)
    moved = b.task("Circle")
    assert (moved.settings.radius_m, moved.state.centre_m) == (0.8, (1.0, 2.0))
    assert b.component("client/Circle").timers["drive"].rate_hz == 5.0
    before, after = a.probe.packets(Load), b.probe.packets(Load)
    # Not a tick is forgotten.
    assert after[0].body.cpu == before[-1].body.cpu + 1
    (arrived,) = b.events("task_arrived")
    assert (arrived["source_agent"], arrived["epoch"]) == ("a", 1)
    assert tuple(arrived["state"]["centre_m"]) == (1.0, 2.0)
    assert hosts(fleet) == ["b"]
    assert (phase(fleet, "a"), phase(fleet, "b")) == (Standing.RELEASED, Standing.OWNER)


def test_migration_pauses_for_less_than_half_a_second(fleet):
    """Also over a slow link; what it does is not forgotten, because from the snapshot on it does nothing."""
    a, b = fleet.agents["a"], fleet.agents["b"]
    fleet.network.set_quality("a", "b", Quality(latency_s=0.1))
    fleet.run_for(1.0)
    assert a.ask(Migrate("Circle")).ok
    fleet.run_for(1.0)
    assert b.probe.packets(Load)[0].body.cpu == a.probe.packets(Load)[-1].body.cpu + 1
    last_s = a.kernel.mission.host_time(a.probe.packets(Twist)[-1].stamp_s)
    first_s = b.kernel.mission.host_time(b.probe.packets(Twist)[0].stamp_s)
    assert 0.0 < first_s - last_s < 0.5


def test_migration_lets_another_task_follow(fleet):
    a = fleet.agents["a"]
    assert a.ask(Migrate("Circle", then="Home")).ok
    fleet.run_for(0.1)
    assert a.running() == ["Home"]
    assert a.kernel.registry.holder("wheels") == "a/client/Home"
    assert a.ask(Migrate("Home", then="Nobody")).reason == "a/client has no task 'Nobody' that could follow Home"


def test_migration_is_remembered_by_the_birthplace(fleet):
    a, b = fleet.agents["a"], fleet.agents["b"]
    a.ask(Migrate("Circle"))
    for start in (Start("Circle"), Restart("Circle")):
        assert a.ask(start).reason == "a/Circle moved to b"
    for asked in (Stop("Circle"), Reschedule("Circle", 2.0), Configure("Circle", {}), Migrate("Circle")):
        assert a.ask(asked).reason == "a/Circle moved to b"
    fleet.stop("a")
    assert fleet.restart("a").running() == []
    fleet.connect()
    assert hosts(fleet) == ["b"]
    # And it may be stopped and started where it is now.
    assert b.ask(Stop("Circle")).ok
    assert b.ask(Start("Circle")).ok


def test_migration_home_again(fleet):
    a, b = fleet.agents["a"], fleet.agents["b"]
    fleet.run_for(1.0)
    assert a.ask(Migrate("Circle")).ok
    fleet.run_for(1.0)
    assert b.ask(Migrate("Circle")).ok
    fleet.run_for(1.0)
    assert hosts(fleet) == ["a"]
    assert a.task("Circle").state.n >= 25
    assert "Circle" not in b.ask(Describe("client")).result
    assert a.ask(Migrate("Circle")).ok
    fleet.run_for(0.1)
    assert hosts(fleet) == ["b"]


def test_migration_home_after_a_restart_of_the_host(fleet):
    a, b = fleet.agents["a"], fleet.agents["b"]
    assert a.ask(Migrate("Circle")).ok
    fleet.stop("b")
    b = fleet.restart("b")
    fleet.connect()
    assert hosts(fleet) == ["b"]
    assert b.ask(Migrate("Circle")).ok
    fleet.run_for(0.1)
    assert hosts(fleet) == ["a"]
    assert a.ask(Migrate("Circle")).ok
    fleet.run_for(0.1)
    assert hosts(fleet) == ["b"]


def test_migration_is_refused_by_unable_neighbours(fleet):
    fleet.start("sensor")
    fleet.start("world", role="environment", devices=WHEELS)
    fleet.agents["b"].ask(Stop("wheels"))
    fleet.connect()
    fleet.run_for(1.0)
    a = fleet.agents["a"]
    n = a.task("Circle").state.n
    reply = a.ask(Migrate("Circle"))
    assert reply.reason == (
        "no neighbour can take Circle: b: lacks the device type motors; sensor: lacks the device type motors"
    )
    assert a.task("Circle").state.n > n - 1
    assert hosts(fleet) == ["a"]
    ledger = a.events("migration")[-1]
    assert [(line["peer"], line["answer"]) for line in ledger["lines"]] == [("b", "refused"), ("sensor", "refused")]
    assert ledger["outcome"] == "stayed"


@pytest.mark.parametrize(
    ("prepare", "reason"),
    [
        (lambda b: b.publish("system", Battery(11.0, 0.7)), "has 70% of its battery, too near to the 65%"),
        (lambda b: b.ask(Start("Mine")), "wheels is held by b/client/Mine"),
    ],
)
def test_migration_is_refused_by_a_host_that_should_not(prepare, reason):
    rule = {"when": "battery", "below": 0.65}
    with Fleet(2, classes=CLASSES) as fleet:
        a = fleet.start("a", devices=WHEELS, tasks={"Circle": {"type": Circle, "migrate": rule}})
        b = fleet.start("b", devices=WHEELS, tasks={"Mine": {"type": Home, "start": False}})
        fleet.connect()
        prepare(b)
        fleet.run_for(0.1)
        assert reason in a.ask(Migrate("Circle")).reason


def test_migration_is_refused_where_the_name_is_taken(fleet):
    fleet.stop("b")
    fleet.start("b", devices=WHEELS, tasks={"Circle": {"type": Circle, "start": False}})
    fleet.connect()
    assert "b: has a task named Circle already (b/Circle)" in fleet.agents["a"].ask(Migrate("Circle")).reason


def test_migration_without_neighbours():
    with Fleet(2) as fleet:
        a = fleet.start("a", tasks={"Home": Task})
        unlinked = "no agent that runs tasks is linked to a (are their addresses in `peers` of [agent]?)"
        alone = f"no neighbour can take Home: {unlinked}"
        assert a.ask(Migrate("Home", dry_run=True)).reason == alone and a.lines("warning") == []
        assert a.ask(Migrate("Home")).reason == alone
        fleet.run_for(0.1)
        told = f"a/Home stays on a: {alone}"
        assert told in a.lines("info") and told not in a.lines("warning"), "who has asked was told"


def test_migration_dry_run_tells_the_bids(fleet):
    reply = fleet.agents["a"].ask(Migrate("Circle", dry_run=True))
    assert reply.ok and reply.result["outcome"] == "dry run" and reply.result["winner"] == "b"
    fleet.run_for(1.0)
    assert hosts(fleet) == ["a"]


def test_migration_asks_only_the_named_agent():
    with fleet_of(robots=("a", "b", "c")) as fleet:
        a = fleet.agents["a"]
        assert "nobody is not linked to a" in a.ask(Migrate("Circle", to="nobody")).reason
        ledger = a.ask(Migrate("Circle", to="c")).result
        fleet.run_for(0.1)
        stayed = [line for line in a.lines("info") if "stays on" in line]
        assert hosts(fleet) == ["c"] and len(stayed) == 1, "only the first move came to nothing"
        assert ledger["to"] == "c" and [line["peer"] for line in ledger["lines"]] == ["c"]
        assert [event["to"] for event in a.events("migration_asked")] == ["nobody", "c"]
        assert [event["to"] for event in a.events("migration")] == ["nobody", "c"]
        assert fleet.agents["b"].events("migration_bid") == fleet.agents["b"].events("migration_refused") == []
        (kept,) = [row for row in a.ask(Migrations()).result if row["outcome"] == "moved"]
        assert kept["to"] == "c"


def test_migration_asks_all_if_none_is_named(fleet):
    a = fleet.agents["a"]
    assert a.ask(Migrate("Circle")).result["to"] == ""
    assert [event["to"] for event in a.events("migration_asked")] == [""]


def test_migration_goes_to_the_cheapest():
    with fleet_of(robots=("a", "b", "c")) as fleet:
        fleet.stop("b")
        fleet.start("b", devices=WHEELS, tasks={"Busy": Task})
        fleet.connect()
        assert fleet.agents["a"].ask(Migrate("Circle")).result["winner"] == "c"


def test_migration_does_not_wait_for_silent_neighbours():
    with fleet_of(robots=("a", "b", "c")) as fleet:
        fleet.network.partition(["b"])
        a = fleet.agents["a"]
        reply = a.ask(Migrate("Circle"))
        assert reply.ok and reply.result["winner"] == "c"
        assert [line["answer"] for line in reply.result["lines"]] == ["silent", "bid"]
        assert reply.result["duration_s"] < 1.0


def test_migration_ends_if_the_only_neighbour_is_silent(fleet):
    fleet.network.partition(["b"])
    reply = fleet.agents["a"].ask(Migrate("Circle"), timeout_s=20.0)
    assert reply.reason == "no neighbour can take Circle: b: did not answer within 8 s"
    assert reply.result["duration_s"] == pytest.approx(8.0, abs=0.1) and hosts(fleet) == ["a"]


def test_migration_is_refused_for_stopped_or_moving_tasks(fleet):
    a = fleet.agents["a"]
    assert a.ask(Migrate("Home")).reason == "a/client/Home is stopped, so it cannot move"
    first = a.publish(SYSCTRL, Migrate("Circle"))
    second = a.publish(SYSCTRL, Migrate("Circle"))
    assert a.reply_to(second).reason == "a/client/Circle is being moved already"
    assert a.reply_to(first).ok


def test_migration_asked_for_by_the_task():
    class Tired(Circle):
        @on("system", Battery)
        def battery(self, packet):
            self.migrate()

    with fleet_of(tasks={"Circle": Tired}) as fleet:
        fleet.agents["a"].publish("system", Battery(11.0, 0.5))
        assert fleet.run_until(lambda: hosts(fleet) == ["b"])


# Rules ---------------------------------------------------------------------------------------------------------


def ruled(fleet, others=("b",)):
    rule = {"when": "battery", "below": 0.65, "then": "Home"}
    tasks = {"Circle": {"type": Circle, "migrate": rule}, "Home": {"type": Home, "start": False}}
    a = fleet.start("a", devices=WHEELS, tasks=tasks)
    for name in others:
        fleet.start(name, devices=WHEELS)
    fleet.connect()
    return a


def test_migration_rule_acts_below_its_threshold():
    with Fleet(3, classes=CLASSES) as fleet:
        a = ruled(fleet)
        for level in (0.9, 0.7, 0.65):
            a.publish("system", Battery(11.0, level))
            fleet.run_for(1.0)
        assert hosts(fleet) == ["a"]
        for level in (0.64, 0.63, 0.62):
            a.publish("system", Battery(11.0, level))
        assert fleet.run_until(lambda: hosts(fleet) == ["b"] and a.running() == ["Home"])
        assert [event["by"] for event in a.events("migration_asked")] == ["rule"]


def test_migration_rule_asks_again_after_a_minute():
    with Fleet(3, classes=CLASSES) as fleet:
        a = ruled(fleet, others=())
        fleet.start("b")
        fleet.connect()
        begin_s = fleet.now()
        times = []
        for _ in range(1300):
            before = len(a.events("migration_asked"))
            a.publish("system", Battery(11.0, 0.5))
            fleet.run_for(0.1)
            if len(a.events("migration_asked")) > before:
                times.append(fleet.now() - begin_s)
            a.probe.forget() if before > 50 else None
        assert len(times) == 3
        assert all(59.0 < later - earlier < 61.5 for earlier, later in zip(times, times[1:], strict=False))
        assert hosts(fleet) == ["a"]


def test_migration_rule_ignores_other_agents():
    with Fleet(3, classes=CLASSES) as fleet:
        a = ruled(fleet)
        fleet.agents["b"].publish("system", Battery(11.0, 0.1), to="*")
        fleet.run_for(2.0)
        assert a.events("migration_asked") == []


def test_migration_rule_moves_with_its_task():
    with Fleet(3, classes=CLASSES) as fleet:
        a = ruled(fleet, others=("b", "c"))
        a.publish("system", Battery(11.0, 0.6))
        assert fleet.run_until(lambda: hosts(fleet) == ["b"])
        fleet.run_for(9.0)
        fleet.agents["b"].publish("system", Battery(11.0, 0.6))
        fleet.run_for(0.5)
        assert hosts(fleet) == ["b"], "a rule leaves a task alone that has just arrived"
        fleet.run_for(1.0)
        fleet.agents["b"].publish("system", Battery(11.0, 0.6))
        assert fleet.run_until(lambda: hosts(fleet) == ["c"])


# Troubles on the way -------------------------------------------------------------------------------------------


def until(fleet, condition, timeout_s=20.0, what=""):
    """Runs step by step until a condition holds, so that the moment is caught as it comes."""
    begin_s = fleet.now()
    while not condition():
        assert fleet.dispatcher.step(), "nothing happens any more"
        assert fleet.now() < begin_s + timeout_s, what or "it did not come"


@pytest.mark.parametrize("commanded", [Restart("Circle"), Reschedule("Circle", 1.0)])
def test_migration_refuses_commands_on_the_way(fleet, commanded):
    a = fleet.agents["a"]
    fleet.network.set_quality("a", "b", Quality(latency_s=0.1))
    a.publish(SYSCTRL, Migrate("Circle"))
    until(fleet, lambda: phase(fleet, "a") is Standing.OFFERED)
    assert a.ask(commanded, timeout_s=0.09).reason == "a/client/Circle is being handed over between a and b"
    fleet.run_for(2.0)
    assert hosts(fleet) == ["b"]


def test_migration_is_called_off_by_a_stop_while_it_is_offered(fleet):
    a = fleet.agents["a"]
    fleet.network.set_quality("a", "b", Quality(latency_s=0.1))
    moving = a.publish(SYSCTRL, Migrate("Circle"))
    until(fleet, lambda: phase(fleet, "a") is Standing.OFFERED)
    assert a.ask(Stop("Circle")).ok
    fleet.run_for(2.0)
    assert "the task was stopped" in a.reply_to(moving).reason
    assert hosts(fleet) == [] and phase(fleet, "a") is Standing.OWNER


def test_migration_is_called_off_by_an_early_stop(fleet):
    a = fleet.agents["a"]
    fleet.network.set_quality("a", "b", Quality(latency_s=0.1))
    moving = a.publish(SYSCTRL, Migrate("Circle"))
    until(fleet, lambda: fleet.agents["b"].events("migration_bid"))
    fleet.run_for(0.15)
    assert a.ask(Stop("Circle")).ok
    assert not a.reply_to(moving).ok
    fleet.run_for(5.0)
    assert hosts(fleet) == []
    assert phase(fleet, "a") is Standing.OWNER
    assert a.ask(Start("Circle")).ok
    assert a.ask(Migrate("Circle")).ok


def test_migration_outlives_a_failure_on_the_way(fleet):
    a, b = fleet.agents["a"], fleet.agents["b"]
    fleet.network.set_quality("a", "b", Quality(latency_s=0.1))
    a.publish(SYSCTRL, Migrate("Circle", then="Home"))
    until(fleet, lambda: phase(fleet, "a") is Standing.OFFERED)

    def fail():
        raise RuntimeError("while it stood still")

    a.task("Circle").call(fail)
    fleet.run_for(5.0)
    assert hosts(fleet) == ["b"]
    assert a.running() == ["Home"]
    assert b.task("Circle").state.n > 0


def test_migration_outlives_a_cut_network():
    for cut_at in (Standing.OFFERED, Standing.YIELDED):
        with fleet_of(seed=9) as fleet:
            a = fleet.agents["a"]
            fleet.network.set_quality("a", "b", Quality(latency_s=0.02))
            a.publish(SYSCTRL, Migrate("Circle"))
            until(fleet, lambda phase_=cut_at: phase(fleet, "a") is phase_)
            fleet.network.partition(["a"], ["b"])
            fleet.run_for(30.0)
            assert len(hosts(fleet)) <= 1
            if cut_at is Standing.OFFERED:
                assert hosts(fleet) == ["a"]  # it took it back: nobody can have been told to run it
            fleet.network.heal()
            fleet.run_for(30.0)
            assert len(hosts(fleet)) == 1
            if cut_at is Standing.YIELDED:
                assert hosts(fleet) == ["b"]
                assert (phase(fleet, "a"), phase(fleet, "b")) == (Standing.RELEASED, Standing.OWNER)


MOMENTS = [
    ("a", lambda fleet: phase(fleet, "a") is Standing.OFFERED),
    ("a", lambda fleet: phase(fleet, "a") is Standing.YIELDED),
    ("a", lambda fleet: phase(fleet, "a") is Standing.RELEASED),
    ("b", lambda fleet: phase(fleet, "b") is Standing.HEIR),
    ("b", lambda fleet: phase(fleet, "b") is Standing.OWNER),
]


AFTER_S = (0.0, 0.0015, 0.01)
KILLED = ("a", "b", "ab")
KILLS = [(moment, killed, after_s) for moment in range(len(MOMENTS)) for killed in KILLED for after_s in AFTER_S]


def kill_during_a_move(case):
    """Check that exactly one copy runs in the end, in good order, if agents are killed between two steps of a move."""
    moment, killed, after_s = case
    seed = 100 * moment + int(after_s * 10_000)
    with fleet_of(seed=seed) as fleet:
        fleet.network.set_quality("a", "b", Quality(latency_s=0.004, jitter_s=0.004))
        fleet.run_for(2.0)
        fleet.agents["a"].publish(SYSCTRL, Migrate("Circle"))
        until(fleet, lambda: MOMENTS[moment][1](fleet))
        fleet.run_for(after_s)
        for name in killed:
            fleet.crash(name)
        fleet.run_for(3.0)
        assert len(hosts(fleet)) <= 1
        for name in killed:
            fleet.restart(name)
            fleet.run_for(0.5)
            assert len(hosts(fleet)) <= 1
        fleet.run_for(30.0)
        (host,) = hosts(fleet)
        assert fleet.agents[host].task("Circle").state.n >= 250  # of what it had counted nothing much is lost
        # It is in good order: it can be moved once more, either way.
        other = "b" if host == "a" else "a"
        assert fleet.agents[host].ask(Migrate("Circle")).ok
        fleet.run_for(1.0)
        assert hosts(fleet) == [other]


def test_migration_leaves_one_copy_if_agents_are_killed():
    """One delay for each moment and each set of agents; `test_migration_full.py` has them all."""
    chosen = [
        case for number, case in enumerate(KILLS) if number % len(AFTER_S) == number // len(AFTER_S) % len(AFTER_S)
    ]
    assert {case[:2] for case in chosen} == {case[:2] for case in KILLS} and {case[2] for case in chosen} == {*AFTER_S}
    for_each(chosen, kill_during_a_move)


def test_migration_is_answered_if_the_migrator_fails(fleet):
    a = fleet.agents["a"]
    fleet.network.set_quality("a", "b", Quality(latency_s=0.2))
    moving = a.publish(SYSCTRL, Migrate("Circle"))
    fleet.run_for(0.1)

    def fail():
        raise RuntimeError("the migrator itself")

    a.may_fail.add("network/TaskMigrator")
    a.component("network/TaskMigrator").call(fail)
    reply = a.reply_to(moving)
    assert not reply.ok and "Task Migrator was started again" in reply.reason
    fleet.run_for(5.0)
    assert hosts(fleet) == ["a"]
    fleet.network.set_quality("a", "b", Quality())
    assert a.ask(Migrate("Circle")).ok
