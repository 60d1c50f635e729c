"""The faults of `rps` 0.0.0 that `Laboratory` keeps from its callers; each is shown to be one."""

from __future__ import annotations

import math
import random
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy
import pytest
from pancakes_robotarium.gternal import GTERNAL
from pancakes_robotarium.laboratory import Counts, Laboratory, Place

from pancakes.devices import Twist
from pancakes.errors import PancakesError

STILL = Twist(0.0, 0.0)
Make = Callable[..., Laboratory]


@pytest.fixture
def laboratory(robotarium: Any) -> Make:
    """Makes a laboratory with robots at these places."""
    return lambda *places: Laboratory([Place(*place) for place in places], random.Random(1), robotarium)


def go(laboratory: Laboratory, steps: int, *twists: Twist) -> None:
    for _ in range(steps):
        laboratory.step(twists)


def plain(robotarium: Any, *places: Sequence[float]) -> Any:
    """Returns the simulator as it is, with robots at these places."""
    start = numpy.array(places, dtype=float).T.copy()
    count = len(places)
    return robotarium(number_of_robots=count, show_figure=False, sim_in_real_time=False, initial_conditions=start)


def counted(robotarium: Any) -> Any:
    """Returns what the simulator as it is has counted."""
    return robotarium._errors  # noqa: SLF001 - theirs


def test_robot_goes_where_its_wheels_take_it(laboratory: Make) -> None:
    made = laboratory((0.0, 0.0, 0.0))
    go(made, 100, Twist(0.1, 0.0))
    assert made.places[0].x_m == pytest.approx(100 * 0.033 * 0.1)
    assert (made.step_s, made.half_width_m, made.half_height_m, made.diameter_m) == (0.033, 1.6, 1.0, 0.11)
    assert made.counts() == Counts(100, 0, 0, 0)


def test_command_that_wheels_cannot_do_keeps_its_curve(laboratory: Make, robotarium: Any) -> None:
    made = laboratory((0.0, 0.0, 0.0))
    go(made, 50, Twist(0.2, 1.0))
    (done,) = made.twists
    assert done.v_mps / done.omega_radps == pytest.approx(0.2)
    assert done.v_mps + 0.5 * 0.105 * done.omega_radps == pytest.approx(0.2)
    assert made.counts() == Counts(50, 0, 0, 0)
    as_it_is = plain(robotarium, (0.0, 0.0, 0.0))
    as_it_is.get_poses()
    as_it_is.set_velocities([0], numpy.array([[0.2], [1.0]]))
    as_it_is.step()
    assert counted(as_it_is)["actuator"] >= 1, "so it is a fault that has to be kept from users"


def test_no_command_of_thousands_exceeds_the_actuators(laboratory: Make) -> None:
    made, draws = laboratory(*((-1.2 + 0.2 * i, 0.0, 0.0) for i in range(10))), random.Random(2)
    for _ in range(200):
        made.step([Twist(draws.uniform(-0.4, 0.4), draws.uniform(-6.0, 6.0)) for _ in range(10)])
    counts = made.counts()
    assert counts is not None and counts.actuator == 0


@pytest.mark.parametrize("bad", [Twist(math.nan, 0.0), Twist(0.0, math.inf), Twist(1e308, 1e308)])
def test_command_that_is_no_number_moves_nothing(bad: Twist, laboratory: Make) -> None:
    made = laboratory((0.0, 0.0, 0.5), (0.5, 0.0, 0.0))
    go(made, 5, bad, Twist(0.1, 0.0))
    assert made.places[0] == Place(0.0, 0.0, 0.5)
    assert made.places[1].x_m == pytest.approx(0.5 + 5 * 0.033 * 0.1)


