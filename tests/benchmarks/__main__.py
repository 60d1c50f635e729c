"""`scripts/bench`: measures how fast Pancakes is, each figure beside one of something bare, taken in turns with it."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import platform
from pathlib import Path

from benchmarks.figure import Figure, Plan

TOPICS = ("fan_out", "two_processes", "lateness", "start_up", "observers")


def main() -> None:
    """Measures, prints a table, and writes the figures where that is asked for."""
    options = _options()
    plan = Plan(rounds=max(5, options.rounds), scale=0.1 if options.quick else 1.0)
    print(f"Python {platform.python_version()}, {os.cpu_count()} cores, medians of {plan.rounds} runs in turns\n")
    figures: list[Figure] = []
    for topic in options.only or TOPICS:
        module = importlib.import_module(f"benchmarks.{topic}")
        print(f"{module.TITLE}\n{'':46} {'Pancakes':>12} {'bare':>12}        ratio (of the runs)")
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
    parser.add_argument("--only", action="append", choices=TOPICS, metavar="NAME", help=f"one of {', '.join(TOPICS)}")
    return parser.parse_args()


def _line(figure: Figure) -> str:
    low, high = figure.spread
    wanted = ""
    if figure.wanted is not None:
        sign = "<=" if figure.sense == "max" else ">="
        wanted = f"  wanted {sign} {figure.wanted:g}" + (", MISSED" if figure.is_missed else "")
    numbers = f"{_short(figure.value):>12} {_short(figure.baseline):>12} {figure.unit:6}"
    return f"{figure.name:46} {numbers} {figure.ratio:6.2f} ({low:.2f} to {high:.2f}){wanted}"


def _short(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


if __name__ == "__main__":
    main()
