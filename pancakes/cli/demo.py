"""`pancakes demo NAME`: runs a whole mission, shows it, and judges it."""

from __future__ import annotations

import os
import signal
import sys
import threading
from pathlib import Path
from typing import Any

import click

from pancakes.cli.errors import sentences
from pancakes.plugins import Plugins, UnknownPlugin

PASSED, FAILED, INTERRUPTED = 0, 1, 130


class DemoNames(click.ParamType):
    """The demos that are installed; completed in a shell, suggested in an error."""

    name = "demo"

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Any]:
        from click.shell_completion import CompletionItem

        return [CompletionItem(name) for name in Plugins().names("pancakes.demos") if name.startswith(incomplete)]


@click.command()
@click.argument("name", type=DemoNames(), required=False)
@click.option("--list", "list_", is_flag=True, help="Show the demos that are installed.")
@click.option("--virtual", is_flag=True, help="Run in virtual time, in one process: same seed, same bytes.")
@click.option(
    "--seed", default=1, show_default=True, type=click.IntRange(0), help="Draws noise, the mover's way, the start."
)
@click.option(
    "--speed",
    default=5.0,
    show_default=True,
    type=click.FloatRange(0.01, 1000.0),
    help="Mission seconds a second (live).",
)
@click.option("--duration", type=click.FloatRange(1.0), help="Mission seconds; the demo's own length if left out.")
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder for the results. [default: runs/NAME-SEED-MODE]",
)
@click.option(
    "--configs",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Folder with the agents' configurations. [default: configs/NAME]",
)
@click.option(
    "--set",
    "sets",
    multiple=True,
    metavar="[AGENT:]KEY=VALUE",
    help="Change a key of one agent's configuration, or of all.",
)
@click.option("--headless", is_flag=True, help="Plain lines instead of the live view.")
@click.option("--faults", is_flag=True, help="Latency, jitter and broken links between the agents (with --virtual).")
@sentences
def demo(
    name: str | None,
    list_: bool,
    virtual: bool,
    seed: int,
    speed: float,
    duration: float | None,
    out: Path | None,
    configs: Path | None,
    sets: tuple[str, ...],
    headless: bool,
    faults: bool,
) -> None:
    """Run a demo and judge it: exit code 0 only where the verdict is PASS.

    \b
    Example:
        pancakes demo encirclement
        pancakes demo encirclement --virtual --seed 7 --out runs/seven
    """
    plugins = Plugins()
    if list_ or name is None:
        _list(plugins)
        return
    if faults and not virtual:
        raise click.UsageError("--faults needs --virtual: a live network has faults of its own")
    sys.exit(_run(plugins, name, virtual, seed, speed, duration, out, configs, sets, headless, faults))


def _list(plugins: Plugins) -> None:
    for name in plugins.names("pancakes.demos"):
        click.echo(f"{name:16} {plugins.get('pancakes.demos', name).title}")


def _run(
    plugins: Plugins,
    name: str,
    virtual: bool,
    seed: int,
    speed: float,
    duration: float | None,
    out: Path | None,
    configs: Path | None,
    sets: tuple[str, ...],
    headless: bool,
    faults: bool,
) -> int:
    from pancakes.demo import Demo
    from pancakes.demo.conductor import Mission
    from pancakes.demo.launcher import Faults, fresh, judge, run_live, run_of, run_virtual
    from pancakes.demo.plan import find_configs, make_plan
    from pancakes.demo.view import LiveView, PlainView

    try:
        found: Demo = plugins.get("pancakes.demos", name)
    except UnknownPlugin as error:
        raise click.BadParameter(str(error), param_hint="NAME") from None
    out = (out or Path("runs") / f"{name}-{seed}-{'virtual' if virtual else 'live'}").absolute()
    duration_s = duration if duration is not None else found.duration_s
    plan = make_plan(
        found,
        find_configs(name, configs),
        out,
        seed,
        1.0 if virtual else speed,
        duration_s,
        sets,
        not virtual,
        plugins,
    )
    fresh(out)
    mission = Mission(plan.demo.agents, duration_s)
    interrupted = threading.Event()
    _on_signal(interrupted)
    plain = headless or virtual or not sys.stdout.isatty()
    click.echo(f"{found.title}: seed {seed}, {duration_s:g} s, results in {_nice(out)}")
    with PlainView(found, mission) if plain else LiveView(found, mission):
        if virtual:
            timing = run_virtual(plan, mission, interrupted, Faults(seed) if faults else None)
        else:
            timing = run_live(plan, mission, interrupted)
    if mission.phase == "interrupted":
        click.echo(f"interrupted after {mission.now_s:.1f} s: no verdict", err=True)
        return INTERRUPTED
    run = run_of(plan, mission)
    summary = judge(plan, run, timing)
    found.draw(run, summary)
    return _verdict(summary, timing, out)


def _on_signal(interrupted: threading.Event) -> None:
    """Lets SIGINT, SIGTERM and SIGHUP stop the mission in good order; the second one ends the launcher at once.

    Its agents end with it in either case.
    """

    def stop(number: int, frame: Any) -> None:
        if interrupted.is_set():
            os._exit(INTERRUPTED)
        interrupted.set()

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGHUP, stop)


def _nice(path: Path) -> str:
    relative = os.path.relpath(path)
    return relative if not relative.startswith("..") else str(path)


def _verdict(summary: dict[str, Any], timing: dict[str, Any], out: Path) -> int:
    """Says how it went, in the manner of Robotarium."""
    passed = summary["verdict"] == "PASS"
    if timing["mode"] == "virtual":
        click.echo(f"took {timing['wall_s']:.2f} s, {timing['times_real_time']:.0f} times real time")
    elif timing["behind_max_s"] > 0.25:
        click.echo(f"fell behind the clock by up to {timing['behind_max_s']:.2f} s of mission time")
    else:
        click.echo("did not fall behind the clock")
    for line in summary.get("said", ()):
        click.echo(line)
    click.echo(f"verdict: {summary['verdict']}")
    for reason in summary["reasons"]:
        click.echo(f"  - {reason}")
    click.echo(f"summary.json, events.jsonl, trajectory.csv and paths.png are in {_nice(out)}")
    return PASSED if passed else FAILED
