"""Makes a report of a recording: reads it, finds what there is to find, draws it, and writes the page."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pancakes.errors import PancakesError, needing_extra
from pancakes.tools.recording.mission_time import speed_of
from pancakes.tools.recording.recorded_packet import NANOSECONDS, RecordingError, date_of
from pancakes.tools.report.findings import Findings
from pancakes.tools.report.style import Palette, Picture

PAGE: Final = "report.html"
FIGURES: Final = "report.json"


@dataclass(frozen=True)
class Made:
    """A report that was made.

    Attributes:
        page: its page.
        files: all its files, the page first, each with what it shows.
        notes: sentences on what is missing in the recording.
    """

    page: Path
    files: tuple[tuple[Path, str], ...]
    notes: tuple[str, ...]


def make_report(path: Path, out: Path, task_id: str = "") -> Made:
    """Makes a report.

    Args:
        path: the recording: a file with its parts, or all files of a folder.
        out: the folder for the report; files of its names that are there are replaced.
        task_id: tell only of this task, `birthplace/name`; empty: of all.

    Raises:
        PancakesError: there is no such recording or task, matplotlib or mcap is missing, or nothing can be written.
    """
    with needing_extra("a report cannot be drawn"):
        import matplotlib  # noqa: F401
    with needing_extra("no recording can be read"):
        from pancakes.tools.recording.recording_reader import RecordingReader
    reader = RecordingReader(path)
    findings = Findings.of(reader.entries(), task_id, reader.mission_time())
    if not findings.packets:
        raise RecordingError(f"{path} has no packets" + _because(reader.notes()))
    if task_id and not findings.course.lanes:
        raise PancakesError(f"no task {task_id!r} is in {path}: `pancakes record info` lists those that are")
    notes = [f"{note}: the rest of it is not in this report" if "cut off" in note else note for note in reader.notes()]
    if findings.strange:
        notes.append(f"{findings.strange} packets are of types that are unknown here, or were others once: left out")
    virtual = any(reading.about.get("clock") == "mission time" for reading in reader.readings)
    about = {
        "recording": ", ".join(file.name for file in reader.files),
        "agents": ", ".join(findings.agents),
        "began": "in virtual time" if virtual else date_of(findings.first_ns),
        findings.time.name: f"{findings.begin_s:.1f} to {findings.end_s:.1f} s",
        "packets": f"{findings.packets:,}",
    }
    speeds = {speed_of(reading.about) for reading in reader.readings}
    if not virtual and speeds - {1.0}:
        took_s = (findings.last_ns - findings.first_ns) / NANOSECONDS
        many = ", ".join(f"{speed:g}" for speed in sorted(speeds))
        about["took"] = f"{took_s:.1f} s of host time, at {many} mission seconds a second"
    if task_id:
        about["task"] = task_id
    try:
        return _write(path, out, findings, about, notes)
    except OSError as error:
        raise PancakesError(f"the report cannot be written to {out}: {error.strerror or error}") from None


def _write(path: Path, out: Path, findings: Findings, about: dict[str, str], notes: list[str]) -> Made:
    from pancakes.tools.report.report_page import make_page

    out.mkdir(parents=True, exist_ok=True)
    pictures = draw_all(findings, out)
    title = f"Report on {path.name if path.is_file() else path.resolve().name}"
    page = out / PAGE
    page.write_text(make_page(title, about, notes, findings, {it.name: it for it in pictures}), encoding="utf-8")
    figures = out / FIGURES
    figures.write_text(json.dumps(findings.plain(), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    files = [(page, "the report"), (figures, "its figures, for other programs")]
    files += [(out / f"{it.name}{suffix}", it.caption) for it in pictures for suffix in (".png", ".svg")]
    return Made(page, tuple(files), tuple(notes))


def draw_all(findings: Findings, out: Path) -> list[Picture]:
    """Draws all that there is something to see of, into files as well.

    Args:
        findings: what was found.
        out: the folder.

    Raises:
        OSError: the files cannot be written.
    """
    from pancakes.tools.report import measures, scenes

    # Those that move or run tasks come first: they get the colours that are easiest to tell apart.
    busy = [*sorted(findings.paths.commands), *sorted(findings.paths.batteries), *findings.agents]
    palette = Palette([*busy, *findings.paths.truth])
    traffic = findings.traffic
    draws: tuple[Callable[[], Picture | None], ...] = (
        lambda: scenes.draw_paths(findings, palette, out),
        lambda: scenes.draw_course(findings, palette, out),
        lambda: scenes.draw_moves(findings, palette, out),
        lambda: scenes.draw_batteries(findings, palette, out),
        lambda: measures.draw_rates(findings, palette, out),
        lambda: measures.draw_lateness(findings, palette, out),
        lambda: measures.draw_drops(findings, palette, out),
        lambda: measures.draw_traffic(findings, out, "traffic-links", traffic.links, "link"),
        lambda: measures.draw_traffic(findings, out, "traffic-channels", traffic.channels, "channel"),
        lambda: measures.draw_reactions(findings, out),
    )
    return [picture for picture in (draw() for draw in draws) if picture is not None]


def _because(notes: Sequence[str]) -> str:
    text = "; ".join(notes)
    return f": {text}" if text else ""
