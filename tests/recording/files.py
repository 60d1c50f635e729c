"""What tests of recordings write, and how they read it."""

from pathlib import Path

from pancakes.devices import Pose
from pancakes.packet import Packet
from pancakes.recording.mcap_writer import RecordingWriter
from pancakes.recording.reader import RecordingReader
from pancakes.recording.records import RecordedPacket

S = 1_000_000_000


def pose(number, source="a/device/pose", agent="a", kind="pose", body=None, fence=None, cause=None):
    body = body or Pose(float(number), 0.5, -0.25)
    return RecordedPacket(
        number * S, agent, Packet("system", kind, source, "", float(number), number + 1, body, cause, fence)
    )


def written(path, entries):
    writer = RecordingWriter(path, {"agent": "a", "clock": "mission time"})
    for number, entry in enumerate(entries):
        writer.write(entry)
        if number % 50 == 49:
            writer.flush()
    writer.close()


def read(path):
    reader = RecordingReader(path)
    return list(reader.entries()), reader


def made_files(monkeypatch):
    """Return the files that recordings make from now on, as they are open."""
    made = []
    real = Path.open

    def noted(path, mode="r", *others, **options):
        file = real(path, mode, *others, **options)
        if mode == "xb":
            made.append(file)
        return file

    monkeypatch.setattr(Path, "open", noted)
    return made
