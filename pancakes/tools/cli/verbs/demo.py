"""`pancakes demo NAME`: run a whole mission, show it in the terminal or on a page (`--view`), and judge it."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from click.core import ParameterSource

from pancakes.errors import PancakesError
from pancakes.tools.cli import agent_process
from pancakes.tools.cli.options import Duration, FiniteRange, agent_sets_option, format_option
from pancakes.tools.cli.output import Printer, show_text
from pancakes.tools.cli.streaming import end_by_signals, event_at
from pancakes.tools.cli.verbs.demo_seeds import Seeds, nice_path, run_seeds
from pancakes.tools.cli.verbs.view import port_option
from pancakes.util.plugins import Plugins, UnknownPluginError

if TYPE_CHECKING:
    from pancakes.tools.demo import Comparison, Demo, Run
    from pancakes.tools.demo.conductor import Mission
    from pancakes.tools.demo.launcher import DemoPlan
    from pancakes.tools.web.feed import Feed
    from pancakes.tools.web.page import Shown
    from pancakes.tools.web.page_server import PageServer
    from pancakes.tools.web.virtual_watch import VirtualWatch
    from pancakes.tools.web.watch import Watch


class DemoPage:
    """One page for all missions of a demo, which run one after the other.

    Args:
        control: whether the page may control agents.
        port: its port, see `open_page`.
        speed: mission seconds per second, in virtual time.
        interrupted: ends all waiting.
    """

    def __init__(self, control: bool, port: int | None, speed: float, interrupted: threading.Event) -> None:
        self._control = control
        self._port = port
        self._speed = speed
        self._interrupted = interrupted
        self._server: PageServer | None = None
        self._watch: Watch | None = None
        self._feed: Feed | None = None

    @property
    def address(self) -> str:
        """The page's address; empty while it is not served."""
        return self._server.address if self._server is not None else ""

    def beside_live(self, plan: DemoPlan, mission: Mission) -> None:
        """Show a mission of processes; call this before they start."""
        from pancakes.tools.web.feed import Feed
        from pancakes.tools.web.page import Shown
        from pancakes.tools.web.watch import Watch

        began_s = time.monotonic()
        feed = Feed(lambda: time.monotonic() - began_s)
        feed.wait_for("the agents start")
        fleet = next(iter(plan.configs.values())).agent.fleet
        watch = Watch(feed, plan.peers(within_machine=True), fleet, over=lambda: mission.ended)
        self._show(Shown(feed, watch.explain, watch.order, watch.order if self._control else None, plan.demo.title))
        self._stop_watching()
        self._watch = watch
        watch.start()

    def beside_virtual(self, title: str) -> VirtualWatch:
        """Show a mission in virtual time; return the watch that the mission feeds."""
        from pancakes.tools.web.page import Shown
        from pancakes.tools.web.virtual_watch import VirtualWatch

        watch = VirtualWatch(self._speed, self._interrupted)
        self._show(Shown(watch.feed, watch.explain, watch.look, None, title))
        return watch

    def end(self, sentence: str) -> None:
        """Show the verdict of the mission."""
        self._stop_watching()
        if self._feed is not None:
            self._feed.end(sentence)

    def stay(self) -> None:
        """Serve the page until Ctrl-C."""
        if self._server is not None:
            show_text(f"the page stays at {self._server.address} until Ctrl-C")
            self._interrupted.wait()

    def close(self) -> None:
        """Stop serving the page."""
        self._stop_watching()
        if self._server is not None:
            self._server.close()

    def _show(self, shown: Shown) -> None:
        from pancakes.tools.cli.verbs.view import tell_address
        from pancakes.tools.web.page import open_page

        self._feed = shown.feed
        if self._server is not None:
            self._server.show(shown)
            return
        self._server = open_page(shown, self._port)
        tell_address(self._server.address, self._control, Printer("table"))

    def _stop_watching(self) -> None:
        if self._watch is not None:
            self._watch.close()
            self._watch = None


PASSED, FAILED, INTERRUPTED = 0, 1, 130
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class DemoNames(click.ParamType):
    """The demos that are installed; completed in a shell, suggested in an error."""

    name = "demo"

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[Any]:
        from click.shell_completion import CompletionItem

        return [CompletionItem(name) for name in Plugins().names("pancakes.demos") if name.startswith(incomplete)]


