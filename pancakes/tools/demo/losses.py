"""Carries out what a demo says of the loss of an agent: kills it when its time has come, and starts it again."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, Literal

import msgspec
from msgspec.structs import replace

from pancakes.tools.demo.demo import Loss

HAIR_S: Final = 1e-6
"""A step whose time has come is due, even where rounding puts the mission's clock a hair before it."""


class LossStep(msgspec.Struct, frozen=True):
    """Something that was done about an agent, as the launcher tells the conductor.

    Attributes:
        agent: the agent.
        kind: what was done: it was killed, or it was started again. So the event is called, too.
        t_s: when, in mission time.
    """

    agent: str
    kind: Literal["agent_lost", "agent_returned"]
    t_s: float


class Losses:
    """The steps of a mission's loss, one after the other. In the thread that starts agents.

    Args:
        loss: what is to happen; None: nothing.
        seed: the run's seed.
        now: the mission's clock.
        kill: ends an agent at once, by its name.
        start: starts it again on its disk.
        told: takes each step that was done.
    """

    def __init__(
        self,
        loss: Loss | None,
        seed: int,
        now: Callable[[], float],
        kill: Callable[[str], None],
        start: Callable[[str], None],
        told: Callable[[LossStep], None],
    ) -> None:
        self._now = now
        self._told = told
        self._steps: list[tuple[LossStep, Callable[[str], None]]] = []
        if loss is not None:
            at_s = loss.at_s(seed)
            self._steps.append((LossStep(loss.agent, "agent_lost", at_s), kill))
            self._steps.append((LossStep(loss.agent, "agent_returned", at_s + loss.away_s), start))

    def wait_s(self) -> float:
        """Returns how long it is until something is to be done, in mission seconds; infinity: nothing ever is."""
        return max(0.0, self._steps[0][0].t_s - self._now()) if self._steps else math.inf

    def look(self) -> None:
        """Does what is due."""
        while self.wait_s() <= HAIR_S:
            step, act = self._steps.pop(0)
            now_s = self._now()  # before it is done: what follows from it comes later
            act(step.agent)
            self._told(replace(step, t_s=now_s))
