"""How long an actuator hears nothing while a guarded task moves, beside the same task unguarded.

Three agents on loopback: the task commands wheels a hundred times a second, and moves to and fro between two, with
1 KiB of state and with 4 MiB. If it is guarded, all three are its guardians.
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
LARGE_MOVES = 12
STATE_BYTES = 1024
LARGE_BYTES = 4 * 1024 * 1024
WATCHER = "watcher"
BEGUN_S = 30.0
"""So long it may take until the task runs and has its guardians."""


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures all figures."""
    for moves, state_bytes, name in ((MOVES, STATE_BYTES, ""), (LARGE_MOVES, LARGE_BYTES, " with 4 MiB")):
        figures = [
            Figure(f"gap of a move{name}, p50", "ms", wanted=1.5),
            Figure(f"gap of a move{name}, p90", "ms"),
        ]
        count = max(10, plan.share(moves))
        sides = (partial(_run, count, state_bytes, guardians) for guardians in (3, 1))
        yield from in_turns(plan, figures, *sides)


def _run(moves: int, state_bytes: int, guardians: int) -> list[float]:
    with tempfile.TemporaryDirectory(prefix="pancakes-gap-") as text:
        directory = Path(text)
        rest = pilot_on_left(directory, state_bytes, f"guard = {{ copies = {guardians} }}\n" if guardians > 1 else "")
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
        guarded = any(len(row.get("guardians", ())) == guardians and not row["changing"] for row in rows)
        if runs and (guarded or guardians == 1) and len(described["neighbours"]) == 2:
            return
        if time.monotonic() > until_s:
            raise TimeoutError(f"the task did not begin, with its {guardians} guardians, within {BEGUN_S:g} s")
        time.sleep(0.05)
