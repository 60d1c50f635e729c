"""`scripts/soak`: run a fleet for long, and judge whether anything leaks, or a task is lost or doubled."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import click
import msgspec
from harness.ending import interruptible
from harness.report import json_option, write
from soak import steady, virtual
from soak.agents import names_of
from soak.churn import Churn
from soak.churn import Outcome as ChurnOutcome
from soak.judgement import GROWTH_MIB, LONG_S, MORE_PIECES, SLOPE_MIB_PER_H, shown

LONGEST_WARM_UP_S: Final = 600.0


@click.command()
@click.option(
    "--minutes",
    type=click.FloatRange(min=0.25),
    help="Duration of the run.  [default: 60; 10 with --steady or --virtual]",
)
@click.option(
    "--agents",
    type=click.IntRange(2, 250),
    help="Number of agents.  [default: 4; 50 with --steady, 200 with --virtual]",
)
@click.option("--seed", type=int, help="Seed of the actions; their timing is not reproducible.  [default: 1]")
@click.option("--steady", "is_steady", is_flag=True, help="Leave the agents alone, and check that no link ends.")
@click.option("--virtual", "is_virtual", is_flag=True, help="Run in virtual time; each task migrates once.")
@click.option("--leak", "leak_bytes", type=click.IntRange(0), help="Make each agent leak N bytes every two seconds.")
@json_option
def soak(
    minutes: float | None,
    agents: int | None,
    seed: int | None,
    is_steady: bool,
    is_virtual: bool,
    leak_bytes: int | None,
    json_file: Path | None,
) -> None:
    """Run a fleet for long while tasks start, stop and migrate, and agents are killed and come back.

    All agents are processes of this machine. The first half of them is never killed: their memory must not grow. At
    the end, no agent may have more threads, sockets or files than after the warm-up, and each task must run once.
    The exit code is 0 only if all of this holds. With --leak the run must fail: this shows that it finds a leak.
    """
    if is_steady and is_virtual:
        raise click.UsageError("--steady and --virtual are different runs: choose one of them.")
    if leak_bytes is not None and (is_steady or is_virtual):
        raise click.UsageError("--leak does not work with --steady or --virtual: these runs do not look for leaks.")
    if is_steady and seed is not None:
        raise click.UsageError("--seed does not work with --steady: that run has no random actions.")
    if not is_steady and seed is None:
        seed = 1
    duration_s = 60 * (minutes if minutes is not None else 10.0 if is_steady or is_virtual else 60.0)
    began_s = time.monotonic()
    with interruptible(), tempfile.TemporaryDirectory(prefix="pancakes-soak-") as name:
        if seed is None:
            found, faults = steady_figures(Path(name), agents or 50, duration_s)
        elif is_virtual:
            found, faults = virtual_figures(agents or 200, duration_s, seed)
        else:
            found, faults = _churn(Path(name), agents or 4, duration_s, seed, leak_bytes or 0)
    for fault in faults:
        print(f"FAULT: {fault}")
    print(f"in {time.monotonic() - began_s:.0f} s: {'FAIL' if faults else 'PASS'}")
    write(json_file, {**found, "seed": seed, "faults": faults, "passed": not faults})
    sys.exit(1 if faults else 0)


def _say(text: str) -> None:
    print(text, flush=True)


def steady_figures(directory: Path, agents: int, duration_s: float) -> tuple[dict[str, Any], list[str]]:
    outcome = steady.run(directory, agents, duration_s, _say)
    print(
        f"an agent uses {outcome.processor_ms:.1f} ms of processor time per second ({os.cpu_count()} cores),"
        f" {outcome.memory_kib / 1024:.1f} MiB, and sends {outcome.sent_bytes / 1000:.1f} kB/s"
    )
    return vars(outcome), outcome.faults


def virtual_figures(agents: int, duration_s: float, seed: int) -> tuple[dict[str, Any], list[str]]:
    outcome = virtual.run(agents, duration_s, seed, _say)
    print(f"{agents} agents, {duration_s:.0f} s of virtual time: {outcome.moved} migrations, {outcome.links} link ends")
    return vars(outcome), outcome.faults


def _churn(
    directory: Path, agents: int, duration_s: float, seed: int, leak_bytes: int
) -> tuple[dict[str, Any], list[str]]:
    warm_up_s = min(LONGEST_WARM_UP_S, duration_s / 4)
    outcome = Churn(directory, seed, names_of(agents), _say, leak_bytes).run(duration_s, warm_up_s)
    for what, count in sorted(outcome.counts.items()):
        print(f"{count:>6} {what}")
    for name, found in outcome.trends.items():
        limit = f"{SLOPE_MIB_PER_H:g} MiB/h" if found.span_s >= LONG_S else f"{GROWTH_MIB:g} MiB in all"
        print(
            f"{name}: memory {found.per_hour:+.2f} MiB/h, {found.growth:+.2f} MiB in the {found.span_s / 60:.0f} min"
            f" after the warm-up of {warm_up_s / 60:.0f} min (limit: {limit})"
        )
    for name, (before, *_, after) in ((name, calm) for name, calm in outcome.calm.items() if len(calm) > 1):
        was, now = before.vitals, after.vitals
        if name in outcome.trends:
            more = after.pieces - before.pieces
            print(f"{name}: {before.pieces} pieces of memory at rest, later {more:+d} (limit: {MORE_PIECES:+d})")
        print(
            f"{name}: threads {was.threads}, later {now.threads}; sockets {was.sockets}, later {now.sockets}; other"
            f" open files {was.files - before.workers}, later {now.files - after.workers}"
        )
    if outcome.trends and not outcome.faults:
        print(shown(min(found.span_s for found in outcome.trends.values())))
    return _plain(outcome), outcome.faults


def _plain(outcome: ChurnOutcome) -> dict[str, Any]:
    plain: Callable[[Any], Any] = msgspec.to_builtins
    return {
        "counts": dict(outcome.counts),
        "memory_mib": {name: plain(found) for name, found in outcome.trends.items()},
        "calm": plain(outcome.calm),
        "samples": plain(outcome.samples),
    }


if __name__ == "__main__":
    soak(prog_name="scripts/soak")
