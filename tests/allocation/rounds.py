"""Rounds of several agents over a network that loses packets, in simulated time; and markets that are drawn."""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass, field

from pancakes.durable.auction import Round, RoundId
from pancakes.durable.market import Lot, Row

STEP_S = 0.02


@dataclass
class Robot:
    """What an agent brings into a round."""

    at_most: int = 5
    crowding: float = 0.0
    lots: Mapping[str, Lot] = field(default_factory=dict)
    costs: Mapping[str, float] = field(default_factory=dict)


class Team:
    """Agents that hold a round over a network.

    Args:
        robots: the agents, by name.
        loss: the share of packets that is lost.
        seed: what the network draws from.
    """

    def __init__(self, robots: Mapping[str, Robot], loss: float = 0.0, seed: int = 1) -> None:
        self.robots = robots
        self.now_s = 0.0
        self.loss = loss
        self.dead: set[str] = set()
        self.apart: set[frozenset[str]] = set()  # the pairs that are not linked
        self.packets = 0
        self.rounds: dict[str, Round] = {}
        self.over: dict[str, float] = {}
        self._draw = random.Random(seed)
        self._flying: list[tuple[float, int, str, str, Row]] = []

    def begin(self, starter: str, number: int = 1) -> None:
        """Has an agent begin a round."""
        self.over.clear()
        self.rounds.clear()
        self._join(starter, RoundId(number, starter))

    def begin_too(self, starter: str, number: int = 1) -> None:
        """Has another agent begin a round at the same time."""
        self._join(starter, RoundId(number, starter))

    def _join(self, name: str, id: RoundId) -> None:
        robot = self.robots[name]
        self.rounds[name] = Round(name, id, False, robot.at_most, robot.crowding, robot.lots, self.now_s)
        self._price(name)

    def _price(self, name: str) -> None:
        auction, costs = self.rounds[name], self.robots[name].costs
        keys = auction.unpriced()
        found = {key: costs[key] for key in keys if key in costs}
        refused = {key: "lacks the device type gripper" for key in keys if key not in costs}
        auction.price(found, refused, self.now_s)

    def step(self) -> None:
        """Let some time pass."""
        self.now_s += STEP_S
        arrived = sorted(it for it in self._flying if it[0] <= self.now_s)
        self._flying = [it for it in self._flying if it[0] > self.now_s]
        for _, _, source, to, row in arrived:
            if to in self.dead:
                continue
            id = RoundId(row.number, row.starter)
            known = self.rounds.get(to)
            if known is None or id.is_later_than(known.id):
                self._join(to, id)
            if self.rounds[to].id == id:
                self.rounds[to].take(source, row, self.now_s)
                self._price(to)
        for name, auction in self.rounds.items():
            if name in self.dead:
                continue
            if auction.tick(self.now_s):
                self.over[name] = self.now_s
            for to, row in auction.due([it for it in self.robots if it != name], self.now_s):
                self.say(name, to, row)

    def say(self, source: str, to: str, row: Row) -> None:
        """Sends a row; it may be lost, doubled or late."""
        self.packets += 1
        if self._draw.random() >= self.loss and frozenset((source, to)) not in self.apart:
            for _ in range(2 if self._draw.random() < 0.05 else 1):
                self._flying.append((self.now_s + self._draw.uniform(0.002, 0.08), self.packets, source, to, row))

    def run(self, most_s: float = 20.0) -> float:
        """Runs until all agents that joined are through; returns how long that took."""
        began_s = self.now_s
        while self.now_s < began_s + most_s:
            self.step()
            living = [it for it in self.rounds if it not in self.dead]
            if living and all(it in self.over for it in living):
                break
        return self.now_s - began_s

    def allocation(self) -> dict[str, list[str]]:
        """Returns what the agents that have the tasks say about them."""
        found: dict[str, list[str]] = {}
        for name, auction in self.rounds.items():
            if name in self.dead:
                continue
            for agent, keys in auction.bundles().items():
                found.setdefault(agent, []).extend(key for key in keys if auction.market.lots[key].owner == name)
        return found


def drawn(seed: int, robots: int, tasks: int, *, coupled: bool = False, at_most: int = 3) -> dict[str, Robot]:
    """Returns a market that is drawn from a seed: robots and tasks in a square of 10 m, the cost is the distance."""
    draw = random.Random(seed)
    names = [f"robot{number}" for number in range(robots)]
    places = {name: (draw.uniform(0, 10), draw.uniform(0, 10)) for name in names}
    lots: dict[str, dict[str, Lot]] = {name: {} for name in names}
    costs: dict[str, dict[str, float]] = {name: {} for name in names}
    for number in range(tasks):
        owner = draw.choice(names)
        key = f"{owner}/Task{number}"
        lot = Lot(value=draw.uniform(5, 20), move_price=0.5)
        if coupled:
            takes_s = draw.choice((0.0, 5.0, 10.0))
            lot = Lot(
                lot.value,
                lot.move_price,
                takes_s,
                draw.choice((None, 8.0, 15.0, 25.0)),
                (f"Task{draw.randrange(number)}",) if number and draw.random() < 0.25 else (),
                (f"Task{draw.randrange(number)}",) if number and draw.random() < 0.25 else (),
            )
        lots[owner][key] = lot
        x, y = draw.uniform(0, 10), draw.uniform(0, 10)
        for name in names:
            if draw.random() < 0.9:
                costs[name][key] = ((x - places[name][0]) ** 2 + (y - places[name][1]) ** 2) ** 0.5
    return {name: Robot(at_most, 0.3, lots[name], costs[name]) for name in names}
