"""Tries hard to make missions fail, and prints figures. Run by `scripts/torture`."""

from __future__ import annotations

import os
import sys
import time
from collections import Counter

import click
from torture.cuts import FATES, STEPS, run_cuts
from torture.gap import measure
from torture.kills import Tally, run_fleets
from torture.missions import FIGURES, figures_of, fly_all
from torture.schedules import run_schedule, run_schedules

from pancakes.plugins import Plugins, UnknownPlugin


@click.group()
def torture() -> None:
    """Try hard to make it fail."""


@torture.command()
@click.option("--demo", default="encirclement", show_default=True, help="Which mission.")
@click.option("--seeds", default=200, show_default=True, type=click.IntRange(1), help="How many missions.")
@click.option("--first", default=1, show_default=True, type=click.IntRange(0), help="The first seed.")
@click.option(
    "--jobs", default=os.cpu_count() or 1, show_default=True, type=click.IntRange(1), help="How many at once."
)
@click.option("--faults/--no-faults", default=True, show_default=True, help="Latency, jitter and broken links.")
@click.option(
    "--batteries", is_flag=True, help="Draw agent 1's battery too: the hand-over falls anywhere on the circle."
)
def missions(demo: str, seeds: int, first: int, jobs: int, faults: bool, batteries: bool) -> None:
    """Whole missions in virtual time, a seed each; exit code 0 only where all of them PASS."""
    try:
        Plugins().get("pancakes.demos", demo)
    except UnknownPlugin as error:
        raise click.BadParameter(str(error), param_hint="--demo") from None
    failed: list[int] = []
    figures: dict[str, list[float]] = {}
    began_s = time.monotonic()
    for outcome in fly_all(demo, range(first, first + seeds), faults, batteries, jobs):
        for key, value in figures_of(outcome).items():
            figures.setdefault(key, []).append(value)
        summary = outcome.summary
        if summary["verdict"] != "PASS":
            failed.append(outcome.job.seed)
            print(f"seed {outcome.job.seed}: {summary['verdict']}: {'; '.join(summary['reasons'])}", flush=True)
    for name, unit, key in FIGURES:
        if found := sorted(figures.get(key, ())):
            middle = found[len(found) // 2]
            print(f"{name}: {found[0]:.3f} to {found[-1]:.3f} {unit}, median {middle:.3f} {unit}")
    print(f"{seeds} missions of {demo}, in {time.monotonic() - began_s:.0f} s")
    print(f"{seeds - len(failed)} passed, {len(failed)} failed")
    sys.exit(1 if failed else 0)


@torture.command()
@click.option("--seeds", default=10_000, show_default=True, type=click.IntRange(1), help="How many schedules.")
@click.option("--first", default=1, show_default=True, type=click.IntRange(0), help="The first seed.")
@click.option(
    "--jobs", default=os.cpu_count() or 1, show_default=True, type=click.IntRange(1), help="How many at once."
)
@click.option("--trace", is_flag=True, help="Print all that happens, a line each; for one seed.")
def schedules(seeds: int, first: int, jobs: int, trace: bool) -> None:
    """Fault schedules of whole virtual agents whose tasks move: each task runs once at most, and once in the end.

    A seed that fails does the same again with --first SEED --seeds 1 --trace. Exit code 0 only where none fails.
    """
    began_s = time.monotonic()
    failed = 0
    counts: Counter[str] = Counter()
    healed_s: list[float] = []
    todo = range(first, first + seeds)
    outcomes = (run_schedule(seed, print) for seed in todo) if trace else run_schedules(todo, jobs)
    for outcome in outcomes:
        counts += outcome.counts
        healed_s.append(outcome.healed_s)
        if outcome.violation:
            failed += 1
            print(f"seed {outcome.seed}: VIOLATION: {outcome.violation}", flush=True)
        if len(healed_s) % 1000 == 0:
            print(f"{len(healed_s)} schedules, {failed} violations, {time.monotonic() - began_s:.0f} s", flush=True)
    healed_s.sort()
    for name, key in COUNTED:
        print(f"{name}: {counts[key]}")
    print(f"healed within: {healed_s[-1]:.2f} s, median {healed_s[len(healed_s) // 2]:.2f} s (virtual time)")
    print(f"{seeds} schedules from seed {first}, in {time.monotonic() - began_s:.0f} s")
    print(f"{failed} violations")
    sys.exit(1 if failed else 0)


COUNTED = (
    ("agents killed", "kill"),
    ("links broken", "break"),
    ("partitions", "partition"),
    ("moves asked for", "migrate"),
    ("hand-overs ended", "moved"),
    ("other commands", "command"),
    ("hand-over packets", "packet"),
    ("of these lost", "lost"),
    ("of these doubled", "doubled"),
    ("of these late and out of order", "late"),
    ("copies started", "start"),
)
"""What is counted in fault schedules: how it is called, and its key in `Outcome.counts`."""


@torture.command()
@click.option("--kills", "count", default=1000, show_default=True, type=click.IntRange(1), help="How many kills.")
@click.option("--first", default=1, show_default=True, type=click.IntRange(0), help="The first fleet's seed.")
@click.option("--fleets", default=4, show_default=True, type=click.IntRange(1), help="How many fleets at once.")
def kills(count: int, first: int, fleets: int) -> None:
    """Real agents killed (SIGKILL) while their tasks move; whoever runs a task holds a file lock.

    Exit code 0 only where no task ever ran twice, and none was lost.
    """
    began_s = time.monotonic()

    def told(tally: Tally) -> None:
        print(f"{tally.kills} kills, {len(tally.lost)} lost, {time.monotonic() - began_s:.0f} s", flush=True)

    tally = run_fleets(count, first, min(fleets, count), told)
    for sentence in (*tally.doubled, *tally.lost, *tally.backwards):
        print(sentence)
    print(f"agents killed: {tally.kills}")
    print(f"hand-overs, by the epochs that the tasks ran under: {tally.moves}")
    print(f"hand-overs answered with success: {tally.asked}")
    print(
        f"ticks counted: {tally.ticks}, at most {tally.worst_step_back} of a task forgotten in one crash (50 a second)"
    )
    print(f"all ran again within: {max(tally.heals_s):.1f} s")
    print(f"in {time.monotonic() - began_s:.0f} s")
    print(f"{len(tally.doubled)} doubled, {len(tally.lost)} lost, {len(tally.backwards)} under a passed epoch")
    sys.exit(1 if tally.doubled or tally.lost or tally.backwards else 0)


@torture.command()
@click.option("--jobs", default=4, show_default=True, type=click.IntRange(1), help="How many at once.")
def cuts(jobs: int) -> None:
    """The link between two real agents cut at each step of a hand-over, and what became of the task.

    The cut is made by a TCP proxy. Exit code 0 only where each ended as docs/protocol.md says.
    """
    failed = 0
    began_s = time.monotonic()
    print(f"{'cut at':<10} {'then':<18} {'meanwhile ran':<14} {'ran in the end':<15} {'after':>6}")
    for case in run_cuts([(step, fate) for step in STEPS for fate in FATES], jobs):
        failed += bool(case.faults)
        row = f"{case.step:<10} {case.fate:<18} {case.meanwhile:<14} {case.finally_:<15} {case.settled_s:>4.1f} s"
        print(f"{row}  {'; '.join(case.faults) or 'as it must'}", flush=True)
    print(f"{len(STEPS) * len(FATES)} cuts, in {time.monotonic() - began_s:.0f} s; {failed} ended as they must not")
    print("Not run: the same between network namespaces.")
    sys.exit(1 if failed else 0)


WANTED_S = 0.05
"""The longest gap of 99 in 100 moves on loopback, with 64 KiB of state."""


@torture.command()
@click.option("--moves", default=100, show_default=True, type=click.IntRange(1), help="How many moves of each kind.")
def gap(moves: int) -> None:
    """For how long an actuator hears nothing while the task that commands it at 100 Hz moves between real agents.

    Exit code 1 where 99 in 100 moves with 64 KiB of state take longer than 50 ms on loopback, or a move is refused.
    """
    failed = False
    for where, size, delay_s, loss in GAPS:
        found = measure(size, moves, delay_s, loss)
        for reason in found.refused:
            print(f"refused: {reason}")
        if not found.gaps_s:
            print(f"{where}, {size} bytes: nothing was heard")
            failed = True
            continue
        p50_s, p99_s = found.percentile_s(50), found.percentile_s(99)
        late = not delay_s and size == 65_536 and p99_s > WANTED_S
        failed = failed or late or bool(found.refused)
        print(
            f"{where}, {size / 1024:g} KiB of state: p50 {p50_s * 1000:.1f} ms, p99 {p99_s * 1000:.1f} ms,"
            f" {len(found.gaps_s)} moves" + (f": longer than {WANTED_S * 1000:g} ms" if late else ""),
            flush=True,
        )
    print("The gap holds one period of the task, 10 ms. A lost frame is sent again after 80 ms by the proxy, in order.")
    print("Not run: 20 ms and 5 % loss in network namespaces, where TCP itself finds out what was lost.")
    sys.exit(1 if failed else 0)


GAPS = (
    ("loopback", 1024, 0.0, 0.0),
    ("loopback", 65_536, 0.0, 0.0),
    ("loopback", 4 * 1024 * 1024, 0.0, 0.0),
    ("20 ms each way, 5 % lost", 65_536, 0.02, 0.05),
)
"""What is measured: how it is called, the size of the state in bytes, the delay in seconds and the share lost."""


if __name__ == "__main__":
    torture()
