"""Make a report of a recording: read it, draw it, and write one self-contained HTML page.

The page works on any screen and on paper. It begins with a summary, and what it says in detail is folded away.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pancakes.errors import PancakesError, needing_extra
from pancakes.recording.clock_alignment import MissionTime, speed_of
from pancakes.recording.records import NANOSECONDS, RecordedPacket, RecordingError, date_of
from pancakes.tools.report.findings import Findings
from pancakes.tools.report.page import make_page
from pancakes.tools.report.plots import Palette, Picture
from pancakes.tools.report.summary import Summary, Verdict, verdict_beside

if TYPE_CHECKING:
    from pancakes.recording.reader import RecordingReader

PAGE: Final = "report.html"
FIGURES: Final = "report.json"


class CutFiles:
    """Note when the files of a recording that are cut off end, and when their agents' recordings go on.

    Args:
        reader: reads the recording.
    """

    def __init__(self, reader: RecordingReader) -> None:
        self._reader = reader
        self._ended_ns: dict[Path, int] = {}
        self._on_ns: dict[Path, int] = {}

    def entries(self) -> Iterator[RecordedPacket]:
        """Yield all packets of the recording, see `RecordingReader.entries`."""
        waiting: dict[str, list[Path]] = {}
        uncut = list(self._reader.readings)
        before: RecordedPacket | None = None
        for entry in self._reader.entries():
            # A file is found to be cut off after its last packet was taken, before the next one comes.
            for reading in [it for it in uncut if it.cut]:
                uncut.remove(reading)
                if before is not None:
                    self._ended_ns[reading.path] = before.time_ns
                    waiting.setdefault(before.agent, []).append(reading.path)
            for path in waiting.pop(entry.agent, ()):
                self._on_ns[path] = entry.time_ns
            yield entry
            before = entry

    def notes(self, time: MissionTime) -> list[str]:
        """Return sentences about what could not be read, after all packets were.

        Args:
            time: converts recording time to mission time.
        """
        said = {f"{it.path} is cut off: {it.cut}": self._note(it.path, it.cut, time) for it in self._reader.readings}
        return [said.get(note, note) for note in self._reader.notes()]

    def _note(self, path: Path, cut: str, time: MissionTime) -> str:
        from pancakes.recording.mcap_writer import first_name, part_number  # it needs mcap

        later = [it for it in self._reader.files if first_name(it) == first_name(path)]
        later = [it for it in later if part_number(it) > part_number(path)]
        if not later or path not in self._on_ns:
            return f"{path} is cut off: {cut}: this report lacks the rest"
        ended_s, on_s = time.at(self._ended_ns[path]), time.at(self._on_ns[path])
        return f"{path} is cut off at {ended_s:.1f} s; {later[0].name} goes on at {on_s:.1f} s"


@dataclass(frozen=True)
class Report:
    """The files of a report.

    Attributes:
        page: its page.
        files: all its files with their captions, the page first.
        notes: sentences about what the recording lacks.
    """

    page: Path
    files: tuple[tuple[Path, str], ...]
    notes: tuple[str, ...]


def make_report(path: Path, out: Path, task_id: str = "") -> Report:
    """Make a report.

    Args:
        path: the recording: a file with its parts, or all files of a folder.
        out: the folder for the report; existing files of the same names are replaced.
        task_id: report only on this task, `birthplace/name`; empty: on all.

    Raises:
        PancakesError: the recording or task does not exist, matplotlib or mcap is missing, or the report cannot be
            written.
    """
    with needing_extra("a report cannot be drawn"):
        import matplotlib  # noqa: F401
    with needing_extra("a recording cannot be read"):
        from pancakes.recording.reader import RecordingReader
    reader = RecordingReader(path)
    cuts = CutFiles(reader)
    findings = Findings.of(cuts.entries(), task_id, reader.mission_time())
    if not findings.packets:
        raise RecordingError(f"{path} has no packets" + _because(reader.notes()))
    if task_id and not findings.timeline.lanes:
        raise PancakesError(f"{path} has no task {task_id!r}: `pancakes record info` lists its tasks")
    notes = cuts.notes(findings.time)
    if findings.strange:
        notes.append(f"{findings.strange} packets are left out: their types are unknown here, or have changed since")
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
        about["took"] = f"{took_s:.1f} s of host time, at {many} mission seconds per second"
    if task_id:
        about["task"] = task_id
    try:
        return _write(path, out, findings, about, notes, verdict_beside(path))
    except OSError as error:
        raise PancakesError(f"the report cannot be written to {out}: {error.strerror or error}") from None


def _write(
    path: Path, out: Path, findings: Findings, about: dict[str, str], notes: list[str], verdict: Verdict | None
) -> Report:
    out.mkdir(parents=True, exist_ok=True)
    pictures = draw_all(findings, out)
    title = f"Report on {path.name if path.is_file() else path.resolve().name}"
    page = out / PAGE
    drawn = {it.name: it for it in pictures}
    page.write_text(make_page(title, about, notes, findings, drawn, verdict), encoding="utf-8")
    figures = out / FIGURES
    plain = {"summary": Summary.of(findings, verdict).plain(), **findings.plain()}
    figures.write_text(json.dumps(plain, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    files = [(page, "the report"), (figures, "its figures, for other programs")]
    files += [(out / f"{it.name}{suffix}", it.caption) for it in pictures for suffix in (".png", ".svg")]
    return Report(page, tuple(files), tuple(notes))


def draw_all(findings: Findings, out: Path) -> list[Picture]:
    """Draw the pictures that the findings have data for, and write their files.

    Args:
        findings: what the recording shows.
        out: the folder.

    Raises:
        OSError: the files cannot be written.
    """
    from pancakes.tools.report import plots

    # Robots and agents come first: they get the colours that are easiest to tell apart.
    busy = [*sorted(findings.paths.commands), *sorted(findings.paths.batteries), *findings.agents]
    palette = Palette([*busy, *findings.paths.truth])
    traffic = findings.traffic
    draws: tuple[Callable[[], Picture | None], ...] = (
        lambda: plots.draw_paths(findings, palette, out),
        lambda: plots.draw_timeline(findings, palette, out),
        lambda: plots.draw_moves(findings, palette, out),
        lambda: plots.draw_batteries(findings, palette, out),
        lambda: plots.draw_rates(findings, palette, out),
        lambda: plots.draw_lateness(findings, palette, out),
        lambda: plots.draw_drops(findings, palette, out),
        lambda: plots.draw_traffic(findings, out, "traffic-links", traffic.links, "link"),
        lambda: plots.draw_traffic(findings, out, "traffic-channels", traffic.channels, "channel"),
        lambda: plots.draw_reactions(findings, out),
    )
    return [picture for picture in (draw() for draw in draws) if picture is not None]


def _because(notes: Sequence[str]) -> str:
    text = "; ".join(notes)
    return f": {text}" if text else ""
