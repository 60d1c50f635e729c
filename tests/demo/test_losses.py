"""What a demo says of the loss of an agent is done when its time has come."""

from __future__ import annotations

import math

from pancakes.tools.demo import Loss
from pancakes.tools.demo.conductor import Losses, LossStep
from pancakes.util.clock import VirtualClock

LOSS = Loss("agent1", earliest_s=70.0, latest_s=110.0, away_s=60.0)


def test_the_time_of_a_loss_is_drawn_from_the_seed() -> None:
    times = [LOSS.at_s(seed) for seed in range(50)]
    assert all(70.0 <= time_s <= 110.0 for time_s in times)
    assert len(set(times)) == 50 and times == [LOSS.at_s(seed) for seed in range(50)]


def test_an_agent_is_killed_and_started_again_once_each() -> None:
    clock = VirtualClock()
    done: list[str] = []
    told: list[LossStep] = []
    losses = Losses(
        LOSS, 3, clock.now, lambda agent: done.append(f"kill {agent}"), lambda agent: done.append(f"start {agent}"),
        told.append,
    )  # fmt: skip
    at_s = LOSS.at_s(3)
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
    losses = Losses(LOSS, 3, clock.now, done.append, done.append, lambda step: None)
    clock.advance_to(LOSS.at_s(3) - 1e-9)
    losses.look()
    assert done == ["agent1"]


def test_a_mission_without_a_loss_waits_for_none() -> None:
    done: list[str] = []
    losses = Losses(None, 3, VirtualClock(1e6).now, done.append, done.append, lambda step: None)
    losses.look()
    assert losses.wait_s() == math.inf and not done
