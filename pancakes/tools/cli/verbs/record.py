"""`pancakes record ...`: record the packets of agents in MCAP files, and show and repair recordings."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Final

import click

from pancakes.client import Client
from pancakes.control import Describe, History, Start, Stop
from pancakes.errors import ControlRefusedError
from pancakes.tools.cli.agent_requests import request, survey_with
from pancakes.tools.cli.exit_codes import REFUSED
from pancakes.tools.cli.help_sections import SectionedGroup
from pancakes.tools.cli.listening import doubt_types
from pancakes.tools.cli.options import (
    Ask,
    FiniteRange,
    agents,
    asks_agents,
    dry_run_option,
    format_option,
    orders_agents,
)
from pancakes.tools.cli.output import DRY_RUN, Printer, show_text
from pancakes.tools.cli.streaming import load_packets

RECORDER: Final = "log/Recorder"
BY_ITSELF: Final = "it stopped itself"
"""The reason that an agent gives for a task that ended by itself."""
COLUMNS = ("agent", "done", "path")


SECTIONS: Final = {
    "Record": {
        "start": "Start recording.",
        "stop": "Stop recording.",
        "list": "List which agents record, and where.",
    },
    "Recordings": {
        "info": "Show what a recording has in it.",
        "repair": "Repair a recording whose recorder was killed.",
    },
}


@click.group(cls=SectionedGroup, sections=SECTIONS)
def record() -> None:
    """Record the packets of agents, and show and repair recordings.

    Each agent records the packets on its own channels. The files of several agents in one folder are one recording,
    which follows a task when it migrates. Foxglove can open them.
    """


@record.command()
@agents
@click.option(
    "--path", metavar="FILE", default="", help="The file, on the agent's machine; {agent} stands for its name."
)
@click.option("--channel", "channels", metavar="NAME", multiple=True, help="Only this channel. Repeatable.")
@click.option("--type", "types", metavar="TYPE", multiple=True, help="Only this packet type. Repeatable.")
@click.option(
    "--task", metavar="ID", default="", help="Only the packets that this task (BIRTHPLACE/NAME) reads and publishes."
)
@click.option("--limit-mib", type=FiniteRange(min=0.0), default=None, help="The largest size.")
@click.option("--split-mib", type=FiniteRange(min=0.0, min_open=True), help="Begin a new file at this size.")
@dry_run_option
@orders_agents
def start(agents: tuple[str, ...], channels: tuple[str, ...], task: str, dry_run: bool, ask: Ask, **given: Any) -> None:
    """Start recording on all agents, or only on those named.

    For omitted options the table [record] of the agent's configuration counts. An existing file is never overwritten:
    the new file gets a number.

    \b
    Example:
        pancakes record start
        pancakes record start agent1 --path 'runs/{agent}.mcap' --channel system --channel ctrl
        pancakes record start --task agent1/ScanTarget
    """
    doubt_types(given["types"])
    given |= {"channels": channels, "task": task}
    settings = {key: value for key, value in given.items() if value not in ("", (), None)}
    with ask.client() as client:
        rows = []
        found = survey_with(client, *agents)
        _check_channels(channels, found)
        if task and not _runs(client, task, found):
            show_text(f"the task {task} does not run there now: its packets are recorded when it arrives", err=True)
        for agent in [described["agent"] for described in found]:
            request(client, agent, Start(RECORDER, settings, dry_run))
            done = DRY_RUN if dry_run else "recording"
            rows.append({"agent": agent, "done": done, "path": None if dry_run else _path(client, agent)})
    ask.printer.table(rows, COLUMNS)


@record.command()
@agents
@dry_run_option
@orders_agents
def stop(agents: tuple[str, ...], dry_run: bool, ask: Ask) -> None:
    """Stop the recordings of all agents, or only of those named, and wait until the files are complete.

    \b
    Example:
        pancakes record stop
    """
    with ask.client() as client:
        rows = []
        for agent in _names(client, agents):
            running = request(client, agent, Describe(RECORDER)).result["state"] == "running"
            if not running and not agents:
                continue
            path = _path(client, agent)
            request(client, agent, Stop(RECORDER, dry_run=dry_run))
            rows.append({"agent": agent, "done": DRY_RUN if dry_run else "complete", "path": path})
    if not rows:
        raise ControlRefusedError("no agent is recording")
    ask.printer.table(rows, COLUMNS)


@record.command("list")
@agents
@asks_agents
def list_(agents: tuple[str, ...], ask: Ask) -> None:
    """List which agents record, and into which files.

    \b
    Example:
        pancakes record list
    """
    with ask.client() as client:
        rows = []
        for agent in _names(client, agents):
            recorder = request(client, agent, Describe(RECORDER)).result
            done, path = recorder["reason"] or recorder["state"], None
            if recorder["state"] == "running":
                done, path = "recording", _path(client, agent)
            elif recorder["reason"] == BY_ITSELF and (ended := _last(client, agent, "recording_stopped")) is not None:
                done, path = f"ended: {ended['reason']}", ended["path"]
            rows.append({"agent": agent, "done": done, "path": path})
    ask.printer.table(rows, COLUMNS)


@record.command()
@click.argument("path", metavar="FILE|DIR", type=click.Path(path_type=Path))
@format_option
def info(path: Path, printer: Printer) -> None:
    """Show the contents of a recording: a file with its parts, or all files of a folder.

    Times are mission times; duration_s is the duration of the recording.

    \b
    Example:
        pancakes record info runs/encirclement-1-virtual/recording
    """
    load_packets()
    from pancakes.recording.reader import RecordingReader, Summary
    from pancakes.recording.records import date_of

    reader = RecordingReader(path)
    time = reader.mission_time()
    summary = Summary.of(reader.entries())
    for note in reader.notes():
        show_text(note, err=True)
    virtual = any(reading.about.get("clock") == "mission time" for reading in reader.readings)
    stays = [
        {
            "task_id": stay.task_id,
            "agent": stay.agent,
            "epoch": stay.epoch,
            "from_s": round(time.at(stay.first_ns), 3),
            "to_s": round(time.at(stay.last_ns), 3),
            "published": stay.published,
        }
        for stay in summary.stays
    ]
    begins = date_of(summary.first_ns, "milliseconds", "T")
    about = {
        "path": str(path),
        "files": [str(file) for file in reader.files],
        "size_mib": round(sum(file.stat().st_size for file in reader.files) / 2**20, 3),
        "begins": "in virtual time" if virtual else begins if summary.packets else None,
        "time": time.name,
        "from_s": round(time.at(summary.first_ns), 3),
        "to_s": round(time.at(summary.last_ns), 3),
        "duration_s": round((summary.last_ns - summary.first_ns) / 1e9, 3),
        "packets": summary.packets,
        "whole": all(reading.whole for reading in reader.readings),
    }
    topics = [topic.row() for _, topic in sorted(summary.topics.items())]
    printer.emit([{**about, "tasks": stays, "topics": topics}], {str(path): about, "tasks": stays, "topics": topics})


@record.command()
@click.argument("paths", metavar="FILE...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--out",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Write the repaired file there, and do not change FILE.",
)
@dry_run_option
@format_option
def repair(paths: tuple[Path, ...], out: Path | None, dry_run: bool, printer: Printer) -> None:
    """Repair files whose recorder was killed: keep all packets that reached the disk, and add an index.

    \b
    Example:
        pancakes record repair recordings/agent1.mcap
    """
    from pancakes.recording.mcap_records import opened
    from pancakes.recording.reader import FileReading, files_of, messages
    from pancakes.recording.reader import repair as repair_file
    from pancakes.recording.records import RecordingError

    files = [file for given in paths for file in files_of(given)]
    if out is not None and len(files) > 1:
        raise click.UsageError(f"--out works with one file, not with {len(files)}")
    rows: list[dict[str, Any]] = []
    failed = False
    for path in files:
        if dry_run:
            reading = FileReading(path)
            with opened(path) as file:
                count = sum(1 for _ in messages(reading, file))
            done = "whole already" if reading.whole else DRY_RUN
            rows.append({"file": str(path), "done": done, "messages": count, "bytes_lost": None})
            continue
        try:
            repaired = repair_file(path, out)
        except RecordingError as error:
            if len(files) == 1:
                raise
            show_text(str(error), err=True)  # still repair the other files
            failed = True
            continue
        done = "whole already" if repaired.whole else "repaired"
        counts = {"messages": repaired.messages, "bytes_lost": repaired.bytes_lost}
        rows.append({"file": str(repaired.path), "done": done, **counts})
    printer.table(rows, ("file", "done", "messages", "bytes_lost"))
    if failed:
        sys.exit(REFUSED)


def _names(client: Client, agents: tuple[str, ...]) -> list[str]:
    return [described["agent"] for described in survey_with(client, *agents)]


def _check_channels(channels: tuple[str, ...], agents: list[dict[str, Any]]) -> None:
    """Refuse channels that no agent has; print those that only some agents have."""
    from pancakes.recording.records import CHANNEL

    known = list(dict.fromkeys(name for agent in agents for name in agent["channels"]))
    for channel in channels:
        lacking = [agent["agent"] for agent in agents if channel not in agent["channels"]]
        if channel == CHANNEL or not lacking:
            continue
        if len(lacking) == len(agents):
            raise ControlRefusedError(f"no agent has a channel {channel!r}. They have {', '.join(known)}")
        show_text(f"{', '.join(lacking)}: no channel {channel!r}, so it is not recorded there", err=True)


def _runs(client: Client, task_id: str, agents: list[dict[str, Any]]) -> bool:
    """Return whether a task runs on any of these agents, in any service."""
    for row in [row for agent in agents for row in agent["tasks"]]:
        if row["state"] == "running" and row["task"] == task_id.partition("/")[2]:
            reply = client.request(row["agent"], Describe(f"{row['service']}/{row['task']}"))
            if reply.ok and (reply.result["fence"] or {}).get("task_id") == task_id:
                return True
    return False


def _path(client: Client, agent: str) -> str | None:
    """Return the file that an agent records into, according to its log."""
    started = _last(client, agent, "recording_started")
    return started["path"] if started is not None else None


def _last(client: Client, agent: str, kind: str) -> dict[str, Any] | None:
    """Return the last event of a kind that an agent's log remembers."""
    found, after = None, 0
    while records := request(client, agent, History(after=after)).result:
        after = records[-1]["entry"]
        found = next((one for one in reversed(records) if one["kind"] == kind), found)
    return found
