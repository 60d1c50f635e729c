"""`scripts/soak`: a fleet that runs for long, and the verdict whether anything of it leaks, is lost or is doubled."""

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
@click.option("--minutes", type=click.FloatRange(min=0.25), help="How long.  [default: 60, else 10]")
@click.option(
    "--agents", type=click.IntRange(2, 250), help="How many.  [default: 4; 50 with --steady, 200 with --virtual]"
)
@click.option("--seed", type=int, help="Draws what is done; the machine draws the rest.  [default: 1]")
@click.option("--steady", "is_steady", is_flag=True, help="Nothing is done to the agents: does any link end?")
@click.option("--virtual", "is_virtual", is_flag=True, help="In virtual time, where each task moves once.")
@click.option("--leak", "leak_bytes", type=click.IntRange(0), help="Each agent loses so many bytes every two seconds.")
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
    """Let a fleet run for long while tasks are started, stopped and moved, and agents are killed and come back.

    All agents are processes of this machine. The first half of them is never killed: their memory must not grow, and
    in the end no agent may have more threads, sockets or files than after the warm-up, and each task must run once.
    Exit code 0 only where all of that is so. With --leak it has to fail: that shows what it would find.
    """
    if is_steady and is_virtual:
        raise click.UsageError("--steady and --virtual are two runs: one of them at a time.")
    if leak_bytes is not None and (is_steady or is_virtual):
        raise click.UsageError("--leak is neither for --steady nor for --virtual: no leak is looked for there.")
    if is_steady and seed is not None:
        raise click.UsageError("--seed is not for --steady: nothing is drawn there.")
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
        f"an agent takes {outcome.processor_ms:.1f} ms of processor time a second ({os.cpu_count()} cores are here),"
        f" {outcome.memory_kib / 1024:.1f} MiB, and sends {outcome.sent_bytes / 1000:.1f} kB/s"
    )
    return vars(outcome), outcome.faults


def virtual_figures(agents: int, duration_s: float, seed: int) -> tuple[dict[str, Any], list[str]]:
    outcome = virtual.run(agents, duration_s, seed, _say)
    print(f"{agents} agents, {duration_s:.0f} s of virtual time: {outcome.moved} moves, {outcome.links} ends of links")
    return vars(outcome), outcome.faults


def _churn(
    directory: Path, agents: int, duration_s: float, seed: int, leak_bytes: int
) -> tuple[dict[str, Any], list[str]]:
    warm_up_s = min(LONGEST_WARM_UP_S, duration_s / 4)
    outcome = Churn(directory, seed, names_of(agents), _say, leak_bytes).run(duration_s, warm_up_s)
    for what, count in sorted(outcome.counts.items()):
        print(f"{count:>6} {what}")
    for name, found in outcome.trends.items():
        rule = f"{SLOPE_MIB_PER_H:g} MiB/h may be" if found.span_s >= LONG_S else f"{GROWTH_MIB:g} MiB in all may be"
        print(
            f"{name}: memory {found.per_hour:+.2f} MiB/h, {found.growth:+.2f} MiB in the {found.span_s / 60:.0f} min"
            f" after the warm-up of {warm_up_s / 60:.0f} min ({rule})"
        )
    for name, (before, *_, after) in ((name, calm) for name, calm in outcome.calm.items() if len(calm) > 1):
        was, now = before.vitals, after.vitals
        if name in outcome.trends:
            more = after.pieces - before.pieces
            print(f"{name}: at rest {before.pieces} pieces of memory, and then {more:+d} ({MORE_PIECES:+d} may be)")
        print(
            f"{name}: threads {was.threads} and then {now.threads}, sockets {was.sockets} and {now.sockets}, other open"
            f" files {was.files - before.workers} and {now.files - after.workers}"
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
