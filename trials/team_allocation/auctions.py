"""Rounds of the allocation without agents: how near they come to the optimum, and how often a task would move."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Final

from allocation.rounds import Robot, Team, drawn
from msgspec.structs import replace

from pancakes.durable.market import moved_again_price
from pancakes.durable.optimum import optimum_of

BETWEEN_S: Final = 60.0
"""A round each minute is far more than changes of a team in steady state ask for."""
NOISE: Final = 0.1
"""How much costs differ from round to round: a standard deviation, in their unit (the price of a move is 0.5)."""


@dataclass(frozen=True)
class Auction:
    """What a round came to.

    Attributes:
        seed: what it was drawn from.
        value: what it is worth.
        optimum: what the best allocation is worth; None: the solver has not found it.
        round_s: how long it took, in simulated time.
        agreed: whether all agents knew that all agree.
        faults: what is wrong with it.
    """

    seed: int
    value: float
    optimum: float | None
    round_s: float
    agreed: bool
    faults: tuple[str, ...]

    @property
    def share(self) -> float | None:
        """The value as a share of the optimum."""
        return self.value / self.optimum if self.optimum else None


def auction(seed: int, robots: int, tasks: int, loss: float, coupled: bool) -> Auction:
    """Holds one round of a team that is drawn."""
    team = Team(_drawn(seed, robots, tasks, coupled), loss, seed)
    starter = f"robot{seed % robots}"
    team.begin(starter)
    round_s = team.run()
    market, bundles = team.rounds[starter].market, team.allocation()
    best = optimum_of(market)
    agreed = all(it.agreed for it in team.rounds.values())
    faults = tuple(market.faults(bundles))
    return Auction(seed, market.value(bundles), best[0] if best else None, round_s, agreed, faults)


def steady_moves(seed: int, robots: int, tasks: int, loss: float, rounds: int) -> dict[str, int]:
    """Holds rounds one after the other, with costs that differ a little; returns how often each task moved.

    The first round, in which the tasks find their places, does not count.
    """
    draw = random.Random(f"moves/{seed}")
    team = _drawn(seed, robots, tasks, False)
    exact = {name: dict(robot.costs) for name, robot in team.items()}
    moves: dict[str, int] = {}
    for number in range(rounds + 1):
        for name, robot in team.items():
            costs = {key: max(0.0, cost + draw.gauss(0.0, NOISE)) for key, cost in exact[name].items()}
            team[name] = Robot(robot.at_most, robot.crowding, robot.lots, costs)
        network = Team(team, loss, seed * 1000 + number)
        network.begin(f"robot{number % robots}", number + 1)
        network.run()
        lots = {key: lot for robot in team.values() for key, lot in robot.lots.items()}
        owners = {key: name for name, robot in team.items() for key in robot.lots}
        for name, keys in network.allocation().items():
            for key in keys:
                if owners[key] != name:
                    owners[key] = name
                    lots[key] = replace(lots[key], move_price=moved_again_price(lots[key]))
                    moves[key] = moves.get(key, 0) + (number > 0)
        for name, robot in team.items():
            mine = {key: lot for key, lot in lots.items() if owners[key] == name}
            team[name] = Robot(robot.at_most, robot.crowding, mine, robot.costs)
    return moves


def _drawn(seed: int, robots: int, tasks: int, coupled: bool) -> dict[str, Robot]:
    # A little more room than there are tasks: one robot less, and all still find a place.
    return drawn(seed, robots, tasks, coupled=coupled, at_most=-(-tasks // (robots - 1)))
