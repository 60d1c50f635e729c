"""The command of `scripts/torture` that looks for standstills: states in which work waits and nobody takes it."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click
from harness.report import json_option, write
from torture.standstill import GAP_S

ROUND_S = 15.0
PATIENCE_S = 60.0


@click.command()
@click.option("--seconds", default=300.0, show_default=True, type=click.FloatRange(1), help="Duration, in all.")
@click.option("--first", default=1, show_default=True, type=click.IntRange(0), help="The first seed.")
@click.option("--dumps", default="standstill.txt", show_default=True, help="File for the stacks of a standstill.")
@json_option
def standstill(seconds: float, first: int, dumps: str, json_file: Path | None) -> None:
    """Run agents with all kinds of tasks and peers that come, go and stop, on one, two and four cores under load.

    The exit code is 1 if the pool, the timer, the network's loop or a ticker left work waiting for 0.15 s although the
    process had the processor. On a busy machine, the scheduler may cause such a gap: the dump shows whether the thread
    was waiting or runnable.
    """
    rows: list[dict[str, Any]] = []
    until_s = time.monotonic() + seconds
    seed = first
    while time.monotonic() < until_s:
        row = run_round(seed, dumps)
        rows.append(row)
        print(json.dumps(row), flush=True)
        seed += 1
    gaps = sum(sum(row["gaps"].values()) for row in rows)
    looks, late = (sum(row[key] for row in rows) for key in ("looks", "late"))
    print(f"{len(rows)} rounds, {gaps} gaps above {GAP_S:g} s; the bare thread was late {late} times of {looks}")
    write(json_file, {"rounds": rows, "gaps": gaps})
    sys.exit(1 if gaps else 0)


def run_round(seed: int, dumps: str) -> dict[str, Any]:
    """Run one agent, its peers and the load for a while."""
    draws = random.Random(seed)
    here = sorted(os.sched_getaffinity(0))
    cores = draws.sample(here, min(len(here), draws.choice((1, 2, 4))))
    port = _free_port()
    told = {
        "name": "a",
        "seed": seed,
        "listen": f"tcp://127.0.0.1:{port}",
        "peers": [],
        "file": os.path.abspath(dumps),
        "tickers": draws.choice((4, 10, 40)),
        "waiting": draws.choice((0, 1, 1, 4)),
        "computing": draws.choice((0, 0, 1, 2)),
        "changing": draws.choice((0, 1)),
        "record": draws.random() < 0.5,
    }
    load = draws.choice((0, 0, 1, 2))
    peers = draws.choice((0, 1, 2))
    with ExitStack() as stack:
        # They are killed, so they leave their files behind.
        told["directory"] = stack.enter_context(tempfile.TemporaryDirectory(prefix="pancakes-standstill-"))
        for _ in range(load):
            burner = subprocess.Popen([sys.executable, "-c", "while True: pass"], process_group=0)
            stack.callback(_end, burner)
        watched = _agent(stack, told, cores)
        visitors = [_agent(stack, _visitor(told, number, draws), here) for number in range(peers)]
        until_s = time.monotonic() + ROUND_S
        while (left_s := until_s - time.monotonic()) > 0:
            time.sleep(min(left_s, draws.uniform(0.2, 3.0)))
            if not visitors:
                continue
            number = draws.randrange(peers)
            if draws.random() < 0.5:
                visitors[number].send_signal(signal.SIGSTOP)
                time.sleep(draws.uniform(0.1, 2.5))
                visitors[number].send_signal(signal.SIGCONT)
            else:
                _end(visitors[number])
                visitors[number] = _agent(stack, _visitor(told, number, draws), here)
        output, _ = watched.communicate(timeout=PATIENCE_S)
    about = {key: told[key] for key in ("seed", "tickers", "waiting", "computing", "changing", "record")}
    return {**about, "cores": len(cores), "load": load, "visitors": peers, **json.loads(output.splitlines()[-1])}


def _visitor(told: dict[str, Any], number: int, draws: random.Random) -> dict[str, Any]:
    quiet = {"waiting": 0, "computing": 0, "changing": 0, "record": False, "tickers": 4, "file": os.devnull}
    return {
        **told, **quiet, "name": f"v{number}", "seed": draws.random(), "listen": "", "peers": [told["listen"]],
    }  # fmt: skip


def _agent(stack: ExitStack, told: dict[str, Any], cores: list[int]) -> subprocess.Popen[str]:
    started = subprocess.Popen(
        [sys.executable, "-m", "torture.standstill", json.dumps(told)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": told["directory"]},
        process_group=0,  # Ctrl-C reaches only this process, which ends them
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
    )
    stack.callback(_end, started)
    assert started.stdout is not None
    if started.stdout.readline() != "ready\n":
        raise RuntimeError(f"the agent {told['name']} did not start")
    return started


def _end(process: subprocess.Popen[Any]) -> None:
    if process.poll() is None:
        process.kill()
    process.wait()
    for file in (process.stdin, process.stdout):
        if file is not None:
            file.close()


def _free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])
