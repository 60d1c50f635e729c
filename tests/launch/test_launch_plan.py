"""The plan of a launched fleet: when agents start, restart and stop. Pure, so time is a number."""

from pathlib import Path

from pancakes.config import parse
from pancakes.tools.launch.fleet_file import Member, ProcessRestart
from pancakes.tools.launch.supervisor import (
    ALL_END_S,
    END_S,
    READY_S,
    Action,
    BeginMission,
    Kill,
    LaunchPlan,
    SpawnProcess,
    TellPerson,
    Terminate,
)


def member(name: str, *after: str, restart: ProcessRestart | None = None, hold: bool = False) -> Member:
    text = f'schema = 1\n[agent]\nname = "{name}"\n[clock]\nhold = {str(hold).lower()}\n'
    return Member(name, Path(f"{name}.toml"), (), parse(text, name), restart or ProcessRestart(), after)


def done(actions: list[Action]) -> list[Action]:
    """Return the actions without those that only report to the person."""
    return [action for action in actions if not isinstance(action, TellPerson)]


def events(actions: list[Action]) -> list[tuple[str, str]]:
    return [(action.name, action.event) for action in actions if isinstance(action, TellPerson)]


def running(*members: Member) -> LaunchPlan:
    """Return a plan whose agents are all ready."""
    plan = LaunchPlan(members)
    spawned = done(plan.start(0.0))
    while spawned:
        action = spawned.pop(0)
        if isinstance(action, SpawnProcess):
            spawned += done(plan.ready(action.name, 0.0))
    return plan


def again(plan: LaunchPlan, ended: list[Action]) -> list[Action]:
    """Return the actions of the next restart, after its pause."""
    assert done(ended) == []
    assert plan.deadline_s is not None
    assert plan.tick(plan.deadline_s - 0.001) == []
    return done(plan.tick(plan.deadline_s))


def test_agent_starts_once_its_predecessors_are_ready() -> None:
    plan = LaunchPlan([member("c", "a", "b"), member("a"), member("b", "a")])

    assert done(plan.start(0.0)) == [SpawnProcess("a")]
    assert done(plan.ready("a", 1.0)) == [SpawnProcess("b")]
    assert done(plan.ready("b", 2.0)) == [SpawnProcess("c")]
    assert not plan.over


def test_independent_agents_start_at_once_in_order() -> None:
    assert done(LaunchPlan([member("b"), member("a")]).start(0.0)) == [SpawnProcess("b"), SpawnProcess("a")]


def test_agents_stop_in_reverse_order() -> None:
    plan = running(member("a"), member("b", "a"), member("c", "a"), member("d", "c"))

    assert plan.stop(10.0) == [Terminate("d"), Terminate("b")]
    assert done(plan.ended("b", 0, 10.1)) == []  # c runs, and comes after a
    assert done(plan.ended("d", 0, 10.2)) == [Terminate("c")]
    assert done(plan.ended("c", 0, 10.3)) == [Terminate("a")]
    assert not plan.over
    plan.ended("a", 0, 10.4)
    assert plan.over
    assert plan.exit_code == 0


def test_agent_that_does_not_stop_is_killed() -> None:
    plan = running(member("a"))
    plan.stop(10.0)

    assert plan.deadline_s == 10.0 + END_S
    assert plan.tick(10.0 + END_S - 0.1) == []
    assert plan.tick(10.0 + END_S) == [Kill("a")]
    assert plan.tick(10.0 + END_S) == []
    assert plan.deadline_s is None
    (last,) = plan.ended("a", -9, 13.0)
    assert isinstance(last, TellPerson)
    assert last.text == "has ended (ended by SIGKILL, killed because it took too long)"
    assert plan.exit_code == 0


def test_long_chain_of_agents_stops_within_seconds() -> None:
    plan = running(member("a"), member("b", "a"), member("c", "b"))
    plan.stop(0.0)
    plan.tick(END_S)
    assert done(plan.ended("c", -9, END_S)) == [Terminate("b")]

    assert plan.tick(ALL_END_S) == [Kill("a"), Kill("b")]
    assert done(plan.ended("b", -9, ALL_END_S)) == []  # a was already told to stop


def test_second_stop_kills_at_once() -> None:
    plan = running(member("a"), member("b", "a"))
    plan.stop(0.0)

    assert plan.stop(0.1) == [Kill("a"), Kill("b")]


def test_stop_during_start_starts_no_more() -> None:
    plan = LaunchPlan([member("a"), member("b", "a")])
    plan.start(0.0)

    assert plan.stop(0.5) == [Terminate("a")]
    assert plan.ready("a", 0.6) == []
    plan.ended("a", 0, 0.7)
    assert plan.over


def test_failed_agent_is_restarted_until_given_up() -> None:
    plan = running(member("a", restart=ProcessRestart("on-failure", at_most=2, within_s=10.0)), member("b"))

    assert again(plan, plan.ended("a", 1, 1.0)) == [SpawnProcess("a")]
    assert again(plan, plan.ended("a", -11, 2.0)) == [SpawnProcess("a")]
    actions = plan.ended("a", 1, 3.0)
    assert events(actions) == [("a", "given_up")]
    assert done(actions) == []
    assert not plan.over  # the others go on
    plan.stop(4.0)
    plan.ended("b", 0, 4.1)
    assert plan.over
    assert plan.exit_code == 1


