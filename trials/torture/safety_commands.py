"""The commands `scripts/torture collisions` and `scripts/torture halts`."""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Final

import click
from harness.report import json_option, spread, write
from torture.collisions import Mission, fly_all, has_rps
from torture.halts import NAMES, halt_often
from torture.live_commands import namespaces

MOST_S: Final = 1e-3
"""A pass of the barrier may take this much processor time, in the mean of a mission."""
STANDS_WITHIN_S: Final = 0.5
LOSS: Final = 0.2
DELAY_S: Final = 0.005


@click.command()
@click.option(
    "--missions", "count", default=1000, show_default=True, type=click.IntRange(1), help="Number of missions."
)
@click.option("--first", default=1, show_default=True, type=click.IntRange(0), help="The first seed.")
@click.option("--length", "length_s", default=20.0, show_default=True, help="Seconds of each mission.")
@click.option(
    "--jobs", default=os.cpu_count() or 1, show_default=True, type=click.IntRange(1), help="How many at once."
)
@click.option(
    "--judge",
    type=click.Choice(["rps", "own"]),
    help="What moves the robots and counts.  [default: rps if it is installed]",
)
@json_option
def collisions(count: int, first: int, length_s: float, jobs: int, judge: str | None, json_file: Path | None) -> None:
    """Command robots to collide, with a barrier below their tasks and without.

    The exit code is 0 only if no robot touched another or left the floor with the barrier, most missions without it had
    collisions, and a pass of the barrier took at most 1 ms of processor time in the mean.
    """
    by_rps = has_rps() if judge is None else judge == "rps"
    if by_rps and not has_rps():
        raise click.ClickException("rps is not installed: pip install robotarium-python-simulator")
    began_s = time.monotonic()
    rows: dict[str, dict[str, object]] = {}
    failed = False
    print(f"{count} missions of {length_s:g} s, judged by {'rps' if by_rps else 'the floor of this program'}")
    for filtered in (True, False):
        missions = [Mission(seed, filtered, length_s, by_rps) for seed in range(first, first + count)]
        hit: Counter[str] = Counter()
        flown: Counter[str] = Counter()
        counted = outside = 0
        means, longest, closest, driven, held = [], [], [], [], []
        for outcome in fly_all(missions, jobs):
            kind = outcome.mission.kind
            flown[kind] += 1
            counted, outside = counted + outcome.collisions, outside + outcome.outside
            if outcome.collisions or outcome.outside:
                hit[kind] += 1
                if filtered:
                    where = f"{outcome.collisions} collisions, {outcome.outside} steps outside"
                    print(f"seed {outcome.mission.seed}, {kind}: {where}, {outcome.closest_m:.3f} m", flush=True)
            means.append(outcome.filter_s)
            longest.append(outcome.longest_s)
            closest.append(outcome.closest_m)
            driven.append(outcome.driven_m)
            held.append(outcome.held)
        name = "with the barrier" if filtered else "without it"
        print(f"{name}: {counted} collisions, {outside} steps outside, in {sum(hit.values())} of {count} missions")
        for kind in flown:
            print(f"  {kind}: {hit[kind]} of {flown[kind]} missions")
        print(f"  closest {min(closest):.3f} m; driven {sum(driven) / count:.2f} m by a robot in the mean")
        rows[name] = {
            "collisions": counted,
            "outside": outside,
            "missions_hit": dict(hit),
            "missions": dict(flown),
            "closest_m": spread(closest),
            "driven_m": spread(driven),
            "held": spread(held),
        }
        if filtered:
            print(f"  a pass takes {1e3 * sum(means) / count:.3f} ms in the mean, {1e3 * max(longest):.2f} ms at most")
            rows[name] |= {"filter_s": spread(means), "longest_s": spread(longest)}
            failed = failed or bool(hit) or max(means) > MOST_S
        else:
            failed = failed or 2 * sum(hit.values()) < count
    wall_s = time.monotonic() - began_s
    print(f"in {wall_s:.0f} s")
    write(json_file, {"missions": count, "by_rps": by_rps, **rows, "failed": failed, "wall_s": wall_s})
    sys.exit(1 if failed else 0)


@click.command()
@click.option("--rounds", default=100, show_default=True, type=click.IntRange(1), help="How often they are halted.")
@click.option(
    "--loss", default=LOSS, show_default=True, type=click.FloatRange(0.0, 0.9), help="The share that is lost."
)
@json_option
def halts(rounds: int, loss: float, json_file: Path | None) -> None:
    """Halt four real agents whose links lose packets, by asking all of them and only one, in turns.

    It needs network namespaces (root, iproute2). The exit code is 0 only if all actuators stood within 0.5 s of each
    request, and none moved before the halt was ended.
    """
    with namespaces(True, "") as (spaces, _):
        assert spaces is not None
        began_s = time.monotonic()
        found = halt_often(spaces, rounds, loss, DELAY_S)
    times = sorted(max(it.stood_s) for it in found)
    late = [it for it in found if max(it.stood_s) > STANDS_WITHIN_S]
    moved = [it for it in found if it.moved_after]
    for it in moved:
        print(f"asked {', '.join(it.to)}: moved afterwards, or not before: {', '.join(it.moved_after)}")
    for title, all_asked in (("all agents asked", True), ("one agent asked", False)):
        last = sorted(max(it.stood_s) for it in found if (len(it.to) > 1) == all_asked)
        if last:
            print(
                f"{title}: the last actuator stood after {1e3 * last[len(last) // 2]:.0f} ms (p50),"
                f" {1e3 * last[-1]:.0f} ms at most, of {len(last)} halts"
            )
    print(
        f"{len(found)} halts of {len(NAMES)} agents, {loss:.0%} of packets lost, {DELAY_S * 1e3:g} ms each way:"
        f" {len(late)} later than {STANDS_WITHIN_S:g} s, {len(moved)} moved; {time.monotonic() - began_s:.0f} s"
    )
    write(json_file, {"halts": len(found), "late": len(late), "moved": len(moved), "stood_s": spread(times)})
    sys.exit(1 if late or moved else 0)