@click.command()
@click.argument("name", type=DemoNames(), required=False)
@click.option("--list", "list_", is_flag=True, help="Show the demos that are installed.")
@click.option(
    "--virtual/--live",
    default=None,
    help="In virtual time, in one process (same seed, same bytes), or as processes. [default: set by the demo]",
)
@click.option(
    "--seed", default=1, show_default=True, type=click.IntRange(0), help="The seed of noise, movements and starts."
)
@click.option("--seeds", type=Seeds(), help="Run a mission for each seed of a range: 1-200, or 3,17,20-29 (virtual).")
@click.option("--jobs", type=click.IntRange(1), help="How many missions run at once. [default: one for each core]")
@click.option(
    "--speed",
    default=5.0,
    show_default=True,
    type=FiniteRange(0.01, 1000.0),
    help="Mission seconds per second (live, or with --view).",
)
@click.option(
    "--duration",
    metavar="TIME",
    type=Duration(1.0),
    help="The length of the mission, in mission time. [default: set by the demo]",
)
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder for the results. [default: runs/NAME-SEED-MODE]",
)
@click.option(
    "--configs",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Folder with the agents' configurations. [default: those of the demo]",
)
@agent_sets_option
@click.option("--headless", is_flag=True, help="Print plain lines instead of the live view or the progress bar.")
@click.option("--record", is_flag=True, help="Record the packets of all agents, into the folder for the results.")
@click.option("--view", "view_", is_flag=True, help="Show the mission on a page in the browser, until Ctrl-C.")
@click.option("--control", is_flag=True, help="Let the page migrate and stop tasks and change settings (live).")
@port_option
@click.option("--local", is_flag=True, help="Let the agents talk only within this machine, without ports (live).")
@click.option("--faults", is_flag=True, help="Add latency, jitter and broken links between the agents (virtual).")
@format_option
@click.pass_context
def demo(
    ctx: click.Context,
    name: str | None,
    list_: bool,
    virtual: bool | None,
    seed: int,
    seeds: tuple[int, ...] | None,
    jobs: int | None,
    printer: Printer,
    speed: float,
    out: Path | None,
    view_: bool,
    control: bool,
    port: int | None,
    faults: bool,
    local: bool,
    **others: Any,
) -> None:
    """Run a demo and judge it; the exit code is 0 only if the verdict is PASS.

    \b
    Example:
        pancakes demo encirclement
        pancakes demo encirclement --virtual --seed 7 --out runs/seven
        pancakes demo encirclement --view
        pancakes demo encirclement --virtual --seeds 1-200
    """
    plugins = Plugins()
    if list_ or name is None:
        _list(plugins)
        return
    found = _find(plugins, name)
    if virtual is None:
        virtual = found.virtual
    if faults and not virtual:
        raise click.UsageError("--faults needs --virtual: a live network has its own faults")
    if local and virtual:
        raise click.UsageError("--local and --virtual exclude each other: a virtual run uses no network")
    if not view_ and (control or port is not None):
        raise click.UsageError("--control and --port are for the page: they need --view")
    if control and virtual:
        raise click.UsageError("--control and --virtual exclude each other: control would make the run unrepeatable")
    mission = _mission(found)
    if virtual and mission.live_only:
        raise click.UsageError(f"the demo {name!r} runs only live: {mission.live_only}")
    if seeds is None and (jobs is not None or printer.is_json):
        raise click.UsageError("--jobs and --format are for many missions: they need --seeds")
    if seeds is not None:
        _refuse_beside_seeds(ctx, virtual, view_)
        sys.exit(_many(found, seeds, jobs, printer, out, faults, plugins, **others))
    fastest = mission.fastest
    if not virtual and speed > fastest:
        raise click.UsageError(
            f"live, the demo {name!r} runs at no more than {fastest:g} mission seconds per second, not at {speed:g}:"
            " it needs time on this machine's own clock"
        )
    agent_process.tune_interpreter()  # this process is an agent, or in virtual time has all of them
    # The agents end with the launcher, even if a second signal ends the launcher at once.
    interrupted = event_at(*SIGNALS, again=INTERRUPTED)
    page = DemoPage(control, port, speed, interrupted) if view_ else None
    out = (out or Path("runs") / f"{name}-{seed}-{'virtual' if virtual else 'live'}").absolute()
    speed = 1.0 if virtual else speed
    options = _Options(plugins, virtual, seed, speed, faults, local, interrupted, page, **others)
    try:
        try:
            code = _run(found, out, options)
        except PancakesError:
            if not interrupted.is_set():  # otherwise the interruption caused the error
                raise
            code = INTERRUPTED
        if page is not None and code != INTERRUPTED:
            page.stay()
    finally:
        if page is not None:
            page.close()
    end_by_signals(*SIGNALS)
    if page is None and interrupted.is_set():  # with a page, Ctrl-C is the normal end
        code = INTERRUPTED
    sys.exit(code)


