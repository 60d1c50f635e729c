"""`pancakes demo NAME --seeds`: many missions in virtual time, and what came of them all."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from pancakes.tools.cli import agent_process
from pancakes.tools.cli.output import Printer, show_text
from pancakes.tools.cli.parent_death import die_with_parent

if TYPE_CHECKING:
    from pancakes.tools.demo import Comparison, Demo
    from pancakes.tools.demo.monte_carlo import MissionOutcome, MissionWishes
    from pancakes.util.plugins import Plugins

MOST_NAMED: Final = 10
"""So many missions that did not pass are named with their reasons; the others are in `missions.json`."""


class Seeds(click.ParamType):
    """A range of seeds such as `1-200`, or several: `3,17,20-29`."""

    name = "range"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        from pancakes.tools.demo.seed_statistics import seeds_of

        if isinstance(value, tuple):
            return value
        try:
            return seeds_of(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)


def run_seeds(
    found: Demo | Comparison,
    seeds: Sequence[int],
    out: Path,
    wishes: MissionWishes,
    jobs: int | None,
    plain: bool,
    printer: Printer,
    plugins: Plugins,
    interrupted: Callable[[], bool],
) -> tuple[bool, int]:
    """Run a demo under many seeds, and show what came of it.

    Args:
        found: the demo.
        seeds: the seeds.
        out: the folder for the results.
        wishes: what else is asked for.
        jobs: so many processes at once; None: one for each core that this process may use.
        plain: a line for each mission, and no bar.
        printer: prints the answer.
        plugins: where drivers and tasks come from.
        interrupted: whether it was.

    Returns:
        Whether all missions were run; and how many did not pass.

    Raises:
        PancakesError: the demo cannot be run at all, or its results cannot be written.
    """
    from pancakes.tools.demo.demo import Comparison
    from pancakes.tools.demo.launcher import fresh
    from pancakes.tools.demo.monte_carlo import PASSED, fly_many, plan_of

    # What is wrong with all of them is said once, before anything is written.
    plan_of(found.mission if isinstance(found, Comparison) else found, out, seeds[0], wishes, plugins)
    fresh(out, ("missions.json",))
    count = min(jobs or len(os.sched_getaffinity(0)), len(seeds))
    text = f"{found.title}: {len(seeds)} {_missions(len(seeds))}, {count} at once, results in {nice_path(out)}"
    printer.note(text)
    outcomes: list[MissionOutcome] = []
    failed = 0
    with _progress(len(seeds), plain) as tell:
        flown = fly_many(seeds, out, wishes, count, interrupted, partial(_prepare, os.getpid()))
        for outcome in flown:
            outcomes.append(outcome)
            failed += outcome.verdict != PASSED
            tell(outcome, failed)
    outcomes.sort(key=lambda outcome: outcome.seed)
    _show(outcomes, out, wishes, printer)
    if len(outcomes) < len(seeds):
        show_text(f"interrupted: {len(outcomes)} of {len(seeds)} missions were run", err=True)
    return len(outcomes) == len(seeds), failed


def _prepare(parent_pid: int) -> None:
    """Make a process fit for agents, and let it end with this one, however this one ends."""
    agent_process.tune_interpreter()
    die_with_parent(parent_pid)


def _missions(count: int) -> str:
    return "mission" if count == 1 else "missions"


def _progress(total: int, plain: bool) -> AbstractContextManager[Callable[[MissionOutcome, int], None]]:
    """Return what takes each outcome, and how many failed so far, while missions run."""
    if plain:
        return nullcontext(_tell_line)
    if not sys.stderr.isatty():
        return nullcontext(lambda outcome, failed: None)
    return _Bar(total)


def _tell_line(outcome: MissionOutcome, failed: int) -> None:
    why = f": {outcome.reasons[0]}" if outcome.reasons else ""
    show_text(f"seed {outcome.seed}: {outcome.verdict}{why}", err=True)


class _Bar(AbstractContextManager[Callable[..., None]]):
    """A bar on a terminal: how many missions are over, how many of them failed, and how long the others will take."""

    def __init__(self, total: int) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"), TimeRemainingColumn())
        self._progress = Progress(*columns, console=Console(stderr=True), transient=True)
        self._task = self._progress.add_task("none failed", total=total)

    def __enter__(self) -> Callable[[MissionOutcome, int], None]:
        self._progress.start()
        return self._tell

    def _tell(self, outcome: MissionOutcome, failed: int) -> None:
        self._progress.update(self._task, advance=1, description=f"{failed or 'none'} failed")

    def __exit__(self, *error: object) -> None:
        self._progress.stop()


def _show(outcomes: Sequence[MissionOutcome], out: Path, wishes: MissionWishes, printer: Printer) -> None:
    """Show what came of all missions, and write it to `missions.json`."""
    import json

    from pancakes.tools.demo.monte_carlo import PASSED
    from pancakes.tools.demo.seed_statistics import spreads_of, text_of_seeds

    verdicts: dict[str, list[int]] = {}
    for outcome in outcomes:
        verdicts.setdefault(outcome.verdict, []).append(outcome.seed)
    rows = [
        {"verdict": verdict, "missions": len(seeds), "seeds": text_of_seeds(seeds)}
        for verdict, seeds in sorted(verdicts.items(), key=lambda item: (item[0] != PASSED, item[0]))
    ]
    spreads = spreads_of(outcome.summary for outcome in outcomes)
    fallen = [outcome for outcome in outcomes if outcome.verdict != PASSED]
    said = [f"seed {outcome.seed}: {text}" for outcome in outcomes for text in outcome.said]
    whole = {
        "demo": wishes.demo,
        "missions": len(outcomes),
        "verdicts": rows,
        "spreads": [asdict(spread) for spread in spreads],
        "failed": [
            {
                "seed": outcome.seed,
                "verdict": outcome.verdict,
                "reasons": list(outcome.reasons),
                "out": str(outcome.out),
                "again": again(outcome.seed, wishes),
            }
            for outcome in fallen
        ],
        "said": said,
    }
    try:
        (out / "missions.json").write_text(json.dumps(whole, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        show_text(f"{out / 'missions.json'} cannot be written: {error.strerror}", err=True)
    for text in said:
        show_text(text, err=True)
    apart = [asdict(spread) for spread in spreads if spread.differs]
    lines = []
    for outcome in fallen[:MOST_NAMED]:
        lines.append(f"seed {outcome.seed}: {outcome.verdict}")
        lines += [f"  - {reason}" for reason in outcome.reasons]
        lines.append(f"  run again: {again(outcome.seed, wishes)}")
    if len(fallen) > MOST_NAMED:
        lines.append(f"{len(fallen) - MOST_NAMED} more did not pass: {nice_path(out / 'missions.json')} has them all")
    printer.emit(whole, {"Verdicts": rows, "Spreads": apart}, *lines)


def nice_path(path: Path) -> str:
    """Return a path as a person writes it from here."""
    relative = os.path.relpath(path)
    return relative if not relative.startswith("..") else str(path)


def again(seed: int, wishes: MissionWishes) -> str:
    """Return the command that runs one of the missions again, alone."""
    words = ["pancakes", "demo", wishes.demo, "--virtual", "--seed", str(seed)]
    if wishes.duration_s is not None:
        words += ["--duration", f"{wishes.duration_s:g}"]
    if wishes.configs is not None:
        words += ["--configs", str(wishes.configs)]
    for one in wishes.sets:
        words += ["--set", one]
    words += ["--faults"] * wishes.faults + ["--record"] * wishes.record
    return shlex.join(words)
