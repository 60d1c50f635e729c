"""`pancakes rosbag ...`: recordings as bags of ROS 2, and bags as recordings."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from pancakes.errors import PancakesError
from pancakes.tools.cli.options import format_option
from pancakes.tools.cli.output import Printer, show_text
from pancakes.tools.cli.streaming import load_packets

EXPORTED = ("topic", "message", "messages", "left_out", "why")
IMPORTED = ("topic", "message", "agent", "packet", "packets", "left_out", "why")


@click.group()
def rosbag() -> None:
    """Write recordings as bags of ROS 2 (rosbag2), and read bags as recordings."""


@rosbag.command("export")
@click.argument("recording", metavar="FILE|DIR", type=click.Path(path_type=Path))
@click.option("--out", metavar="DIR", required=True, type=click.Path(path_type=Path), help="The folder of the bag.")
@click.option(
    "--storage", type=click.Choice(["sqlite3", "mcap"]), default="mcap", show_default=True, help="The files of the bag."
)
@format_option
def export(recording: Path, out: Path, storage: str, printer: Printer) -> None:
    """Write a recording as a bag with standard messages, for `ros2 bag play`.

    Readings become messages on /AGENT/DEVICE, commands to wheels on /AGENT/cmd_vel, poses also transforms on /tf, the
    log on /rosout. Packets that no message says are left out and listed.

    \b
    Example:
        pancakes rosbag export recordings --out bag
    """
    load_packets()
    _check_rosbags()
    from pancakes.recording.reader import RecordingReader
    from pancakes_ros2.bag_export import BagExport

    if out.exists():
        raise PancakesError(f"{out} is there already: choose another --out")
    reader = RecordingReader(recording)
    made = BagExport()
    made.write(reader.entries(), out, storage)
    for note in reader.notes():
        show_text(note, err=True)
    printer.table([asdict(row) for row in made.rows()], EXPORTED)


@rosbag.command("import")
@click.argument("bag", metavar="BAG", type=click.Path(path_type=Path))
@click.option("--out", metavar="DIR", required=True, type=click.Path(path_type=Path), help="The recording's folder.")
@click.option("--agent", metavar="NAME", default="", help="The agent that all topics belong to.")
@click.option(
    "--as", "types", metavar="TOPIC=TYPE", multiple=True, help="Read a topic as another packet type. Repeatable."
)
@click.option("--tf", "frames", metavar="FRAME:CHILD", default="", help="Make poses of CHILD in FRAME of /tf.")
@format_option
def import_(bag: Path, out: Path, agent: str, types: tuple[str, ...], frames: str, printer: Printer) -> None:
    """Read a bag as a recording, for `pancakes replay`, `report` and `record info`.

    A message on /AGENT/DEVICE becomes a reading of that device. Topics that are no readings are left out and listed.

    \b
    Example:
        pancakes rosbag import bag --out recordings
        pancakes rosbag import bag --out recordings --agent agent1 --as /lidar/points=laser_scan --tf map:base_link
    """
    load_packets()
    _check_rosbags()
    from pancakes_ros2.bag_import import BagImport, ImportSettings

    packets = {}
    for given in types:
        topic, equals, packet = given.partition("=")
        if not (topic.startswith("/") and equals and packet):
            raise click.UsageError(f"--as {given}: write /TOPIC=TYPE, such as /scan=laser_scan")
        packets[topic] = packet
    frame, colon, child = frames.partition(":")
    if frames and not (frame and colon and child and frame != child):
        raise click.UsageError(f"--tf {frames}: write FRAME:CHILD, such as map:base_link")
    made = BagImport(bag, ImportSettings(agent, packets, frame, child))
    made.write(out)
    printer.table([asdict(row) for row in made.topics], IMPORTED)


def _check_rosbags() -> None:
    try:
        import rosbags.highlevel  # noqa: F401
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "rosbags":
            raise
        raise PancakesError(
            "no bag can be read or written without rosbags: pip install 'pancakes-ros2[rosbag]'"
        ) from None
