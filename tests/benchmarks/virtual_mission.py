"""How fast a mission runs in virtual time: the encirclement of the paper, with its four agents and the launcher.

It is what `pancakes demo encirclement --virtual` runs, without the start and without the pictures. There is nothing
bare beside it: the baseline is real time.
"""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from benchmarks.figure import Figure, Plan

from pancakes.demo.conductor import Mission
from pancakes.demo.launcher import fresh, run_virtual
from pancakes.demo.plan import find_configs, make_plan
from pancakes.plugins import Plugins

TITLE = "a mission in virtual time"
BESIDE = ""
DEMO = "encirclement"
WANTED = 200.0
"""Times real time."""


def mission(seed: int, share: float) -> float:
    """One run. Returns how many times faster than real time it was."""
    demo = Plugins().get("pancakes.demos", DEMO)
    duration_s = max(10.0, demo.duration_s * share)
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name:
        out = Path(name) / "out"
        plan = make_plan(demo, find_configs(DEMO), out, seed, 1.0, duration_s, (), live=False)
        fresh(out)
        timing = run_virtual(plan, Mission(demo.agents, duration_s), threading.Event())
    return float(timing["times_real_time"])


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    mission(1, 0.0)  # the first one imports what the agents need
    runs = [mission(seed, plan.scale) for seed in range(1, plan.rounds + 1)]
    yield Figure(f"{DEMO}, start-up apart", "x", "min", WANTED, runs, absolute=True)