def test_failures_far_apart_do_not_add_up() -> None:
    plan = running(member("a", restart=ProcessRestart("on-failure", at_most=1, within_s=10.0)))

    assert again(plan, plan.ended("a", 1, 100.0)) == [SpawnProcess("a")]
    plan.ready("a", 101.0)
    assert again(plan, plan.ended("a", 1, 111.0)) == [SpawnProcess("a")]
    plan.ready("a", 112.0)
    assert events(plan.ended("a", 1, 121.0)) == [("a", "given_up")]


def test_each_restart_waits_longer() -> None:
    """So an agent whose port becomes free a second later starts, and one that never starts is given up."""
    restart = ProcessRestart("on-failure", at_most=4, within_s=60.0, pause_s=1.0, pause_max_s=4.0)
    plan = running(member("a", restart=restart))
    now_s, waited_s = 100.0, []
    while "given_up" not in [event for _, event in events(plan.ended("a", 1, now_s))]:
        assert plan.deadline_s is not None
        waited_s.append(plan.deadline_s - now_s)
        now_s = plan.deadline_s
        assert done(plan.tick(now_s)) == [SpawnProcess("a")]

    assert len(waited_s) == 4
    for found_s, most_s in zip(waited_s, (1.0, 2.0, 4.0, 4.0), strict=True):
        assert 0.75 * most_s <= found_s <= most_s


def test_time_of_the_next_restart_is_reported() -> None:
    plan = running(member("a", restart=ProcessRestart(pause_s=8.0)))
    (only,) = plan.ended("a", 1, 1.0)
    assert isinstance(only, TellPerson) and plan.deadline_s is not None
    assert only.text == f"has ended (exit code 1) and is started again in {plan.deadline_s - 1.0:.1f} s"


def test_stop_cancels_the_next_restart() -> None:
    plan = running(member("a"))
    plan.ended("a", 1, 1.0)

    assert plan.stop(1.01) == []
    assert plan.over
    assert plan.tick(2.0) == []
    assert plan.exit_code == 0


def test_only_always_restarts_after_a_graceful_end() -> None:
    plan = running(member("a"), member("b", restart=ProcessRestart("always")), member("c"))

    assert events(plan.ended("a", 0, 1.0)) == [("a", "ended")]
    assert again(plan, plan.ended("b", 0, 1.0)) == [SpawnProcess("b")]
    plan.ended("c", 0, 1.0)
    assert not plan.over
    assert plan.exit_code == 0


def test_policy_no_never_restarts() -> None:
    plan = running(member("a", restart=ProcessRestart("no")))

    assert events(plan.ended("a", 1, 1.0)) == [("a", "given_up")]
    assert plan.over
    assert plan.exit_code == 1


def test_bad_configuration_is_not_restarted() -> None:
    plan = running(member("a"))

    assert events(plan.ended("a", 4, 1.0)) == [("a", "given_up")]


def test_agent_after_an_ended_one_is_given_up() -> None:
    plan = LaunchPlan([member("a", restart=ProcessRestart("no")), member("b", "a"), member("c", "b")])
    plan.start(0.0)

    assert events(plan.ended("a", 1, 1.0)) == [("a", "given_up"), ("b", "given_up"), ("c", "given_up")]
    assert plan.over
    assert plan.exit_code == 1


def test_process_that_cannot_be_created_is_given_up() -> None:
    plan = LaunchPlan([member("a")])
    plan.start(0.0)

    (only,) = plan.unstartable("a", "too many open files", 0.0)
    assert isinstance(only, TellPerson)
    assert only.text == "cannot be started: too many open files"
    assert (plan.over, plan.exit_code) == (True, 1)


def test_late_agent_is_reported_once() -> None:
    plan = LaunchPlan([member("a")])
    plan.start(5.0)

    assert plan.deadline_s == 5.0 + READY_S
    assert events(plan.tick(5.0 + READY_S)) == [("a", "late")]
    assert plan.tick(6.0 + READY_S) == []
    assert plan.deadline_s is None


def test_held_missions_begin_once_all_are_ready() -> None:
    plan = LaunchPlan([member("a", hold=True), member("b"), member("c", hold=True)])
    plan.start(0.0)

    assert done(plan.ready("a", 1.0)) == []
    assert done(plan.ready("c", 1.0)) == []
    assert done(plan.ready("b", 2.0)) == [BeginMission(("a", "c"))]


def test_restarted_agent_begins_its_mission_alone() -> None:
    plan = running(member("a", hold=True), member("b", hold=True))
    assert again(plan, plan.ended("a", 1, 3.0)) == [SpawnProcess("a")]

    assert done(plan.ready("a", 4.0)) == [BeginMission(("a",))]


def test_mission_does_not_begin_without_all_agents() -> None:
    plan = LaunchPlan([member("a", hold=True), member("b", restart=ProcessRestart("no"))])
    plan.start(0.0)

    assert events(plan.ended("b", 1, 1.0)) == [("b", "given_up"), ("", "held")]
    assert done(plan.ready("a", 2.0)) == []


def test_missions_can_stay_held() -> None:
    plan = LaunchPlan([member("a", hold=True)], begin=False)
    plan.start(0.0)

    assert done(plan.ready("a", 1.0)) == []
