"""The commands of `scripts/torture` that run real agents: kills, cuts, gap."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, Final

import click
from harness.report import json_option, spread, write
from torture.cuts import FATES, STEPS, Cutter
from torture.gap import Gaps, measure
from torture.grounds import Survey, by_proxy, in_namespaces, on_loopback
from torture.kills import plan, run_fleets
from torture.namespaces import Namespaces, NoNamespaces, check
from torture.points import NAMES as POINT_NAMES
from torture.roads import ROADS
from torture.tally import Tally


@contextmanager
def namespaces(wanted: bool | None, what: str) -> Iterator[tuple[Namespaces | None, list[str]]]:
    """Yield network namespaces if they are wanted and this machine can make them; otherwise print what is not run.

    They are removed at the end, also after an error.

    Args:
        wanted: True: required. None: use them if possible. False: do not use them.
        what: what is not run without them.
    """
    spaces: Namespaces | None = None
    not_run: list[str] = []
    if wanted is not False:
        try:
            check()
            spaces = Namespaces()
        except NoNamespaces as error:
            if wanted:
                raise click.ClickException(f"{error}.") from None
            not_run.append(f"{what}: {error}")
            print(f"Not run: {not_run[0]}.")
    with spaces or nullcontext():
        yield spaces, not_run


netns_option = click.option(
    "--netns/--no-netns",
    "netns",
    default=None,
    help="Only, or never, in network namespaces.  [default: both, if possible (root, iproute2)]",
)


@click.command()
@click.option("--kills", "count", default=1000, show_default=True, type=click.IntRange(1), help="Number of kills.")
@click.option(
    "--at",
    type=click.Choice(["random", "effects", "both"]),
    default="both",
    show_default=True,
    help="Kill at random moments, at the named points between the effects of the protocol, or half at each.",
)
@click.option("--first", default=1, show_default=True, type=click.IntRange(0), help="The first fleet's seed.")
@click.option("--fleets", default=4, show_default=True, type=click.IntRange(1), help="Number of parallel fleets.")
@click.option(
    "--over",
    type=click.Choice(list(ROADS)),
    default="tcp",
    show_default=True,
    help="Transport of the agents. With zenoh, two routers also fail at random, and one fleet runs at a time.",
)
@json_option
def kills(count: int, at: str, first: int, fleets: int, over: str, json_file: Path | None) -> None:
    """Kill real agents (SIGKILL) during migrations; an agent that runs a task holds a file lock.

    The exit code is 0 only if no task ever ran twice or was lost, each packet to a task had its effect exactly once,
    and each point between effects was reached.
    """
    began_s = time.monotonic()

    def told(tally: Tally) -> None:
        print(
            f"{tally.kills + tally.roads.total()} faults, {len(tally.lost)} lost, {time.monotonic() - began_s:.0f} s",
            flush=True,
        )

    if over == "zenoh":  # packets through routers cannot be read; a process has only one set of routers
        at, fleets = "random", 1
    random_kills, points = plan(count, at)
    tally = run_fleets(random_kills, points, first, min(fleets, count), told, ROADS[over])
    faults = (*tally.doubled, *tally.lost, *tally.backwards, *tally.missed)
    for sentence in faults:
        print(sentence)
    for name in POINT_NAMES if points else ():
        print(f"{tally.points[name]:>5} killed: {name}")
    for name, times in sorted(tally.roads.items()):
        print(f"{times:>5} times: {name}")
    between = tally.points.total()
    print(f"agents killed: {tally.kills}, {between} of them between effects, at {len(tally.points)} points")
    print(f"migrations, by the epochs of the tasks: {tally.moves}")
    print(f"migrations answered with success: {tally.asked}")
    print(
        f"ticks counted: {tally.ticks}, at most {tally.worst_step_back} of a task forgotten in one crash (50 a second);"
        f" a trap kept an agent from its disk for {tally.longest_no_disk_s:.1f} s at most"
    )
    print(f"packets to tasks counted: {tally.packets}")
    print(f"all ran again within: {max(tally.heals_s):.1f} s")
    print(f"in {time.monotonic() - began_s:.0f} s")
    print(f"{len(tally.doubled)} doubled, {len(tally.lost)} lost, {len(tally.backwards)} under a passed epoch")
    figures: dict[str, Any] = {**vars(tally), "between_effects": between, "wall_s": time.monotonic() - began_s}
    write(json_file, figures | {"heals_s": spread(tally.heals_s)})
    sys.exit(1 if faults else 0)


@click.command()
@click.option("--jobs", default=4, show_default=True, type=click.IntRange(1), help="Number of parallel cuts.")
@netns_option
@json_option
def cuts(jobs: int, netns: bool | None, json_file: Path | None) -> None:
    """Cut the link between two real agents at each step of a migration, and check which agent runs the task.

    The cut is made by a TCP proxy, which resets the connection, and by a wire between network namespaces, which is
    silent from then on. The exit code is 0 only if each cut ended as docs/protocol.md says.
    """
    failed = 0
    began_s = time.monotonic()
    rows: list[dict[str, Any]] = []
    cases = [(step, fate) for step in STEPS for fate in FATES]
    with namespaces(netns, "the same between network namespaces") as (spaces, not_run):
        ways: dict[str, Survey] = {} if netns else {"TCP proxy": by_proxy}
        if spaces is not None:
            ways["network namespaces"] = in_namespaces(spaces)
        for way, survey in ways.items():
            print(f"{way}:")
            print(f"{'cut at':<10} {'then':<18} {'meanwhile ran':<14} {'ran at the end':<15} {'after':>6}")
            for case in Cutter(survey).run(cases, jobs):
                failed += bool(case.faults)
                rows.append({"by": way, **case._asdict()})
                row = (
                    f"{case.step:<10} {case.fate:<18} {case.meanwhile:<14} {case.finally_:<15} {case.settled_s:>4.1f} s"
                )
                print(f"{row}  {'; '.join(case.faults) or 'as it must'}", flush=True)
    print(f"{len(rows)} cuts, in {time.monotonic() - began_s:.0f} s; {failed} failed")
    write(json_file, {"cuts": rows, "failed": failed, "not_run": not_run, "wall_s": time.monotonic() - began_s})
    sys.exit(1 if failed else 0)


WANTED_S: Final = 0.05
"""The longest allowed gap of 99 in 100 migrations on loopback, with 64 KiB of state."""
SIZES: Final = (1024, 64 * 1024, 4 * 1024 * 1024)
"""The sizes of the task's state, in bytes."""
DELAY_S: Final = 0.02
LOSS: Final = 0.05


