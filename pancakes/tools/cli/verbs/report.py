"""`pancakes report`: turn a recording into a page and figures."""

from __future__ import annotations

from pathlib import Path

import click

from pancakes.tools.cli.options import format_option
from pancakes.tools.cli.output import Printer, show_text
from pancakes.tools.cli.streaming import load_packets


@click.command()
@click.argument("path", metavar="FILE|DIR", type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder for the report. [default: FILE-report or DIR-report, beside it]",
)
@click.option("--task", metavar="ID", default="", help="Report only on this task (BIRTHPLACE/NAME).")
@format_option
def report(path: Path, out: Path | None, task: str, printer: Printer) -> None:
    """Make a report of a recording: a file with its parts, or all files of a folder.

    The report shows where each robot went, which agent ran which task, migrations, batteries, rates, lateness, drops,
    traffic, and what led to the commands to actuators. The page, report.html, needs no other file. Each figure is also
    a PNG and an SVG, in the size of a paper's column. report.json has the numbers.

    \b
    Example:
        pancakes report runs/encirclement-1-virtual/recording
        pancakes report recordings/agent1.mcap --out paper/figures --task agent1/ScanTarget
    """
    from pancakes.tools.report.html_report import make_report

    load_packets()
    absolute = path.resolve()
    found = make_report(path, out or absolute.with_name(absolute.name.removesuffix(".mcap") + "-report"), task)
    for note in found.notes:
        show_text(note, err=True)
    printer.table([{"file": str(file), "shows": shows} for file, shows in found.files], ("file", "shows"))
