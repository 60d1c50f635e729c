"""How fast a mission runs in virtual time: the encirclement of the paper, with its four agents and the launcher.

It is `pancakes demo encirclement --virtual`, as anybody runs it, without its start and without the pictures. There is
nothing bare beside it: the baseline is real time.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from itertools import count
from pathlib import Path

from benchmarks.agent_process import usual_environment
from benchmarks.figure import Figure, Plan, alone

from pancakes.util.plugins import Plugins

TITLE = "a mission in virtual time"
BESIDE = ""
DEMO = "encirclement"
WANTED = 160.0
"""Times real time."""


def mission(seed: int, share: float) -> float:
    """One run. Returns how many times faster than real time it was.

    Raises:
        RuntimeError: it did not come to its end.
    """
    duration_s = max(10.0, Plugins().get("pancakes.demos", DEMO).duration_s * share)
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name:
        out = Path(name) / "out"
        options = ["--virtual", "--headless", "--seed", str(seed), "--duration", f"{duration_s:g}", "--out", str(out)]
        command = [str(Path(sys.executable).with_name("pancakes")), "demo", DEMO, *options]
        ended = subprocess.run(command, env=usual_environment(), capture_output=True, text=True, check=False)
        timing = out / "timing.json"
        if not timing.is_file():
            raise RuntimeError(f"the mission of seed {seed} ended with {ended.returncode}: {ended.stderr.strip()}")
        return float(json.loads(timing.read_text())["times_real_time"])


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures everything."""
    seeds = count(1)
    figure = Figure(f"{DEMO}, start-up apart", "x", "min", WANTED, absolute=True)
    yield from alone(plan, [figure], lambda: [mission(next(seeds), plan.scale)])
