"""The plan of a launched fleet: who starts when, what starts again, who ends first. Pure, so time is a number."""

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
    """What is done; what is only told is left out."""
    return [action for action in actions if not isinstance(action, TellPerson)]


def told(actions: list[Action]) -> list[tuple[str, str]]:
    return [(action.name, action.event) for action in actions if isinstance(action, TellPerson)]


def running(*members: Member) -> LaunchPlan:
    """A plan whose agents are all ready."""
    plan = LaunchPlan(members)
    spawned = done(plan.start(0.0))
    while spawned:
        action = spawned.pop(0)
        if isinstance(action, SpawnProcess):
            spawned += done(plan.ready(action.name, 0.0))
    return plan


def again(plan: LaunchPlan, ended: list[Action]) -> list[Action]:
    """The next try after an end, which comes after a pause."""
    assert done(ended) == []
    assert plan.deadline_s is not None
    assert plan.tick(plan.deadline_s - 0.001) == []
    return done(plan.tick(plan.deadline_s))


def test_an_agent_starts_once_those_are_ready_that_it_comes_after() -> None:
    plan = LaunchPlan([member("c", "a", "b"), member("a"), member("b", "a")])

    assert done(plan.start(0.0)) == [SpawnProcess("a")]
    assert done(plan.ready("a", 1.0)) == [SpawnProcess("b")]
    assert done(plan.ready("b", 2.0)) == [SpawnProcess("c")]
    assert not plan.over


def test_where_nobody_waits_all_start_at_once_in_their_order() -> None:
    assert done(LaunchPlan([member("b"), member("a")]).start(0.0)) == [SpawnProcess("b"), SpawnProcess("a")]


def test_they_end_in_reverse_and_nobody_before_those_that_come_after_it() -> None:
    plan = running(member("a"), member("b", "a"), member("c", "a"), member("d", "c"))

    assert plan.stop(10.0) == [Terminate("d"), Terminate("b")]
    assert done(plan.ended("b", 0, 10.1)) == []  # c runs, and comes after a
    assert done(plan.ended("d", 0, 10.2)) == [Terminate("c")]
    assert done(plan.ended("c", 0, 10.3)) == [Terminate("a")]
    assert not plan.over
    plan.ended("a", 0, 10.4)
    assert plan.over
    assert plan.exit_code == 0


def test_who_does_not_end_is_killed() -> None:
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


def test_a_long_row_of_agents_ends_within_a_few_seconds_all_the_same() -> None:
    plan = running(member("a"), member("b", "a"), member("c", "b"))
    plan.stop(0.0)
    plan.tick(END_S)
    assert done(plan.ended("c", -9, END_S)) == [Terminate("b")]

    assert plan.tick(ALL_END_S) == [Kill("a"), Kill("b")]
    assert done(plan.ended("b", -9, ALL_END_S)) == []  # a need not be told any more


def test_who_says_stop_twice_does_not_want_to_wait() -> None:
    plan = running(member("a"), member("b", "a"))
    plan.stop(0.0)

    assert plan.stop(0.1) == [Kill("a"), Kill("b")]


def test_a_stop_while_they_start_starts_no_more() -> None:
    plan = LaunchPlan([member("a"), member("b", "a")])
    plan.start(0.0)

    assert plan.stop(0.5) == [Terminate("a")]
    assert plan.ready("a", 0.6) == []
    plan.ended("a", 0, 0.7)
    assert plan.over


def test_a_failure_starts_it_again_until_it_is_given_up() -> None:
    plan = running(member("a", restart=ProcessRestart("on-failure", at_most=2, within_s=10.0)), member("b"))

    assert again(plan, plan.ended("a", 1, 1.0)) == [SpawnProcess("a")]
    assert again(plan, plan.ended("a", -11, 2.0)) == [SpawnProcess("a")]
    actions = plan.ended("a", 1, 3.0)
    assert told(actions) == [("a", "given_up")]
    assert done(actions) == []
    assert not plan.over  # the others go on
    plan.stop(4.0)
    plan.ended("b", 0, 4.1)
    assert plan.over
    assert plan.exit_code == 1


def test_failures_that_lie_far_apart_do_not_add_up() -> None:
    plan = running(member("a", restart=ProcessRestart("on-failure", at_most=1, within_s=10.0)))

    assert again(plan, plan.ended("a", 1, 100.0)) == [SpawnProcess("a")]
    plan.ready("a", 101.0)
    assert again(plan, plan.ended("a", 1, 111.0)) == [SpawnProcess("a")]
    plan.ready("a", 112.0)
    assert told(plan.ended("a", 1, 121.0)) == [("a", "given_up")]


