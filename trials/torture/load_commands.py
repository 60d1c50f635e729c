"""The command of `scripts/torture` that loads agents: their other work must not suffer."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any, Final

import click
from harness.report import json_option, write
from torture.overload import LATE_S, MEMORY_BYTES, TIMES, Case, overload, p99
from torture.slow_peers import CLOSED_S, HOW, WANTED_RATIO, slow_peer

CASES: Final = (
    Case("inside", 64, 2000),
    Case("inside", 64, 2000, "reliable"),
    Case("inside", 64 * 1024, 500),
    Case("inside", 1024 * 1024, 100),
    Case("over TCP", 64, 2000),
    Case("over TCP", 64, 2000, "reliable"),
    Case("over TCP", 64 * 1024, 200),
    Case("over TCP, on system", 64, 2000),
    Case("over TCP, on system", 64 * 1024, 200),
)
"""The cases. A body of 1 MiB does not fit into a frame: `publish` refuses it over TCP."""


@click.command()
@click.option(
    "--seconds", default=5.0, show_default=True, type=click.FloatRange(1), help="How long each overload lasts."
)
@click.option("--rounds", default=5, show_default=True, type=click.IntRange(1), help="How often a peer is slow.")
@click.option(
    "--only",
    type=click.Choice(["overload", "peers"]),
    help="Test only a fast publisher, or only a slow peer.",
)
@json_option
def load(seconds: float, rounds: int, only: str | None, json_file: Path | None) -> None:
    """Test a publisher that is ten times too fast, and a slow or stopped peer: what is the effect on everything else?

    The exit code is 1 if an agent uses more than 64 MiB above its baseline, the p99 of replies or ticks is above 50 ms,
    a packet is lost without being counted, arrives out of order or twice, or the readers do not catch up by themselves;
    or if the others' p99 is more than 1.2 times its baseline while a peer is slow, or the slow peer is not closed.
    """
    rows = _overloads(seconds) if only != "peers" else []
    rows += slow_peer_rows(rounds, seconds) if only != "overload" else []
    failed = sum(bool(row["faults"]) for row in rows)
    write(json_file, {"load": rows, "failed": failed})
    sys.exit(1 if failed else 0)


def _overloads(seconds: float) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    wanted = f"{MEMORY_BYTES >> 20} MiB, {LATE_S * 1e3:g} ms"
    print(f"a publisher {TIMES} times too fast, for {seconds:g} s; wanted: {wanted}")
    columns = ("reply p50", "p99", "worst", "tick p50", "p99", "worst", "caught up")
    print(f"{'':34} {'memory':>10}" + "".join(f" {column:>9}" for column in columns))
    for case in CASES:
        with tempfile.TemporaryDirectory(prefix="pancakes-load-") as name:
            seen = overload(Path(name), case, seconds)
        rows.append({"case": case.name, **seen._asdict(), "faults": seen.faults()})
        times = (*_spread_ms(seen.control_s), *_spread_ms(seen.late_s), f"{seen.behind_s:.2f} s")
        print(f"{case.name:34} {seen.memory_bytes / 2**20:6.1f} MiB" + "".join(f" {time:>9}" for time in times))
        lost = ", ".join(f"{count} {where}" for where, count in seen.dropped.items()) or "none"
        print(f"    {seen.published} published, {seen.handled} handled; dropped: {lost}; refused: {seen.refused}")
        print(f"    {'; '.join(seen.faults()) or 'as it must'}", flush=True)
    return rows


def slow_peer_rows(rounds: int, seconds: float) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    print(f"a slow peer, {rounds} times; wanted: the others' p99 within {WANTED_RATIO:g} of its baseline")
    for how in HOW:
        with tempfile.TemporaryDirectory(prefix="pancakes-load-") as name:
            slow = slow_peer(Path(name), how, rounds, seconds)
        low, high = slow.spread
        faults = [f"p99 is {slow.ratio:.2f} times its baseline"] * (slow.ratio > WANTED_RATIO)
        faults += [f"closed after {max(slow.closed_s):.1f} s"] * (max(slow.closed_s) > CLOSED_S)
        rows.append({"peer": how, **slow._asdict(), "ratio": slow.ratio, "faults": faults})
        print(
            f"{how:10} others' p99 {slow.ratio:.2f} ({low:.2f} to {high:.2f}) of its baseline; closed after"
            f" {min(slow.closed_s):.1f} to {max(slow.closed_s):.1f} s; back within {max(slow.joined_s):.2f} s"
        )
        print(f"    {'; '.join(faults) or 'as it must'}", flush=True)
    return rows


def _spread_ms(times_s: list[float]) -> tuple[str, str, str]:
    """Return the median, the 99th percentile and the maximum of some times, for people."""
    middle_s, most_s = sorted(times_s)[len(times_s) // 2], max(times_s)
    return f"{middle_s * 1e3:.1f} ms", f"{p99(times_s) * 1e3:.1f} ms", f"{most_s * 1e3:.1f} ms"
