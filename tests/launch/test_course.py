"""The course of a launched fleet: who starts when, what starts again, who ends first. Pure, so time is a number."""

from pathlib import Path

from pancakes.config import parse
from pancakes.tools.launch.fleet_file import Member, ProcessRestart
from pancakes.tools.launch.supervisor import (
    ALL_END_S,
    END_S,
    READY_S,
    Action,
    BeginMission,
    Course,
    Kill,
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


def running(*members: Member) -> Course:
    """A course whose agents are all ready."""
    course = Course(members)
    spawned = done(course.start(0.0))
    while spawned:
        action = spawned.pop(0)
        if isinstance(action, SpawnProcess):
            spawned += done(course.ready(action.name, 0.0))
    return course


def again(course: Course, ended: list[Action]) -> list[Action]:
    """The next try after an end, which comes after a pause."""
    assert done(ended) == []
    assert course.deadline_s is not None
    assert course.tick(course.deadline_s - 0.001) == []
    return done(course.tick(course.deadline_s))


def test_an_agent_starts_once_those_are_ready_that_it_comes_after() -> None:
    course = Course([member("c", "a", "b"), member("a"), member("b", "a")])

    assert done(course.start(0.0)) == [SpawnProcess("a")]
    assert done(course.ready("a", 1.0)) == [SpawnProcess("b")]
    assert done(course.ready("b", 2.0)) == [SpawnProcess("c")]
    assert not course.over


def test_where_nobody_waits_all_start_at_once_in_their_order() -> None:
    assert done(Course([member("b"), member("a")]).start(0.0)) == [SpawnProcess("b"), SpawnProcess("a")]


def test_they_end_in_reverse_and_nobody_before_those_that_come_after_it() -> None:
    course = running(member("a"), member("b", "a"), member("c", "a"), member("d", "c"))

    assert course.stop(10.0) == [Terminate("d"), Terminate("b")]
    assert done(course.ended("b", 0, 10.1)) == []  # c runs, and comes after a
    assert done(course.ended("d", 0, 10.2)) == [Terminate("c")]
    assert done(course.ended("c", 0, 10.3)) == [Terminate("a")]
    assert not course.over
    course.ended("a", 0, 10.4)
    assert course.over
    assert course.exit_code == 0


def test_who_does_not_end_is_killed() -> None:
    course = running(member("a"))
    course.stop(10.0)

    assert course.deadline_s == 10.0 + END_S
    assert course.tick(10.0 + END_S - 0.1) == []
    assert course.tick(10.0 + END_S) == [Kill("a")]
    assert course.tick(10.0 + END_S) == []
    assert course.deadline_s is None
    (last,) = course.ended("a", -9, 13.0)
    assert isinstance(last, TellPerson)
    assert last.text == "has ended (ended by SIGKILL, killed because it took too long)"
    assert course.exit_code == 0


def test_a_long_row_of_agents_ends_within_a_few_seconds_all_the_same() -> None:
    course = running(member("a"), member("b", "a"), member("c", "b"))
    course.stop(0.0)
    course.tick(END_S)
    assert done(course.ended("c", -9, END_S)) == [Terminate("b")]

    assert course.tick(ALL_END_S) == [Kill("a"), Kill("b")]
    assert done(course.ended("b", -9, ALL_END_S)) == []  # a need not be told any more


def test_who_says_stop_twice_does_not_want_to_wait() -> None:
    course = running(member("a"), member("b", "a"))
    course.stop(0.0)

    assert course.stop(0.1) == [Kill("a"), Kill("b")]


def test_a_stop_while_they_start_starts_no_more() -> None:
    course = Course([member("a"), member("b", "a")])
    course.start(0.0)

    assert course.stop(0.5) == [Terminate("a")]
    assert course.ready("a", 0.6) == []
    course.ended("a", 0, 0.7)
    assert course.over


def test_a_failure_starts_it_again_until_it_is_given_up() -> None:
    course = running(member("a", restart=ProcessRestart("on-failure", at_most=2, within_s=10.0)), member("b"))

    assert again(course, course.ended("a", 1, 1.0)) == [SpawnProcess("a")]
    assert again(course, course.ended("a", -11, 2.0)) == [SpawnProcess("a")]
    actions = course.ended("a", 1, 3.0)
    assert told(actions) == [("a", "given_up")]
    assert done(actions) == []
    assert not course.over  # the others go on
    course.stop(4.0)
    course.ended("b", 0, 4.1)
    assert course.over
    assert course.exit_code == 1


def test_failures_that_lie_far_apart_do_not_add_up() -> None:
    course = running(member("a", restart=ProcessRestart("on-failure", at_most=1, within_s=10.0)))

    assert again(course, course.ended("a", 1, 100.0)) == [SpawnProcess("a")]
    course.ready("a", 101.0)
    assert again(course, course.ended("a", 1, 111.0)) == [SpawnProcess("a")]
    course.ready("a", 112.0)
    assert told(course.ended("a", 1, 121.0)) == [("a", "given_up")]


def test_each_restart_waits_longer_than_the_one_before() -> None:
    """An agent whose port comes free a second later is found, and one that never starts is given up all the same."""
    restart = ProcessRestart("on-failure", at_most=4, within_s=60.0, pause_s=1.0, pause_max_s=4.0)
    course = running(member("a", restart=restart))
    now_s, waited_s = 100.0, []
    while "given_up" not in [event for _, event in told(course.ended("a", 1, now_s))]:
        assert course.deadline_s is not None
        waited_s.append(course.deadline_s - now_s)
        now_s = course.deadline_s
        assert done(course.tick(now_s)) == [SpawnProcess("a")]

    assert len(waited_s) == 4
    for found_s, most_s in zip(waited_s, (1.0, 2.0, 4.0, 4.0), strict=True):
        assert 0.75 * most_s <= found_s <= most_s


def test_a_person_is_told_when_the_next_try_is() -> None:
    course = running(member("a", restart=ProcessRestart(pause_s=8.0)))
    (only,) = course.ended("a", 1, 1.0)
    assert isinstance(only, TellPerson) and course.deadline_s is not None
    assert only.text == f"has ended (exit code 1) and is started again in {course.deadline_s - 1.0:.1f} s"


def test_a_stop_calls_the_next_try_off() -> None:
    course = running(member("a"))
    course.ended("a", 1, 1.0)

    assert course.stop(1.01) == []
    assert course.over
    assert course.tick(2.0) == []
    assert course.exit_code == 0


def test_what_ended_in_order_is_started_again_by_always_alone() -> None:
    course = running(member("a"), member("b", restart=ProcessRestart("always")), member("c"))

    assert told(course.ended("a", 0, 1.0)) == [("a", "ended")]
    assert again(course, course.ended("b", 0, 1.0)) == [SpawnProcess("b")]
    course.ended("c", 0, 1.0)
    assert not course.over
    assert course.exit_code == 0


def test_never_means_never() -> None:
    course = running(member("a", restart=ProcessRestart("no")))

    assert told(course.ended("a", 1, 1.0)) == [("a", "given_up")]
    assert course.over
    assert course.exit_code == 1


def test_a_bad_configuration_would_be_bad_the_next_time_as_well() -> None:
    course = running(member("a"))

    assert told(course.ended("a", 4, 1.0)) == [("a", "given_up")]


def test_who_waits_for_one_that_has_ended_is_never_started() -> None:
    course = Course([member("a", restart=ProcessRestart("no")), member("b", "a"), member("c", "b")])
    course.start(0.0)

    assert told(course.ended("a", 1, 1.0)) == [("a", "given_up"), ("b", "given_up"), ("c", "given_up")]
    assert course.over
    assert course.exit_code == 1


def test_a_process_that_cannot_be_made() -> None:
    course = Course([member("a")])
    course.start(0.0)

    (only,) = course.unstartable("a", "too many open files", 0.0)
    assert isinstance(only, TellPerson)
    assert only.text == "cannot be started: too many open files"
    assert (course.over, course.exit_code) == (True, 1)


def test_who_is_not_ready_in_time_is_named_once() -> None:
    course = Course([member("a")])
    course.start(5.0)

    assert course.deadline_s == 5.0 + READY_S
    assert told(course.tick(5.0 + READY_S)) == [("a", "late")]
    assert course.tick(6.0 + READY_S) == []
    assert course.deadline_s is None


def test_missions_that_wait_begin_once_everybody_is_ready() -> None:
    course = Course([member("a", hold=True), member("b"), member("c", hold=True)])
    course.start(0.0)

    assert done(course.ready("a", 1.0)) == []
    assert done(course.ready("c", 1.0)) == []
    assert done(course.ready("b", 2.0)) == [BeginMission(("a", "c"))]


def test_one_that_was_started_again_begins_by_itself() -> None:
    course = running(member("a", hold=True), member("b", hold=True))
    assert again(course, course.ended("a", 1, 3.0)) == [SpawnProcess("a")]

    assert done(course.ready("a", 4.0)) == [BeginMission(("a",))]


def test_a_mission_does_not_begin_without_one_of_the_fleet() -> None:
    course = Course([member("a", hold=True), member("b", restart=ProcessRestart("no"))])
    course.start(0.0)

    assert told(course.ended("b", 1, 1.0)) == [("b", "given_up"), ("", "held")]
    assert done(course.ready("a", 2.0)) == []


def test_missions_can_be_left_at_0() -> None:
    course = Course([member("a", hold=True)], begin=False)
    course.start(0.0)

    assert done(course.ready("a", 1.0)) == []
