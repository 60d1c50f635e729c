"""`scripts/bench`: measures how fast Pancakes is, each figure beside one of something bare, taken in turns with it."""

from __future__ import annotations

import importlib
import json
import os
import platform
import signal
import sys
from pathlib import Path
from traceback import format_exception_only
from typing import Any

import click
from benchmarks import short
from benchmarks.compare import slower
from benchmarks.environments import PeerMissing
from benchmarks.figure import Failed, Figure, Missing, Plan
from benchmarks.profiles import profile, summary
from harness.ending import interruptible
from harness.report import json_option, write

TOPICS = (
    "cpu",
    "fan_out",
    "two_processes",
    "local_link",
    "tls_link",
    "routed_link",
    "lateness",
    "many_tasks",
    "many_topics",
    "start_up",
    "observers",
    "virtual_mission",
    "big_world",
    "fleet",
    "guarded",
    "guarded_move",
)
PEER_TOPICS = ("peer_pairs", "peer_ros2", "peer_crowds")
"""What needs environments of its own, and is therefore asked for."""
GROWTH_TOPICS = ("task_growth", "virtual_fleet", "routed_fleet")
"""What takes minutes, and is wanted by nobody who only wants to know whether all is well; asked for by name."""
ALL_TOPICS = TOPICS + PEER_TOPICS + GROWTH_TOPICS
LEAST_ROUNDS, MOST_ROUNDS = 5, 9
"""So often each side is measured, and where the rounds differ much."""


@click.command()
@json_option
@click.option("--quick", is_flag=True, help="A tenth of the work in each run: quick, and noisy.")
@click.option(
    "--rounds", default=LEAST_ROUNDS, show_default=True, type=click.IntRange(LEAST_ROUNDS), help="Runs of each side."
)
@click.option(
    "--peers",
    is_flag=True,
    help="Measure beside pyzmq, zenoh, rospy, rclpy and mango as well, with --only beside what it names.",
)
@click.option(
    "--only",
    multiple=True,
    type=click.Choice(ALL_TOPICS),
    metavar="NAME",
    help=f"One of {', '.join(ALL_TOPICS)}; may be given several times.",
)
@click.option(
    "--compare",
    "old_file",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="OLD.json",
    help="Print what became slower since the run that wrote this file with --json, by more than the noise.",
)
@click.option(
    "--profile",
    "profiled",
    type=click.Choice(ALL_TOPICS),
    metavar="TOPIC",
    help="Measure nothing, but write a profile of a topic, in all its processes (see docs/performance.md).",
)
@click.option("--ci", is_flag=True, help="Measure only CPU, in a minute; compare it with trials/benchmarks/cpu.json.")
@click.option("--write", "writes", is_flag=True, help="With --ci: write that file instead of comparing with it.")
def bench(
    json_file: Path | None,
    quick: bool,
    rounds: int,
    peers: bool,
    only: tuple[str, ...],
    old_file: Path | None,
    profiled: str | None,
    ci: bool,
    writes: bool,
) -> None:
    """Measure how fast Pancakes is, each figure beside one of something bare, taken in turns with it.

    Exit code 1 if a topic could not be measured to its end (the others are), if --compare finds something slower, or if
    --ci finds a step half again as slow as its file says. 130 after Ctrl-C: what was measured until then is in the file
    of --json.
    """
    if writes and not ci:
        raise click.UsageError("--write needs --ci.")
    if ci and (only or peers or old_file):
        raise click.UsageError("--ci measures its own steps, and takes no --only, --peers or --compare.")
    if profiled is not None:
        if only or peers or old_file or ci or json_file:
            raise click.UsageError("--profile measures nothing: it takes only --quick and --rounds.")
        _profile(profiled, quick, rounds)
    old = [] if old_file is None else _records_of(old_file)
    if ci:
        _short_form(json_file, writes)
    topics = tuple(dict.fromkeys((only or TOPICS) + PEER_TOPICS * peers))
    plan = Plan(rounds, 0.1 if quick else 1.0, rounds if quick else max(MOST_ROUNDS, rounds))
    more = f", of {plan.most_rounds} where they differ much" if plan.most_rounds > rounds else ""
    print(f"Python {platform.python_version()}, {os.cpu_count()} cores, medians of {rounds} runs in turns{more}\n")
    records: list[dict[str, Any]] = []
    try:
        with interruptible():
            failed = [topic for topic in topics if not _measure(topic, plan, records)]
    except KeyboardInterrupt:
        print("interrupted")
        sys.exit(128 + signal.SIGINT)
    finally:
        write(json_file, records)
    if old_file is not None:
        worse = slower(old, records)
        print(f"slower than in {old_file}:" if worse else f"nothing is slower than in {old_file}")
        print("".join(f"  {line}\n" for line in worse), end="")
        failed += worse
    sys.exit(1 if failed else 0)