def _refuse_beside_seeds(ctx: click.Context, virtual: bool, view: bool) -> None:
    """Refuse options that exclude `--seeds`."""
    if not virtual:
        raise click.UsageError("--seeds needs --virtual: live missions would compete for this machine")
    if view:
        raise click.UsageError("--view and --seeds exclude each other: the page shows one mission")
    if ctx.get_parameter_source("seed") is not ParameterSource.DEFAULT:
        raise click.UsageError("--seed and --seeds exclude each other: give all seeds to --seeds, such as 3,17,20-29")


def _many(
    found: Demo | Comparison,
    seeds: tuple[int, ...],
    jobs: int | None,
    printer: Printer,
    out: Path | None,
    faults: bool,
    plugins: Plugins,
    *,
    duration: float | None,
    configs: Path | None,
    sets: tuple[str, ...],
    headless: bool,
    record: bool,
) -> int:
    from pancakes.tools.demo.monte_carlo import MissionWishes

    interrupted = event_at(*SIGNALS, again=INTERRUPTED)
    wishes = MissionWishes(found.name, duration, configs, sets, faults, record)
    folder = (out or Path("runs") / f"{found.name}-seeds").absolute()
    whole, failed = run_seeds(found, seeds, folder, wishes, jobs, headless, printer, plugins, interrupted.is_set)
    end_by_signals(*SIGNALS)
    return INTERRUPTED if not whole else FAILED if failed else PASSED


def _mission(found: Demo | Comparison) -> Demo:
    from pancakes.tools.demo import Comparison

    return found.mission if isinstance(found, Comparison) else found


LIVE_ONLY: Final = " (live only)"
"""The mark, in the list of demos, of a demo that does not run in virtual time."""


def _list(plugins: Plugins) -> None:
    for name in plugins.names("pancakes.demos"):
        found: Demo | Comparison = plugins.get("pancakes.demos", name)
        live_only = _mission(found).live_only
        show_text(f"{name:16} {found.title}{LIVE_ONLY if live_only else ''}")


@dataclass(frozen=True)
class _Options:
    """The options of a mission, and the event and the page that end and show it."""

    plugins: Plugins
    virtual: bool
    seed: int
    speed: float
    faults: bool
    local: bool
    interrupted: threading.Event
    page: DemoPage | None
    duration: float | None
    configs: Path | None
    sets: tuple[str, ...]
    headless: bool
    record: bool


def _find(plugins: Plugins, name: str) -> Demo | Comparison:
    try:
        found: Demo | Comparison = plugins.get("pancakes.demos", name)
    except UnknownPluginError as error:
        raise click.BadParameter(str(error), param_hint="NAME") from None
    return found


def _run(found: Demo | Comparison, out: Path, options: _Options) -> int:
    from pancakes.tools.demo import Comparison
    from pancakes.tools.demo.conductor import how_slow

    if isinstance(found, Comparison):
        return _compare(found, out, options)
    mission = _fly(found, out, options)
    if mission is None:
        return INTERRUPTED
    run, summary, timing = mission
    if found.draw is not None and not options.interrupted.is_set():
        found.draw(run, summary)
    if options.interrupted.is_set():
        return _interrupted_late(out)
    _say_pace(timing)
    results = f"{_listed(path.name for path in out.iterdir() if path.is_file())} are in {nice_path(out)}"
    return _verdict(summary, how_slow(timing), [timing], results)


def _interrupted_late(out: Path) -> int:
    show_text(f"interrupted after the mission: no verdict; the files written so far are in {nice_path(out)}", err=True)
    return INTERRUPTED


