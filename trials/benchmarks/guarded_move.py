"""How long an actuator hears nothing while a guarded task moves, beside the same task unguarded.

Three agents on loopback: the task commands wheels a hundred times a second, and moves to and fro between two. Where
it is guarded, all three are its guardians.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from statistics import quantiles

from benchmarks.figure import Figure, Plan, in_turns
from torture.gap import NAMES, commands_heard, gaps_in, move_to_and_fro, pilot_on_left
from torture.live import LiveFleet

from pancakes.client import Client, Target
from pancakes.control import Describe, Guarding

TITLE = "the gap in control while a task moves: guarded, beside unguarded"
BESIDE = "unguarded"
MOVES = 40
STATE_BYTES = 1024
WATCHER = "watcher"
BEGUN_S = 30.0
"""So long it may take until the task runs and has its guardians."""


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures all figures."""
    figures = [Figure("gap of a move, p50", "ms", wanted=1.5), Figure("gap of a move, p90", "ms")]
    moves = max(10, plan.share(MOVES))
    yield from in_turns(plan, figures, partial(_run, moves, 3), partial(_run, moves, 1))


def _run(moves: int, guardians: int) -> list[float]:
    with tempfile.TemporaryDirectory(prefix="pancakes-gap-") as text:
        directory = Path(text)
        rest = pilot_on_left(directory, STATE_BYTES, f"guard = {{ copies = {guardians} }}\n" if guardians > 1 else "")
        fleet = LiveFleet(directory, (*NAMES, WATCHER), rest)
        try:
            for name in fleet.names:
                fleet.start(name, wait=True)
            with Client(Target(tuple(fleet.addresses.values()), "torture"), 10.0) as client:
                _wait(client, guardians)
                refused = [it.refused for it in move_to_and_fro(client, moves) if it.refused]
                if refused:
                    raise RuntimeError(f"a move came to nothing: {refused[0]}")
        finally:
            fleet.close()
        cuts = quantiles(gaps_in(commands_heard(directory)), n=10, method="inclusive")
        return [1e3 * cuts[4], 1e3 * cuts[8]]


def _wait(client: Client, guardians: int) -> None:
    until_s = time.monotonic() + BEGUN_S
    while True:
        described = client.request(NAMES[0], Describe()).result
        runs = any(task["task"] == "Pilot" and task["state"] == "running" for task in described["tasks"])
        rows = client.request(NAMES[0], Guarding()).result
        guarded = guardians == 1 or any(len(row.get("guardians", ())) == guardians for row in rows)
        if runs and guarded and len(described["neighbours"]) == 2:
            return
        if time.monotonic() > until_s:
            raise TimeoutError(f"the task did not begin, with its {guardians} guardians, within {BEGUN_S:g} s")
        time.sleep(0.05)
