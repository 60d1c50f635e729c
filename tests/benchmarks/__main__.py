"""`scripts/bench`: measures how fast Pancakes is, each figure beside one of something bare, taken in turns with it."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
import signal
import sys
from pathlib import Path

from benchmarks.figure import Figure, Missing, Plan

TOPICS = (
    "fan_out",
    "two_processes",
    "lateness",
    "many_tasks",
    "start_up",
    "observers",
    "virtual_mission",
    "big_world",
    "fleet",
)
PEER_TOPICS = ("peer_pairs", "peer_crowds")
"""What needs environments of its own, and is therefore asked for."""
GROWTH_TOPICS = ("task_growth",)
"""What takes minutes, and is wanted by nobody who only wants to know whether all is well; asked for by name."""
MOST_ROUNDS = 9
"""So often each side is measured where the rounds differ much."""


def main() -> None:
    """Measures, prints a table, and writes the figures where that is asked for."""
    options = _options()
    # Asked to end, it ends what it has started as well.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    rounds = max(5, options.rounds)
    plan = Plan(rounds, 0.1 if options.quick else 1.0, rounds if options.quick else max(MOST_ROUNDS, rounds))
    print(
        f"Python {platform.python_version()}, {os.cpu_count()} cores, medians of {rounds} runs in turns,"
        f" of {plan.most_rounds} where they differ much\n"
    )
    figures: list[Figure | Missing] = []
    for topic in options.only or (TOPICS + PEER_TOPICS if options.peers else TOPICS):
        module = importlib.import_module(f"benchmarks.{topic}")
        beside = getattr(module, "BESIDE", "bare")
        print(f"{module.TITLE}\n{'':46} {'Pancakes':>12} {beside:>12}        ratio (of the runs)")
        for figure in module.measure(plan):
            figures.append(figure)
            print(_line(figure), flush=True)
        print()
    if options.json:
        options.json.write_text(
            json.dumps([figure.record() for figure in figures], indent=1, ensure_ascii=False) + "\n"
        )


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="scripts/bench", description=__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE as well")
    parser.add_argument("--quick", action="store_true", help="a tenth of the work in each run: quick, and noisy")
    parser.add_argument("--rounds", type=int, default=5, help="runs of each side, 5 or more (5)")
    parser.add_argument("--peers", action="store_true", help="measure beside pyzmq, zenoh and rospy as well")
    topics = TOPICS + PEER_TOPICS + GROWTH_TOPICS
    parser.add_argument("--only", action="append", choices=topics, metavar="NAME", help=f"one of {', '.join(topics)}")
    return parser.parse_args()


def _line(figure: Figure | Missing) -> str:
    if isinstance(figure, Missing):
        return f"{figure.name} is MISSING: {figure.reason}"
    low, high = figure.spread
    wanted = ""
    if figure.wanted is not None:
        sign = "<=" if figure.sense == "max" else ">="
        unit = f" {figure.unit}" if figure.absolute else ""
        wanted = f"  wanted {sign} {figure.wanted:g}{unit}" + (", MISSED" if figure.is_missed else "")
    value = f"{figure.name:46} {_short(figure.value):>12}"
    if figure.baseline is None or figure.ratio is None:
        return f"{value} {'':12} {figure.unit:6} {'':6} ({_short(low)} to {_short(high)}){wanted}"
    return (
        f"{value} {_short(figure.baseline):>12} {figure.unit:6} {figure.ratio:6.2f} ({low:.2f} to {high:.2f}){wanted}"
    )


def _short(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


if __name__ == "__main__":
    main()