def _fly(found: Demo, out: Path, options: _Options) -> tuple[Run, dict[str, Any], dict[str, Any]] | None:
    """Run one mission, and judge it; return None if it was interrupted."""
    from pancakes.tools.demo.conductor import Mission, how_slow
    from pancakes.tools.demo.launcher import (
        RECORDING,
        NetworkFaults,
        find_configs,
        fresh,
        judge,
        make_plan,
        run_live,
        run_of,
        run_virtual,
    )
    from pancakes.tools.demo.terminal_view import LiveView, PlainView

    virtual, seed = options.virtual, options.seed
    interrupted, page = options.interrupted, options.page
    duration_s = options.duration if options.duration is not None else found.duration_s
    configs = find_configs(found, options.configs)
    recording = (f'record.path="{out / RECORDING}/{{agent}}.mcap"',) if options.record else ()
    sets = (*recording, *options.sets)
    live, local = not virtual, options.local
    plan = make_plan(found, configs, out, seed, options.speed, duration_s, sets, live, options.plugins, local)
    fresh(out, (*found.records.values(), "paths.png"))
    mission = Mission(plan.demo.agents, duration_s)
    plain = options.headless or virtual or not sys.stdout.isatty()
    show_text(f"{found.title}: seed {seed}, {duration_s:g} s, results in {nice_path(out)}")
    # Open the page first: the live view would erase the line with its address.
    watch = None
    if page is not None and virtual:
        watch = page.beside_virtual(found.title)
    elif page is not None:
        page.beside_live(plan, mission)
    with PlainView(found, mission) if plain else LiveView(found, mission, page.address if page is not None else ""):
        if virtual:
            faults = NetworkFaults(seed) if options.faults else None
            timing = run_virtual(
                plan, mission, options.interrupted, faults, watch, lambda text: show_text(text, err=True)
            )
        else:
            timing = run_live(plan, mission, interrupted)
    if mission.phase == "interrupted":
        show_text(f"interrupted after {mission.now_s:.1f} s: no verdict", err=True)
        return None
    run = run_of(plan, mission)
    summary = judge(plan, run, timing)
    if page is not None:
        slow = ", and this machine was too slow for it" if how_slow(timing) else ""
        page.end(f"the mission is over: {summary['verdict']}{slow}")
    return run, summary, timing


def _compare(found: Comparison, out: Path, options: _Options) -> int:
    """Run all variants of a mission one after the other, and judge how they differ."""
    from pancakes.tools.demo.conductor import how_slow
    from pancakes.tools.demo.launcher import fresh, write_results

    fresh(out, (found.picture,))
    runs: dict[str, Run] = {}
    summaries: dict[str, dict[str, Any]] = {}
    timings: dict[str, dict[str, Any]] = {}
    for variant in found.variants:
        mission = replace(found.mission, title=f"{found.mission.title}, {variant.title}")
        # The command line comes last, so that it overrides the variant.
        own = replace(options, sets=(*variant.sets, *options.sets))
        result = _fly(mission, out / variant.name, own)
        if result is None or options.interrupted.is_set():
            return INTERRUPTED if result is None else _interrupted_late(out)
        runs[variant.name], summaries[variant.name], timings[variant.name] = result
        _say_pace(timings[variant.name])
    summary = found.judge(out, runs, summaries)
    write_results(out, summary, timings)
    if not options.interrupted.is_set():
        found.draw(out, runs, summary)
    if options.interrupted.is_set():
        return _interrupted_late(out)
    slow = [(variant.title, how_slow(timings[variant.name])) for variant in found.variants]
    folders = _listed(variant.name for variant in found.variants)
    where = "; ".join(f"{title}: {text}" for title, text in slow if text)
    results = f"summary.json and {found.picture}, and the folders {folders}, are in {nice_path(out)}"
    return _verdict(summary, where, list(timings.values()), results)


def _listed(names: Iterable[str]) -> str:
    *others, last = sorted(names)
    return f"{', '.join(others)} and {last}" if others else last


def _say_pace(timing: dict[str, Any]) -> None:
    """Print how fast a mission in virtual time ran."""
    if timing["mode"] == "virtual":
        show_text(f"took {timing['wall_s']:.2f} s, {timing['times_real_time']:.0f} times real time")


def _verdict(summary: dict[str, Any], slow: str, timings: Sequence[dict[str, Any]], results: str) -> int:
    """Print the verdict in the style of Robotarium, where the machine was too slow, and where the results are."""
    from pancakes.tools.demo.conductor import hint_of, verdict_line

    for line in summary.get("said", ()):
        show_text(line)
    show_text(f"verdict: {verdict_line(summary['verdict'], slow)}")
    for reason in summary["reasons"]:
        show_text(f"  - {reason}")
    if hint := hint_of(summary["verdict"], timings):
        show_text(hint)
    show_text(results)
    return PASSED if summary["verdict"] == "PASS" else FAILED