def test_counts_of_two_laboratories_are_apart(laboratory: Make, robotarium: Any) -> None:
    near, far = laboratory((0.0, 0.0, 0.0), (0.05, 0.0, 0.0)), laboratory((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    go(near, 3, STILL, STILL)
    go(far, 3, STILL, STILL)
    assert (near.counts(), far.counts()) == (Counts(3, 3, 0, 0), Counts(3, 0, 0, 0))
    shared = [plain(robotarium, (0.0, 0.0, 0.0), (0.05, 0.0, 0.0)), plain(robotarium, (0.0, 0.0, 0.0))]
    try:
        for one in shared:
            one.get_poses()
            one.step()
        assert counted(shared[1]).get("collision"), "so it is a fault that has to be kept from users"
    finally:
        robotarium._validate.__defaults__[0].clear()  # noqa: SLF001 - theirs


def test_what_was_given_and_got_is_nobody_elses(laboratory: Make) -> None:
    made = laboratory((0.0, 0.0, 0.0))
    before, twists = made.places, [Twist(0.1, 0.0)]
    go(made, 3, *twists)
    assert before == [Place(0.0, 0.0, 0.0)] and twists == [Twist(0.1, 0.0)]


def test_each_robot_needs_a_command_at_each_step(laboratory: Make) -> None:
    made = laboratory((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    with pytest.raises(PancakesError, match="2 robots got 1 commands"):
        made.step([STILL])


def test_judge_counts_collisions_and_boundaries(laboratory: Make) -> None:
    made = laboratory((1.59, 0.0, 0.0), (0.0, 0.0, 0.0), (0.1, 0.0, 0.0))
    go(made, 10, Twist(0.2, 0.0), STILL, STILL)
    counts = made.counts()
    assert counts is not None and not counts.clean
    assert counts.collision == 10 and 0 < counts.boundary < 10


def test_end_returns_the_words_of_its_judge_once(laboratory: Make, capsys: pytest.CaptureFixture[str]) -> None:
    made = laboratory((0.0, 0.0, 0.0), (0.05, 0.0, 0.0))
    go(made, 2, STILL, STILL)
    said = made.end()
    assert any("2 iteration(s) where robots collided" in line for line in said)
    assert made.end() == []
    assert capsys.readouterr().out == ""


def test_what_others_print_meanwhile_is_theirs(robotarium: Any, capsys: pytest.CaptureFixture[str]) -> None:
    inside, printed = threading.Event(), threading.Event()

    class Slow(robotarium):
        def call_at_scripts_end(self) -> None:
            inside.set()
            assert printed.wait(10.0)
            super().call_at_scripts_end()

        call_at_scripts_end.__module__ = robotarium.__module__

    def other() -> None:
        assert inside.wait(10.0)
        print("a line of another thread")
        printed.set()

    thread = threading.Thread(target=other)
    thread.start()
    said = Laboratory([Place(0.0, 0.0, 0.0)], random.Random(1), Slow).end()
    thread.join()
    assert capsys.readouterr().out == "a line of another thread\n"
    assert said[-1].startswith("No errors in your simulation!")


def test_numpy_draws_of_others_stay_as_they_are(laboratory: Make) -> None:
    numpy.random.seed(5)
    expected = numpy.random.RandomState(5).uniform()
    go(laboratory((0.0, 0.0, 0.0)), 3, STILL)
    assert numpy.random.uniform() == expected


@pytest.mark.parametrize(
    ("places", "said"),
    [
        ([], "the Robotarium has 1 to 50 robots, not 0"),
        ([(0.0, 0.0, 0.0)] * 51, "the Robotarium has 1 to 50 robots, not 51"),
        ([(math.nan, 0.0, 0.0)], "has no place at first"),
    ],
)
def test_laboratory_that_cannot_be_made_says_why(places: Any, said: str, laboratory: Make) -> None:
    with pytest.raises(PancakesError, match=said):
        laboratory(*places)


def test_missing_simulator_is_named_with_its_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rps", None)
    monkeypatch.setitem(sys.modules, "rps.robotarium", None)
    with pytest.raises(PancakesError, match="is not installed: pip install robotarium-python-simulator"):
        Laboratory([Place(0.0, 0.0, 0.0)], random.Random(1))


def test_model_has_the_wheels_of_the_simulator(laboratory: Make) -> None:
    drive = laboratory((0.0, 0.0, 0.0)).drive
    assert GTERNAL.drive.wheel_base_m == drive.wheel_base_m
    assert GTERNAL.drive.max_wheel_mps == pytest.approx(drive.max_wheel_mps)
    assert GTERNAL.drive.max_omega_radps == pytest.approx(drive.max_omega_radps)


class Later:
    """The interface of version 2.1, as far as it is used: names in capitals, other counts, sensors, `debug`."""

    TIME_STEP, ROBOT_DIAMETER, WHEEL_RADIUS, BASE_LENGTH = 0.033, 0.11, 0.016, 0.11
    MAX_LINEAR_VELOCITY, MAX_WHEEL_VELOCITY, MAX_ANGULAR_VELOCITY = 0.2, 12.5, 0.4 / 0.11
    BOUNDARIES = numpy.array([-1.6, 1.6, -1.0, 1.0])
    made: ClassVar[list[Later]] = []

    def __init__(self, **options: Any) -> None:
        assert options["skip_initialization"] and options["use_distance_sensors"]
        self.poses = options["initial_conditions"]
        self.noise: list[float] = []
        self.made.append(self)
        self._errors = {"robots_too_close": 2, "exceeded_actuator_limits": 0, "flew_away": 1}

    def get_poses(self) -> Any:
        return self.poses.copy()

    def set_velocities(self, ids: Any, velocities: Any) -> None:
        self._velocities = velocities

    def step(self) -> None:
        self.noise.append(numpy.random.uniform())

    def get_distances(self) -> Any:
        return numpy.full((7, self.poses.shape[1]), -1.0)

    def debug(self) -> None:
        print("No errors or warnings in your simulation!")


def test_later_version_is_asked_what_it_can_do() -> None:
    numpy.random.seed(7)
    made, again = (Laboratory([Place(0.0, 0.0, 0.0)], random.Random(3), Later) for _ in range(2))
    go(made, 2, Twist(0.2, 1.0))
    go(again, 2, Twist(0.2, 1.0))
    assert (made.half_width_m, made.half_height_m, made.drive.wheel_base_m) == (1.6, 1.0, 0.11)
    assert made.counts() == Counts(2, 2, 0, 0, other=1)
    assert made.ranges() == [[-1.0] * 7]
    assert made.end() == ["No errors or warnings in your simulation!"]
    assert Later.made[-1].noise == Later.made[-2].noise, "its noise is drawn from the seed of this laboratory"
    assert numpy.random.uniform() == numpy.random.RandomState(7).uniform(), "and not from that of everybody"


def test_laboratory_without_counts_tells_none() -> None:
    class Real(Later):
        def __init__(self, **options: Any) -> None:
            super().__init__(**options)
            del self._errors

    assert Laboratory([Place(0.0, 0.0, 0.0)], random.Random(3), Real).counts() is None


def test_robot_that_is_not_seen_keeps_its_last_place() -> None:
    made = Laboratory([Place(0.0, 0.0, 0.0), Place(1.0, 0.0, 0.0)], random.Random(3), Later)
    Later.made[-1].poses[:, 1] = math.nan
    go(made, 1, STILL, STILL)
    assert made.unseen == {1} and made.places == [Place(0.0, 0.0, 0.0), Place(1.0, 0.0, 0.0)]
    Later.made[-1].poses[:, 1] = 0.5
    go(made, 1, STILL, STILL)
    assert made.unseen == set() and made.places[1] == Place(0.5, 0.5, 0.5)


def test_version_without_a_figure_is_named() -> None:
    class Bare(Later):
        def __getattribute__(self, name: str) -> Any:
            if name == "WHEEL_RADIUS":
                raise AttributeError(name)
            return super().__getattribute__(name)

    with pytest.raises(PancakesError, match="does not tell its wheel_radius"):
        Laboratory([Place(0.0, 0.0, 0.0)], random.Random(3), Bare)
