"""Moves and rates in real processes: what was forecast of each is compared with what then happens.

It burns CPU time on purpose and compares what it measures to a fifth, so it needs a machine with nothing else to do.
"""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest
from cli.processes import Rig
from what_if.burning import BurningFleet

from pancakes.control import Reschedule
from pancakes.tools.forecast import Forecast, forecast_move, forecast_rate

AGENTS = ("a", "b", "c")
CHANGES = 5
OFF_SHARE = 0.2
RATES_HZ = (5.0, 20.0, 60.0, 80.0)


@pytest.fixture
def rig(tmp_path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    try:
        yield rig
    finally:
        rig.close()


@pytest.mark.parametrize("seed", [1, 2])
def test_forecast_of_real_loads_is_off_by_a_fifth_at_most_full(seed: int, rig: Rig):
    rng = random.Random(seed)
    tasks: dict[str, dict[str, tuple[int, float]]] = {
        agent: {f"{agent}{number}": (rng.randrange(10_000, 60_000), rng.randrange(10, 40)) for number in range(2)}
        for agent in AGENTS
    }
    where = {task: agent for agent, burns in tasks.items() for task in burns}
    off, off_without = 0.0, 0.0
    concerned: tuple[str, ...]
    with BurningFleet(rig, tasks) as fleet:
        figures, loads = fleet.looked_at()
        for _ in range(CHANGES):
            task = rng.choice(sorted(where))
            agent = where[task]
            if rng.random() < 0.5:
                to = rng.choice([other for other in AGENTS if other != agent])
                forecast: Forecast = forecast_move(figures, agent, task, to)
                assert fleet.client.migrate(f"{agent}/{task}", to).winner == to
                where[task], concerned, change = to, (agent, to), f"{agent}/{task} moves to {to}"
            else:
                hz = rng.choice(RATES_HZ)
                forecast = forecast_rate(figures, agent, task, hz)
                assert fleet.client.request(agent, Reschedule(task, hz)).ok
                concerned, change = (agent,), f"{agent}/{task} ticks at {hz} Hz"
            before = loads
            figures, loads = fleet.looked_at(figures)
            for it in concerned:
                said = forecast.of(it).load_after
                assert said.value == pytest.approx(loads[it], rel=OFF_SHARE), (change, it, before[it])
                off += abs(said.value - loads[it])
                off_without += abs(before[it] - loads[it])
    assert off < 0.5 * off_without
