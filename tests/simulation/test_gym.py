"""The learning environment: what gymnasium's own checker says of it, and what its numbers mean."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from pancakes.gym import DriveToGoal
from pancakes.simulation import SimulationError

ID = "pancakes/DriveToGoal-v0"


@pytest.fixture
def environment(no_leaks):
    made = DriveToGoal(render_mode="rgb_array")
    yield made
    made.close()


def towards(goal: np.ndarray) -> np.ndarray:
    """Return wheel speeds that turn to the goal, and drive to it."""
    bearing = np.arctan2(goal[1], goal[0])
    speed, turn = 0.25 * max(0.0, np.cos(bearing)), 0.1 * np.clip(bearing, -1.0, 1.0)
    return np.array([speed - turn, speed + turn], np.float32)


def test_the_checker_of_gymnasium_passes_it():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made = gymnasium.make(ID, render_mode="rgb_array")
        check_env(made.unwrapped)


def test_a_robot_that_is_steered_to_its_goal_gets_there_and_is_paid_for_the_way(environment):
    seen, info = environment.reset(seed=3)
    assert np.hypot(*seen[:2]) == pytest.approx(info["distance_m"], abs=0.01)
    first_m, paid = info["distance_m"], 0.0
    for _ in range(300):
        seen, reward, reached, cut_off, info = environment.step(towards(seen[:2]))
        paid += reward
        assert environment.observation_space.contains(seen) and not cut_off
        if reached:
            break
    assert reached and info["distance_m"] <= 0.1 and info["collisions"] == 0
    assert paid == pytest.approx(1.0 + first_m - info["distance_m"])
    assert environment.simulation.body("robot").driven_by == "Pilot"


def test_walls_are_seen_and_cost(environment):
    environment.reset(seed=5)
    paid, seen = 0.0, np.zeros(11)
    for _ in range(200):
        seen, reward, _, _, info = environment.step(np.array([0.333, 0.333], np.float32))
        paid += reward
        if info["collisions"]:
            break
    assert info["collisions"] == 1 and reward < -0.05
    assert min(seen[2:]) < 0.05


def test_the_same_seed_and_actions_give_the_same_episode_and_the_next_one_differs(environment):
    def episode(seed: int | None) -> list[np.ndarray]:
        first, _ = environment.reset(seed=seed)
        rng = np.random.default_rng(0)
        return [first] + [environment.step(rng.uniform(-0.3, 0.3, 2))[0] for _ in range(50)]

    one = episode(11)
    other = episode(None)
    again, other_again = episode(11), episode(None)
    assert np.array_equal(one, again) and np.array_equal(other, other_again)
    assert not np.array_equal(one, other)


def test_several_learn_at_once(no_leaks):
    many = gymnasium.make_vec(ID, num_envs=3, vectorization_mode="sync")
    seen, _ = many.reset(seed=[1, 2, 1])
    for _ in range(20):
        seen, *_ = many.step(np.array([towards(it[:2]) for it in seen]))
    many.close()
    assert np.array_equal(seen[0], seen[2]) and not np.array_equal(seen[0], seen[1])


def test_a_picture_shows_the_robot_where_it_is(environment):
    environment.reset(seed=2)
    picture = environment.render()
    assert picture.shape == (300, 300, 3)
    robot = environment.simulation.body("robot")
    row, column = round(100 * (1.5 - robot.y_m)), round(100 * (1.5 + robot.x_m))
    assert tuple(picture[row, column]) == (60, 90, 200)
    assert DriveToGoal().render() is None


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"posts": 20}, "3 m x 3 m with 20 posts cannot be drawn"),
        ({"width_m": 1.0}, "each side is 2 m or more"),
        ({"step_s": 0.0}, "step_s = 0.0"),
        ({"render_mode": "human"}, "no render_mode 'human'"),
    ],
)
def test_what_it_cannot_be_made_of_is_said_in_a_sentence(arguments, sentence):
    with pytest.raises(SimulationError, match=sentence):
        DriveToGoal(**arguments)


@pytest.mark.parametrize("action", [[0.1], [0.1, float("nan")], [0.1, 0.1, 0.1]])
def test_what_is_no_action_is_said_in_a_sentence(environment, action):
    with pytest.raises(SimulationError, match="call `reset` first"):
        environment.step(np.zeros(2, np.float32))
    environment.reset(seed=1)
    with pytest.raises(SimulationError, match="must be two wheel speeds in m/s"):
        environment.step(np.array(action, np.float32))


def test_speeds_beyond_the_wheels_are_those_that_the_wheels_can(environment):
    environment.reset(seed=1)
    environment.step(np.array([9.0, 9.0], np.float32))
    assert environment.simulation.body("robot").v_mps <= 0.34
