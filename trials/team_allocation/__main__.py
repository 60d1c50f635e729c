"""`scripts/allocation`: how good the allocation of a team's tasks is, how calm, and whether a death leaves a hole."""

from __future__ import annotations

import statistics
import sys
from pathlib import Path
from typing import Any, Final

import click
from harness.ending import interruptible
from harness.report import json_option, spread, write
from team_allocation.auctions import BETWEEN_S, auction, steady_moves
from team_allocation.fleet import LEASE_S, Trial

from pancakes.durable.optimum import has_solver

LEAST_SHARE: Final = 0.95
MOST_MOVES: Final = 2.0
LATE_S: Final = 1.5


@click.command()
@click.option("--seeds", type=click.IntRange(1), default=50, show_default=True, help="Number of rounds.")
@click.option("--robots", type=click.IntRange(3), default=10, show_default=True, help="Number of robots.")
@click.option("--tasks", type=click.IntRange(1), default=50, show_default=True, help="Number of tasks.")
@click.option("--loss", type=click.FloatRange(0, 0.9), default=0.2, show_default=True, help="Share of lost packets.")
@click.option("--steady", type=click.IntRange(0), default=5, show_default=True, help="Number of hours of rounds.")
@click.option("--fleets", type=click.IntRange(0), default=3, show_default=True, help="Number of fleets of agents.")
@click.option("--hours", type=click.FloatRange(0), default=0.1, show_default=True, help="Steady hours of a fleet.")
@click.option("--deaths", type=click.IntRange(0), default=1, show_default=True, help="Robots of a fleet that die.")
@click.option("--coupled", is_flag=True, help="Couple tasks: at once, in order, by a deadline. Judges no value.")
@json_option
def allocation(
    seeds: int,
    robots: int,
    tasks: int,
    loss: float,
    steady: int,
    fleets: int,
    hours: float,
    deaths: int,
    coupled: bool,
    json_file: Path | None,
) -> None:
    """Allocate tasks to robots while packets are lost, and judge the result.

    First the rounds without agents, beside the best allocation; then hours of such rounds, with costs that differ a
    little each minute; then fleets of agents in virtual time, whose robots die. The exit code is 0 only if the median
    round has 95 % of the optimum's value, no task moves more than twice an hour, and no task is without an owner for
    longer than its lease and 1.5 s.
    """
    if not has_solver():
        raise click.UsageError("Nothing to compare with: install the extra, pip install 'pancakes-agents[allocation]'.")
    with interruptible():
        figures, failures = judged_rounds(seeds, robots, tasks, loss, coupled)
        for part, failed in (
            judged_hours(steady, robots, tasks, loss),
            judged_fleets(fleets, robots, tasks, loss, hours, deaths),
        ):
            figures.update(part)
            failures += failed
    for failure in failures:
        _say(f"FAILED {failure}")
    write(json_file, {**figures, "failures": failures})
    sys.exit(1 if failures else 0)


def judged_rounds(seeds: int, robots: int, tasks: int, loss: float, coupled: bool) -> tuple[dict[str, Any], list[str]]:
    """Holds rounds without agents; returns their figures and what failed."""
    rounds = [auction(seed, robots, tasks, loss, coupled) for seed in range(seeds)]
    failures = [f"round {it.seed}: {fault}" for it in rounds for fault in it.faults]
    shares = [it.share for it in rounds if it.share is not None]
    unknown, split = len(rounds) - len(shares), sum(not it.agreed for it in rounds)
    found = {"share": spread(shares), "round_s": spread([it.round_s for it in rounds])}
    _say(f"{seeds} rounds of {tasks} tasks on {robots} robots, {loss:.0%} of the packets lost:")
    if shares:
        median = statistics.median(shares)
        _say(f"  share of the optimum: median {median:.1%}, least {min(shares):.1%}; of {unknown} it is not known")
        if not coupled and median < LEAST_SHARE:
            failures.append(f"the median round has {median:.1%} of the optimum's value")
    _say(f"  duration: median {found['round_s']['median']:.2f} s, most {found['round_s']['most']:.2f} s")
    _say(f"  rounds that ended before all knew that all agree: {split}")
    return {**found, "without_optimum": unknown, "not_agreed": split}, failures


def judged_hours(hours: int, robots: int, tasks: int, loss: float) -> tuple[dict[str, Any], list[str]]:
    """Holds rounds for hours, without agents; returns the figures and what failed."""
    most = 0
    for seed in range(hours):
        moves = steady_moves(seed, robots, tasks, loss, int(3600.0 / BETWEEN_S))
        highest = max(moves.values(), default=0)
        most = max(most, highest)
        _say(f"an hour of rounds, seed {seed}: {sum(moves.values())} moves, most of a task {highest}")
    failures = [f"a task moved {most} times in an hour"] if most > MOST_MOVES else []
    return {"most_moves_per_hour": most}, failures


def judged_fleets(
    fleets: int, robots: int, tasks: int, loss: float, hours: float, deaths: int
) -> tuple[dict[str, Any], list[str]]:
    """Runs fleets of agents whose robots die; returns the figures and what failed."""
    figures: list[dict[str, Any]] = []
    failures: list[str] = []
    for seed in range(fleets):
        with Trial(seed, robots, tasks, loss) as trial:
            told = trial.run(hours, deaths)
        figures.append({"moves": told.moves, "without_owner_s": told.without_owner_s, "gaps": told.gaps})
        longest_s = max(told.without_owner_s, default=0.0)
        gaps = f"; rounds are at most {max(told.gaps):.1%} below the optimum" if told.gaps else ""
        _say(
            f"fleet {seed}: {told.moves} moves in {hours:g} h of steady state; after a death no owner for"
            f" {longest_s:.1f} s at most, then {told.moved_after} moves{gaps}"
        )
        if told.most_moves > MOST_MOVES * max(hours, 1.0):
            failures.append(f"fleet {seed}: a task moved {told.most_moves} times in {hours:g} h")
        if longest_s > LEASE_S + LATE_S:
            failures.append(f"fleet {seed}: a task had no owner for {longest_s:.1f} s, its lease is {LEASE_S:g} s")
        failures += [f"fleet {seed}: {task} does not run exactly once" for task in told.lost]
    return {"fleets": figures, "fleet_hours": hours}, failures


def _say(text: str) -> None:
    click.echo(text)
    sys.stdout.flush()


if __name__ == "__main__":
    allocation()
