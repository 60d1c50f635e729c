"""Agents as processes with tasks that burn processor time, and what psutil says of them."""

from __future__ import annotations

import os
import statistics
import time
from typing import Final
from unittest import mock

import psutil
import pytest
from cli.processes import Rig, Running

from pancakes.client import Client
from pancakes.control import Measure
from pancakes.tools.forecast import MeasuredAgent
from pancakes.util import codecs

SOURCE: Final = """
from dataclasses import dataclass

from pancakes.task import Task, every


class Burn(Task):
    @dataclass
    class Settings:
        loops: int = 1000

    @every(hz=10)
    def burn(self, tick):
        total = 0
        for number in range(self.settings.loops):
            total += number & 7
"""
WINDOW_S: Final = 4.0
MOST_WINDOWS: Final = 12
MISSED_SHARE: Final = 0.02
DRIFT_SHARE: Final = 0.05


class BurningFleet:
    """Agents of a rig that know each other; used in a `with` statement.

    Args:
        rig: starts them.
        tasks: for each agent, by name, the loops and the rate of its tasks, by name.
    """

    def __init__(self, rig: Rig, tasks: dict[str, dict[str, tuple[int, float]]]) -> None:
        rig.install("burning", "[pancakes.tasks]\nburning.Burn = plugin_burning:Burn\n", SOURCE)
        self.rig = rig
        self.running: dict[str, Running] = {}
        peers: list[str] = []
        for agent, burns in tasks.items():
            text = "".join(
                f'[task.{name}]\ntype = "burning.Burn"\nrate_hz = {hz}\nsettings = {{ loops = {loops} }}\n'
                for name, (loops, hz) in burns.items()
            )
            known = f"peers = {peers!r}".replace("'", '"')
            self.running[agent] = rig.ready(agent, text, agent=f"birth_wait_s = 0\n{known}")
            peers.append(rig.address(self.running[agent]))
        self._environment = {"PANCAKES_RUNTIME_DIR": str(rig.runtime), **rig.keys.environment}
        self._patch = mock.patch.dict(os.environ, self._environment)

    def __enter__(self) -> BurningFleet:
        self._patch.start()
        self.client = Client(timeout_s=20.0)
        others = len(self.running) - 1
        assert self.client.wait(lambda: all(len(it.neighbours) == others for it in self.client.agents()), 20.0)
        return self

    def __exit__(self, *error: object) -> None:
        self.client.close()
        self._patch.stop()

    def measured(self, for_s: float) -> list[MeasuredAgent]:
        """Returns what the agents measure of themselves."""
        replies = self.client.request_all(Measure(for_s), timeout_s=for_s + 20.0).replies
        assert all(reply.ok for _, reply in replies) and len(replies) == len(self.running)
        return [codecs.convert(reply.result, MeasuredAgent) for _, reply in replies]

    def looked_at(self, before: list[MeasuredAgent] | None = None) -> tuple[list[MeasuredAgent], dict[str, float]]:
        """Returns what the agents measure of themselves, and the processors that each takes, as the system counts.

        A window says nothing of the agents in which the machine has no time for them, so that their ticks are missed,
        or in which the same ticks take another time than before, as its processors have more or less to do. Then it
        looks again.

        Args:
            before: what was measured before; None: nothing was.
        """
        for _ in range(MOST_WINDOWS):
            processes = {agent: psutil.Process(running.pid) for agent, running in self.running.items()}
            began = {agent: (time.monotonic(), sum(it.cpu_times()[:2])) for agent, it in processes.items()}
            figures = self.measured(WINDOW_S)
            ended = {agent: (time.monotonic(), sum(it.cpu_times()[:2])) for agent, it in processes.items()}
            timers = [timer for it in figures for task in it.tasks for timer in task.timers]
            calm = all(it.missed <= 1 + MISSED_SHARE * it.ticks for it in timers)
            was, now = ticks_of(before or figures), ticks_of(figures)
            drift = statistics.median(now[task] / was[task] for task in now if task in was)
            if calm and abs(drift - 1.0) <= DRIFT_SHARE:
                loads = {it: (ended[it][1] - began[it][1]) / (ended[it][0] - began[it][0]) for it in processes}
                return figures, loads
        raise pytest.skip.Exception("this machine is too busy: the agents never get the time that they want")


def ticks_of(figures: list[MeasuredAgent]) -> dict[str, float]:
    """Returns what a tick of each task that burns took, in seconds, wherever it is."""
    return {
        task.task: timer.tick_s / timer.ticks
        for it in figures
        for task in it.tasks
        for timer in task.timers
        if task.service == "client" and timer.ticks
    }