@click.command()
@click.option("--moves", default=100, show_default=True, type=click.IntRange(1), help="Migrations of each kind.")
@netns_option
@json_option
def gap(moves: int, netns: bool | None, json_file: Path | None) -> None:
    """Measure how long an actuator gets no command while its task (100 Hz) migrates between real agents.

    On loopback, and between network namespaces in which IP packets take 20 ms and 5 % of them are lost. The exit code
    is 1 if the p99 with 64 KiB of state is longer than 50 ms on loopback, or if a migration there is refused.
    """
    rows: list[dict[str, Any]] = []
    failed = False
    with namespaces(netns, "20 ms each way and 5 % lost, between network namespaces") as (spaces, not_run):
        for size in () if netns else SIZES:
            found = measure(size, moves, on_loopback)
            late = size == SIZES[1] and bool(found.gaps_s) and found.percentile_s(99) > WANTED_S
            failed = failed or late or bool(found.refused) or not found.gaps_s
            rows.append(_row_of("loopback", found, f": longer than {WANTED_S * 1000:g} ms" if late else ""))
        for size in SIZES if spaces is not None else ():
            assert spaces is not None
            found = measure(size, moves, in_namespaces(spaces, DELAY_S, LOSS))
            failed = failed or not found.gaps_s
            rows.append(_row_of("20 ms each way, 5 % lost", found))
    print("The gap holds one period of the task, 10 ms.")
    write(json_file, {"gaps": rows, "failed": failed, "not_run": not_run})
    sys.exit(1 if failed else 0)


def _row_of(where: str, found: Gaps, fault: str = "") -> dict[str, Any]:
    """Print the figures, and return them for a file."""
    row: dict[str, Any] = {"where": where, "state_bytes": found.state_bytes, "moves": len(found.gaps_s)}
    row["gaps_s"] = list(found.gaps_s)
    head = f"{where}, {found.state_bytes / 1024:g} KiB of state"
    if found.gaps_s:
        row |= {"p50_s": found.percentile_s(50), "p99_s": found.percentile_s(99), "longest_s": found.gaps_s[-1]}
        print(
            f"{head}: p50 {row['p50_s'] * 1000:.1f} ms, p99 {row['p99_s'] * 1000:.1f} ms,"
            f" {row['moves']} migrations{fault}",
            flush=True,
        )
    else:
        print(f"{head}: no migration succeeded", flush=True)
    if found.refused:
        row |= {"refused": found.refused, "longest_pause_s": max(found.pauses_s, default=0.0)}
        print(f"{head}: {len(found.refused)} migrations failed, such as: {found.refused[0]}")
        print(f"{head}: the longest pause of the task in these was {row['longest_pause_s'] * 1000:.0f} ms", flush=True)
    return row
