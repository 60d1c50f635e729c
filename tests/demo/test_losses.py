"""What a demo says of the loss of an agent is done when its time has come."""

from __future__ import annotations

import math

import pytest

from pancakes.tools.demo import Death, Loss
from pancakes.tools.demo.conductor import Losses, LossStep
from pancakes.util.clock import VirtualClock

LOSS = Loss(("agent1",), earliest_s=70.0, latest_s=110.0, away_s=60.0)


def test_the_time_of_a_loss_is_drawn_from_the_seed() -> None:
    times = [LOSS.times(seed, 300.0) for seed in range(50)]
    assert all(len(found) == 1 and 70.0 <= found[0].at_s <= 110.0 for found in times)
    assert all(found[0].back_s == found[0].at_s + 60.0 for found in times)
    assert len({found[0].at_s for found in times}) == 50 and times == [LOSS.times(seed, 300.0) for seed in range(50)]


HOURLY = Loss(("a", "b", "c"), earliest_s=600.0, latest_s=2100.0, away_s=900.0, every_s=3600.0)


def test_a_loss_that_is_repeated_kills_one_agent_in_each_period() -> None:
    deaths = HOURLY.times(1, 6 * 3600.0)
    assert len(deaths) == 6 and {death.agent for death in deaths} <= {"a", "b", "c"}
    for number, death in enumerate(deaths):
        assert 600.0 <= death.at_s - 3600.0 * number <= 2100.0 and death.back_s == death.at_s + 900.0
    others = [HOURLY.times(seed, 6 * 3600.0) for seed in range(2, 12)]
    assert {death.agent for found in others for death in found} == {"a", "b", "c"}


def test_a_mission_that_is_shorter_than_the_period_has_its_loss_in_proportion() -> None:
    (death,) = HOURLY.times(1, 900.0)
    (whole,) = HOURLY.times(1, 3600.0)
    assert death == Death(whole.agent, 0.25 * whole.at_s, 0.25 * whole.at_s + 225.0)


def test_the_first_hours_of_a_longer_mission_have_the_same_losses() -> None:
    assert HOURLY.times(5, 6 * 3600.0)[:2] == HOURLY.times(5, 2 * 3600.0)


@pytest.mark.parametrize(
    ("fault", "what"),
    [
        ({"agents": ()}, "needs an agent"),
        ({"earliest_s": 2200.0}, "cannot be between 2200 and 2100 s"),
        ({"away_s": 1600.0}, "must be back before the next one is lost"),
        ({"away_s": -1.0}, "cannot be away for -1 s"),
        ({"away_s": math.nan}, "cannot be away for nan s"),
        ({"every_s": math.nan}, "must be back before the next one is lost"),
        ({"earliest_s": 0.0, "latest_s": 0.0, "away_s": 0.0, "every_s": 0.0}, "every_s is too short"),
    ],
)
def test_a_loss_that_cannot_be_is_refused_with_a_sentence(fault: dict[str, object], what: str) -> None:
    good = {"agents": ("a",), "earliest_s": 600.0, "latest_s": 2100.0, "away_s": 900.0, "every_s": 3600.0}
    with pytest.raises(ValueError, match=what):
        Loss(**{**good, **fault})  # type: ignore[arg-type]


def test_an_agent_is_killed_and_started_again_once_each() -> None:
    clock = VirtualClock()
    done: list[str] = []
    told: list[LossStep] = []
    losses = Losses(
        LOSS.times(3, 300.0),
        clock.now,
        lambda agent: done.append(f"kill {agent}"),
        lambda agent: done.append(f"start {agent}"),
        told.append,
    )
    at_s = LOSS.times(3, 300.0)[0].at_s
    assert losses.wait_s() == at_s
    clock.advance_to(at_s - 1.0)
    losses.look()
    assert done == []
    clock.advance_to(at_s + 0.25)
    losses.look()
    assert done == ["kill agent1"] and told == [LossStep("agent1", "agent_lost", at_s + 0.25)]
    assert losses.wait_s() == at_s + 60.0 - clock.now()
    clock.advance_to(200.0)
    losses.look()
    assert done == ["kill agent1", "start agent1"] and told[1:] == [LossStep("agent1", "agent_returned", 200.0)]
    assert losses.wait_s() == math.inf


def test_a_step_is_due_where_rounding_puts_the_clock_a_hair_before_it() -> None:
    clock = VirtualClock()
    done: list[str] = []
    losses = Losses(LOSS.times(3, 300.0), clock.now, done.append, done.append, lambda step: None)
    clock.advance_to(LOSS.times(3, 300.0)[0].at_s - 1e-9)
    losses.look()
    assert done == ["agent1"]


def test_a_mission_without_a_loss_waits_for_none() -> None:
    done: list[str] = []
    losses = Losses((), VirtualClock(1e6).now, done.append, done.append, lambda step: None)
    losses.look()
    assert losses.wait_s() == math.inf and not done
