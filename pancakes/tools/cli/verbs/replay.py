"""`pancakes replay`: feed recorded packets into running agents, or into agents in virtual time."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from pancakes.client import Target
from pancakes.tools.cli.agent_requests import survey_with
from pancakes.tools.cli.exit_codes import INTERRUPTED
from pancakes.tools.cli.options import AGENT_NAME, Ask, Duration, FiniteRange, dry_run_option, orders_agents
from pancakes.tools.cli.output import DRY_RUN, Printer
from pancakes.tools.cli.streaming import load_packets, say, until_ended

if TYPE_CHECKING:
    from pancakes.recording.reader import RecordingReader
    from pancakes.tools.replay.replay import Live, Selection, Tally
    from pancakes.util.plugins import Plugins

COLUMNS: Final = ("agent", "channel", "type", "source", "packets", "done")


@click.command()
@click.argument("path", metavar="FILE|DIR", type=click.Path(path_type=Path))
@click.option(
    "--speed",
    metavar="TIMES",
    type=FiniteRange(min=0.0, min_open=True, max=1000.0),
    default=1.0,
    show_default=True,
    help="Replay this many times as fast, in mission time.",
)
@click.option(
    "--start",
    "start_s",
    metavar="TIME",
    type=Duration(zero=True),
    help="Begin at this mission time (see pancakes record info).",
)
@click.option("--end", "end_s", metavar="TIME", type=Duration(), help="End at this mission time.")
@click.option(
    "--only",
    metavar="GLOB",
    multiple=True,
    help="Only packets whose AGENT/CHANNEL/TYPE or whose source matches. Repeatable.",
)
@click.option(
    "--as", "as_name", metavar="AGENT", type=AGENT_NAME, default="", help="Feed all packets to this agent instead."
)
@click.option(
    "--config",
    "configs",
    metavar="AGENT.toml",
    multiple=True,
    type=click.Path(dir_okay=False, path_type=Path),
    help="Run this agent in virtual time and feed it, instead of running agents. Repeatable.",
)
@click.option(
    "--out",
    metavar="DIR",
    type=click.Path(file_okay=False, path_type=Path),
    help="With --config: the folder for the recordings of these agents.",
)
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="With --config: the seed of random numbers."
)
@dry_run_option
@orders_agents
def replay(
    path: Path,
    speed: float,
    start_s: float | None,
    end_s: float | None,
    only: tuple[str, ...],
    as_name: str,
    configs: tuple[Path, ...],
    out: Path | None,
    seed: int,
    dry_run: bool,
    ask: Ask,
) -> None:
    """Feed a recording into a fleet: each packet goes to the agent on which it was recorded, at its time.

    Without --only, it feeds the packets on system and on channels of tasks: readings, and packets from other agents.
    Packets of a component that runs in the fleet are skipped, because it publishes its own. A null device publishes
    nothing, so its recorded readings are fed. Packets keep their recorded source, and get the mission time of the
    agent that receives them. Ctrl-C ends the replay.

    With --config the agents run in virtual time, in this process, and their packets are recorded into --out.

    \b
    Example:
        pancakes replay recordings --dry-run
        pancakes replay recordings/agent1.mcap --start 30s --end 1min --only 'agent1/device/*'
        pancakes replay recordings --only 'agent1/system/*' --as agent7 --speed 2
        pancakes replay recordings --config agent1.toml --out again
    """
    from pancakes.recording.reader import RecordingReader
    from pancakes.tools.replay.replay import Selection
    from pancakes.util.plugins import Plugins

    if bool(configs) != bool(out):
        raise click.UsageError("--config and --out need each other: the result is recorded into --out")
    if configs and ask.where != Target():
        raise click.UsageError("--at and --fleet are for running agents, --config starts agents: use only one of them")
    if end_s is not None and end_s <= (start_s or 0.0):
        raise click.UsageError(f"--end {end_s:g}s is not after --start {start_s or 0.0:g}s")
    plugins = Plugins()
    load_packets(plugins)
    reader = RecordingReader(path)
    selection = Selection({}, only, start_s or 0.0, end_s, as_name, reader.mission_time())
    replay_request = _ReplayRequest(reader, speed, selection)
    if out is not None:
        _feed_virtual(replay_request, configs, out, plugins, seed, dry_run, ask.printer)
    else:
        _feed_live(replay_request, dry_run, ask)


@dataclass(frozen=True)
class _ReplayRequest:
    """The recording and the options of a replay."""

    reader: RecordingReader
    speed: float
    wanted: Selection

    def select(self, agents: dict[str, Live]) -> tuple[Selection, Tally]:
        """Return the selection of packets for these agents, and its counts."""
        from pancakes.errors import UnreachableError
        from pancakes.tools.replay.replay import tally_of

        as_name = self.wanted.as_name
        if as_name and as_name not in agents:
            raise UnreachableError(f"there is no agent {as_name!r}, only {', '.join(sorted(agents))}")
        selection = replace(self.wanted, agents=agents)
        tally = tally_of(selection, self.reader.entries())
        for note in self.reader.notes():
            say(note)
        return selection, tally

    def recorded_speed(self) -> float:
        """Return the mission seconds per second of the recording."""
        from pancakes.recording.clock_alignment import speed_of

        speeds = {speed_of(reading.about): reading.path for reading in self.reader.readings}
        if len(speeds) > 1:
            listed = ", ".join(f"{path} at {speed:g}" for speed, path in speeds.items())
            say(f"the files were recorded at different mission speeds; the first one is used: {listed}")
        return next(iter(speeds))


def _feed_live(replay_request: _ReplayRequest, dry_run: bool, ask: Ask) -> None:
    from pancakes.tools.replay.replay import Feeder, Live

    with until_ended(), ask.client() as client:
        agents = {described["agent"]: Live.of(described) for described in survey_with(client)}
        selection, tally = replay_request.select(agents)
        if dry_run:
            ask.printer.table(_rows(tally, tally, True), COLUMNS)
            return
        assert tally.first_ns is not None
        feeder = Feeder(client, selection, say)
        is_interrupted = False
        try:
            recorded_speed = replay_request.recorded_speed()
            feeder.feed(replay_request.reader.entries(), tally.first_ns, replay_request.speed, recorded_speed)
        except KeyboardInterrupt:
            say("the replay was interrupted")
            is_interrupted = True
        feeder.settle()
        ask.printer.table(_rows(tally, feeder.tally, False), COLUMNS)
        if is_interrupted:
            sys.exit(INTERRUPTED)


def _feed_virtual(
    replay_request: _ReplayRequest,
    paths: tuple[Path, ...],
    out: Path,
    plugins: Plugins,
    seed: int,
    dry_run: bool,
    printer: Printer,
) -> None:
    from pancakes.config import load
    from pancakes.errors import PancakesError
    from pancakes.tools.replay.virtual_replay import VirtualReplay

    configs = [load(path, (), plugins) for path in paths]
    if not dry_run:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise PancakesError(f"the output folder {out} cannot be used: {error.strerror}") from None
    with until_ended(), VirtualReplay(configs, None if dry_run else out, plugins, seed) as fleet:
        selection, tally = replay_request.select(fleet.start())
        if dry_run:
            printer.table(_rows(tally, tally, True), COLUMNS)
            return
        assert tally.first_ns is not None
        scale = replay_request.recorded_speed() / replay_request.speed
        fleet.feed(selection, replay_request.reader.entries(), tally.first_ns, scale)
        for sentence in dict.fromkeys(fleet.refused):
            say(sentence)
        fed = fleet.tally
    printer.table(_rows(tally, fed, False), COLUMNS)
    say(f"the recordings of these agents are in {out}")


def _rows(planned: Tally, done: Tally, dry_run: bool) -> list[dict[str, Any]]:
    rows = []
    for topic, count in sorted(planned.packets.items()):
        fed = count if topic.left_out else done.packets.get(topic, 0)
        what = f"left out: {topic.left_out}" if topic.left_out else DRY_RUN if dry_run else "fed"
        rows.append({**topic._asdict(), "packets": fed, "done": what})
    return rows