def test_each_restart_waits_longer_than_the_one_before() -> None:
    """An agent whose port comes free a second later is found, and one that never starts is given up all the same."""
    restart = ProcessRestart("on-failure", at_most=4, within_s=60.0, pause_s=1.0, pause_max_s=4.0)
    plan = running(member("a", restart=restart))
    now_s, waited_s = 100.0, []
    while "given_up" not in [event for _, event in told(plan.ended("a", 1, now_s))]:
        assert plan.deadline_s is not None
        waited_s.append(plan.deadline_s - now_s)
        now_s = plan.deadline_s
        assert done(plan.tick(now_s)) == [SpawnProcess("a")]

    assert len(waited_s) == 4
    for found_s, most_s in zip(waited_s, (1.0, 2.0, 4.0, 4.0), strict=True):
        assert 0.75 * most_s <= found_s <= most_s


def test_a_person_is_told_when_the_next_try_is() -> None:
    plan = running(member("a", restart=ProcessRestart(pause_s=8.0)))
    (only,) = plan.ended("a", 1, 1.0)
    assert isinstance(only, TellPerson) and plan.deadline_s is not None
    assert only.text == f"has ended (exit code 1) and is started again in {plan.deadline_s - 1.0:.1f} s"


def test_a_stop_calls_the_next_try_off() -> None:
    plan = running(member("a"))
    plan.ended("a", 1, 1.0)

    assert plan.stop(1.01) == []
    assert plan.over
    assert plan.tick(2.0) == []
    assert plan.exit_code == 0


def test_what_ended_in_order_is_started_again_by_always_alone() -> None:
    plan = running(member("a"), member("b", restart=ProcessRestart("always")), member("c"))

    assert told(plan.ended("a", 0, 1.0)) == [("a", "ended")]
    assert again(plan, plan.ended("b", 0, 1.0)) == [SpawnProcess("b")]
    plan.ended("c", 0, 1.0)
    assert not plan.over
    assert plan.exit_code == 0


def test_never_means_never() -> None:
    plan = running(member("a", restart=ProcessRestart("no")))

    assert told(plan.ended("a", 1, 1.0)) == [("a", "given_up")]
    assert plan.over
    assert plan.exit_code == 1


def test_a_bad_configuration_would_be_bad_the_next_time_as_well() -> None:
    plan = running(member("a"))

    assert told(plan.ended("a", 4, 1.0)) == [("a", "given_up")]


def test_who_waits_for_one_that_has_ended_is_never_started() -> None:
    plan = LaunchPlan([member("a", restart=ProcessRestart("no")), member("b", "a"), member("c", "b")])
    plan.start(0.0)

    assert told(plan.ended("a", 1, 1.0)) == [("a", "given_up"), ("b", "given_up"), ("c", "given_up")]
    assert plan.over
    assert plan.exit_code == 1


def test_a_process_that_cannot_be_made() -> None:
    plan = LaunchPlan([member("a")])
    plan.start(0.0)

    (only,) = plan.unstartable("a", "too many open files", 0.0)
    assert isinstance(only, TellPerson)
    assert only.text == "cannot be started: too many open files"
    assert (plan.over, plan.exit_code) == (True, 1)


def test_who_is_not_ready_in_time_is_named_once() -> None:
    plan = LaunchPlan([member("a")])
    plan.start(5.0)

    assert plan.deadline_s == 5.0 + READY_S
    assert told(plan.tick(5.0 + READY_S)) == [("a", "late")]
    assert plan.tick(6.0 + READY_S) == []
    assert plan.deadline_s is None


def test_missions_that_wait_begin_once_everybody_is_ready() -> None:
    plan = LaunchPlan([member("a", hold=True), member("b"), member("c", hold=True)])
    plan.start(0.0)

    assert done(plan.ready("a", 1.0)) == []
    assert done(plan.ready("c", 1.0)) == []
    assert done(plan.ready("b", 2.0)) == [BeginMission(("a", "c"))]


def test_one_that_was_started_again_begins_by_itself() -> None:
    plan = running(member("a", hold=True), member("b", hold=True))
    assert again(plan, plan.ended("a", 1, 3.0)) == [SpawnProcess("a")]

    assert done(plan.ready("a", 4.0)) == [BeginMission(("a",))]


def test_a_mission_does_not_begin_without_one_of_the_fleet() -> None:
    plan = LaunchPlan([member("a", hold=True), member("b", restart=ProcessRestart("no"))])
    plan.start(0.0)

    assert told(plan.ended("b", 1, 1.0)) == [("b", "given_up"), ("", "held")]
    assert done(plan.ready("a", 2.0)) == []


def test_missions_can_be_left_at_0() -> None:
    plan = LaunchPlan([member("a", hold=True)], begin=False)
    plan.start(0.0)

    assert done(plan.ready("a", 1.0)) == []