def _records_of(file: Path) -> list[dict[str, Any]]:
    try:
        records = json.loads(file.read_text())
        if isinstance(records, list) and all(isinstance(record, dict) and "name" in record for record in records):
            return records
    except ValueError:
        pass
    raise click.BadParameter(f"{file} is not what --json writes.", param_hint="--compare")


def _profile(topic: str, quick: bool, rounds: int) -> None:
    """Writes a profile of a topic, says what is in it and where it is, and ends."""
    options = ["--only", topic, "--rounds", str(rounds), *["--quick"] * quick]
    try:
        file = profile(topic, ["-m", "benchmarks", *options])
    except (PeerMissing, RuntimeError) as error:
        sys.exit(f"no profile: {error}")
    print("".join(f"{line}\n" for line in summary(file.read_text().splitlines())))
    print(f"{file}: drop it on https://www.speedscope.app, which keeps it in the browser, or read it: a line a stack")
    sys.exit(0)


def _short_form(json_file: Path | None, writes: bool) -> None:
    """Measures the steps of the short form, compares them with the file or writes it, and ends."""
    ratios = {} if writes else short.known()
    print(f"Python {platform.python_version()}, {os.cpu_count()} cores, the smallest of {short.ROUNDS} runs or more\n")
    print(f"{'CPU of':46} {'Pancakes':>12} {'bare':>12}        ratio (of the runs)", flush=True)
    figures = []
    try:
        with interruptible():
            for step in short.steps():
                limit = None if writes else short.LIMIT * ratios.get(step.name, float("inf"))
                figures.append(short.measured(step, limit))
                print(_line(figures[-1]), flush=True)
    except KeyboardInterrupt:
        print("interrupted")
        sys.exit(128 + signal.SIGINT)
    finally:
        write(json_file, [figure.record() for figure in figures])
    if writes:
        short.write(figures)
    unknown = [figure.name for figure in figures if not writes and figure.name not in ratios]
    if unknown:
        print(f"not in {short.FILE.name}: {', '.join(unknown)} (scripts/bench --ci --write)")
    sys.exit(1 if unknown or any(figure.is_missed for figure in figures) else 0)


def _measure(topic: str, plan: Plan, records: list[dict[str, Any]]) -> bool:
    """Measures and prints a topic, and adds what it has found to the records; returns whether it came to its end."""
    found: Figure | Missing | Failed
    try:
        module = importlib.import_module(f"benchmarks.{topic}")
        beside = getattr(module, "BESIDE", "bare")
        print(f"{module.TITLE}\n{'':46} {'Pancakes':>12} {beside:>12}        ratio (of the runs)", flush=True)
        for found in module.measure(plan):
            records.append({"topic": topic, **found.record()})
            print(_line(found), flush=True)
    except Exception as error:  # whatever it is, the other topics have nothing to do with it
        found = Failed(topic, format_exception_only(error)[-1].strip())
        records.append({"topic": topic, **found.record()})
        print(f"{_line(found)}\n", flush=True)
        return False
    print()
    return True


def _line(figure: Figure | Missing | Failed) -> str:
    if isinstance(figure, Missing):
        return f"{figure.name} is MISSING: {figure.reason}"
    if isinstance(figure, Failed):
        return f"{figure.name} failed: {figure.reason}"
    low, high = figure.spread
    wanted = ""
    if figure.wanted is not None:
        sign = "<=" if figure.sense == "max" else ">="
        unit = f" {figure.unit}" if figure.absolute else ""
        wanted = f"  wanted {sign} {figure.wanted:g}{unit}" + (", MISSED" if figure.is_missed else "")
    value = f"{figure.name:46} {_short(figure.value):>12}"
    if figure.baseline is None or figure.ratio is None:
        runs = f"{_short(low)} to {_short(high)}" if len(figure.runs) > 1 else "one run"
        return f"{value} {'':12} {figure.unit:6} {'':6} ({runs}){wanted}"
    return (
        f"{value} {_short(figure.baseline):>12} {figure.unit:6} {figure.ratio:6.2f} ({low:.2f} to {high:.2f}){wanted}"
    )


def _short(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


if __name__ == "__main__":
    bench(prog_name="scripts/bench")
