"""The files of a recording: packets go in and come out as they were, also where a crash has cut the file off."""

import errno
import io
import os
from types import SimpleNamespace
from typing import Any

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from recording.files import S, pose, read, written

from pancakes.devices import Motion
from pancakes.errors import LocalProtocolError, RemoteProtocolError
from pancakes.packet import Fence
from pancakes.recording.foxglove_messages import TRAIL_NS, Viewer
from pancakes.recording.mcap_writer import RecordingParts, RecordingWriter, part_path, parts_of
from pancakes.recording.message_format import packet_from_data, schema_for
from pancakes.recording.reader import RecordingReader, repair
from pancakes.recording.records import RecordedPacket, RecordingError


def test_packets_come_out_as_they_went_in(tmp_path):
    entries = [
        pose(0),
        pose(1, fence=Fence("a/Scan", (2, "b"))),
        pose(2, cause=("b/x", 7)),
        pose(3, kind="motion", body=Motion(True, None, None)),
    ]
    written(tmp_path / "r.mcap", entries)
    found, reader = read(tmp_path / "r.mcap")
    assert found == entries
    assert reader.notes() == []
    assert reader.readings[0].about["clock"] == "mission time"
    assert found[1].task_id == "a/Scan"


def test_a_disk_that_fails_ends_the_file_after_what_was_flushed_before(tmp_path, monkeypatch):
    class Disk(io.FileIO):
        """A file on a disk that may be full."""

        full = False

        def write(self, data):
            if self.full:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return super().write(data)

    path = tmp_path / "r.mcap"
    disk = Disk(path, "xb")
    with monkeypatch.context() as meanwhile:
        meanwhile.setattr("pathlib.Path.open", lambda path, mode: io.BufferedWriter(disk))
        writer = RecordingWriter(path, {"agent": "a"})
    for number in range(50):
        writer.write(pose(number))
    writer.flush()
    disk.full = True
    with pytest.raises(OSError, match="No space left"):
        for number in range(50, 2000):
            writer.write(pose(number))
    disk.full = False
    writer.close()
    entries, reader = read(path)
    assert entries[:50] == [pose(number) for number in range(50)]
    assert reader.notes() == [f"{path} is cut off: its end is missing"]
    assert repair(path).messages == len(entries)
    assert read(path)[1].notes() == []


def test_a_file_tells_any_reader_what_is_in_it_and_where(tmp_path):
    entries = [pose(number, kind="pose" if number % 3 else "motion") for number in range(500)]
    written(tmp_path / "r.mcap", entries)
    with (tmp_path / "r.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        late = [
            message.log_time for _, _, message in reader.iter_messages(topics="/a/system/pose", starting_at=490 * S)
        ]
        (about,) = [metadata.metadata for metadata in reader.iter_metadata()]
    assert late == [number * S for number in range(490, 500) if number % 3]
    assert about["agent"] == "a"
    told = summary.statistics
    assert told is not None
    assert (told.message_count, told.message_start_time, told.message_end_time) == (500, 0, 499 * S)
    assert sorted(told.channel_message_counts.values()) == [167, 333]
    assert told.chunk_count == len(summary.chunk_indexes) > 3
    data = (tmp_path / "r.mcap").read_bytes()
    for chunk in summary.chunk_indexes:
        for channel, offset in chunk.message_index_offsets.items():
            assert (data[offset], int.from_bytes(data[offset + 9 : offset + 11], "little")) == (0x07, channel)
    size = (tmp_path / "r.mcap").stat().st_size
    assert sum(chunk.compressed_size for chunk in summary.chunk_indexes) < size
    assert sum(chunk.uncompressed_size for chunk in summary.chunk_indexes) > 3 * size


def test_a_file_without_a_packet_is_whole_too(tmp_path):
    written(tmp_path / "r.mcap", [])
    found, reader = read(tmp_path / "r.mcap")
    assert (found, reader.notes()) == ([], [])
    with (tmp_path / "r.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count == 0


def test_any_mcap_reader_finds_topics_schemas_and_times(tmp_path):
    written(tmp_path / "r.mcap", [pose(0), pose(1)])
    with (tmp_path / "r.mcap").open("rb") as file:
        found = [(schema, channel, message) for schema, channel, message in make_reader(file).iter_messages()]
    schema, channel, message = found[1]
    assert schema is not None
    assert (schema.name, schema.encoding, channel.topic) == ("pancakes.pose", "jsonschema", "/a/system/pose")
    assert message.log_time == S
    assert schema_for("pose")["properties"]["body"]["properties"]["x_m"]["type"] == "number"


class Odd(str):
    """Fail where it is made a string."""

    def __str__(self) -> str:
        raise KeyError("odd")


def test_a_body_that_no_packet_may_hold_is_refused_and_the_file_is_as_it_was(tmp_path):
    writer = RecordingWriter(tmp_path / "r.mcap", {})
    around: dict[str, Any] = {}
    around["itself"] = around
    writer.write(pose(0))
    for number, body in ((1, object()), (2, around), (3, Odd("x"))):
        refused = f"the packet {number + 1} of the type 'pose' from a/device/pose cannot be recorded"
        with pytest.raises(LocalProtocolError, match=refused):
            writer.write(pose(number, body=body))
    writer.write(pose(4))
    writer.close()
    assert [entry.packet.seq for entry in read(tmp_path / "r.mcap")[0]] == [1, 5]


def test_a_file_that_is_cut_off_anywhere_gives_what_is_whole_and_is_repaired(tmp_path):
    whole = tmp_path / "whole.mcap"
    written(whole, [pose(number) for number in range(500)])
    data = whole.read_bytes()
    counts = set()
    for share in (0.2, 0.5, 0.8, 0.999):
        cut = tmp_path / f"cut-{share}.mcap"
        cut.write_bytes(data[: int(len(data) * share)])
        before, reader = read(cut)
        assert len(reader.notes()) == 1
        assert "is cut off" in reader.notes()[0]
        mended = repair(cut)
        after, reader = read(cut)
        assert after == before == [pose(number) for number in range(len(before))]
        assert reader.notes() == []
        assert not mended.whole
        assert mended.messages == len(before)
        with cut.open("rb") as file:
            assert sum(1 for _ in make_reader(file).iter_messages()) == len(before)
        counts.add(len(before))
    assert len(counts) == 4
    assert max(counts) == 500


def test_a_whole_file_is_left_alone_by_a_repair(tmp_path):
    written(tmp_path / "r.mcap", [pose(0)])
    before = (tmp_path / "r.mcap").read_bytes()
    assert repair(tmp_path / "r.mcap").whole
    assert (tmp_path / "r.mcap").read_bytes() == before


def test_what_is_damaged_in_the_middle_costs_a_chunk_and_not_what_comes_after_it(tmp_path):
    path = tmp_path / "r.mcap"
    written(path, [pose(number) for number in range(500)])
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    before, reader = read(path)
    assert reader.notes() == [f"{path} is damaged: 1 of its chunks cannot be read"]
    assert [entry.packet.seq for entry in before if entry.packet.seq > 400] == list(range(401, 501))
    assert len(before) == 450
    mended = repair(path)
    assert (mended.whole, mended.messages) == (False, 450)
    assert 0 < mended.bytes_lost < len(data) / 5
    after, reader = read(path)
    assert (after, reader.notes()) == (before, [])


def test_what_is_being_recorded_is_not_repaired_under_its_recorders_hands(tmp_path):
    path = tmp_path / "r.mcap"
    writer = RecordingWriter(path, {"agent": "a"})
    writer.write(pose(0))
    writer.flush()
    assert read(path)[1].notes() == [f"{path} is cut off: it is being recorded"]
    with pytest.raises(RecordingError, match=r"r\.mcap is being recorded: end that first"):
        repair(path)
    assert repair(path, tmp_path / "copy.mcap").messages == 1
    writer.write(pose(1))
    writer.close()
    assert len(read(path)[0]) == 2
    assert repair(path).whole


@pytest.mark.parametrize("full_after_bytes", [0, 20_000])
def test_a_repair_on_a_full_disk_leaves_the_file_as_it_was_and_can_be_done_later(
    tmp_path, monkeypatch, full_after_bytes
):
    path = tmp_path / "r.mcap"
    written(path, [pose(number) for number in range(300)])
    os.truncate(path, path.stat().st_size - 100)
    before = path.read_bytes()

    class Filling(Writer):
        """Write into a disk that is full for a moment."""

        written_bytes = 0

        def add_message(self, channel_id, log_time, data, publish_time, sequence=0):
            self.written_bytes += len(data)
            if self.written_bytes > full_after_bytes:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            super().add_message(channel_id, log_time, data, publish_time, sequence)

    with monkeypatch.context() as meanwhile:
        meanwhile.setattr("pancakes.recording.reader.Writer", Filling)
        with pytest.raises(RecordingError, match="No space left on device"):
            repair(path)
    assert [(it.name, it.read_bytes()) for it in tmp_path.iterdir()] == [("r.mcap", before)]
    assert repair(path).messages == 300
    assert list(tmp_path.iterdir()) == [path]


def test_a_recorder_that_was_killed_after_a_flush_has_lost_nothing_of_before(tmp_path):
    writer = RecordingWriter(tmp_path / "r.mcap", {})
    for number in range(7):
        writer.write(pose(number))
    writer.flush()
    assert len(read(tmp_path / "r.mcap")[0]) == 7
    writer.close()


@pytest.mark.parametrize("data", [b"", b"\x89MCA", b"\x89MCAP0\r\n"])
def test_a_file_that_was_only_just_made_spoils_no_recording(tmp_path, data):
    written(tmp_path / "r.mcap", [pose(0)])
    (tmp_path / "r.002.mcap").write_bytes(data)
    entries, reader = read(tmp_path / "r.mcap")
    assert entries == [pose(0)]
    assert reader.notes() == [f"{tmp_path}/r.002.mcap is cut off: it is empty"]
    assert not repair(tmp_path / "r.002.mcap").whole
    entries, reader = read(tmp_path / "r.mcap")
    assert (entries, reader.notes()) == ([pose(0)], [])


def test_a_file_is_one_from_its_making_on(tmp_path):
    writer = RecordingWriter(tmp_path / "r.mcap", {"agent": "a"})
    entries, reader = read(tmp_path / "r.mcap")
    assert (entries, reader.readings[0].about["agent"]) == ([], "a")
    writer.close()


def test_what_is_no_recording_is_named(tmp_path):
    (tmp_path / "r.mcap").write_bytes(b"no recording")
    with pytest.raises(RecordingError, match=r"r\.mcap is not a recording"):
        read(tmp_path / "r.mcap")
    with pytest.raises(RecordingError, match="there is no recording"):
        read(tmp_path / "none.mcap")
    with pytest.raises(RecordingError, match="has no recording"):
        (tmp_path / "empty").mkdir()
        read(tmp_path / "empty")


def test_a_topic_that_another_program_has_changed_is_named(tmp_path):
    with (tmp_path / "r.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel(
            "/robot/a/system/pose", "json", writer.register_schema("pancakes.pose", "", b"")
        )
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()
    entries, reader = read(tmp_path / "r.mcap")
    told = f"{tmp_path}/r.mcap: its topic '/robot/a/system/pose' is not of the form /AGENT/CHANNEL/TYPE"
    assert (entries, reader.notes()) == ([], [told])


def test_only_files_are_files_of_a_recording(tmp_path):
    written(tmp_path / "r.mcap", [pose(0)])
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "gone.mcap").symlink_to(tmp_path / "nowhere")
    os.mkfifo(tmp_path / "pipe.mcap")  # opening it would wait for ever
    assert read(tmp_path)[0] == [pose(0)]


def test_a_pipe_is_no_recording(tmp_path):
    os.mkfifo(tmp_path / "pipe.mcap")
    for use in (read, repair):
        with pytest.raises(RecordingError, match=r"pipe\.mcap"):
            use(tmp_path / "pipe.mcap")


def test_a_file_that_may_not_be_read_is_named(tmp_path, monkeypatch):
    written(tmp_path / "r.mcap", [pose(0)])

    def forbidden(path, mode):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr("pathlib.Path.open", forbidden)  # root may read anything
    for use in (read, repair):
        with pytest.raises(RecordingError, match=r"the recording .*/r\.mcap cannot be read: Permission denied"):
            use(tmp_path / "r.mcap")


def test_a_folder_in_which_nothing_may_be_looked_up_is_named(tmp_path, monkeypatch):
    def forbidden(path):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    monkeypatch.setattr("pathlib.Path.is_dir", forbidden)
    with pytest.raises(RecordingError, match=r"the recording .*/r\.mcap cannot be read: Permission denied"):
        RecordingReader(tmp_path / "r.mcap")


def test_recordings_in_virtual_time_and_of_the_day_are_told_apart(tmp_path):
    written(tmp_path / "virtual.mcap", [pose(0)])
    RecordingWriter(tmp_path / "live.mcap", {"agent": "b", "clock": "time of day"}).close()
    _, reader = read(tmp_path)
    [note] = reader.notes()
    assert (
        note
        == f"{tmp_path}/virtual.mcap is in virtual time and {tmp_path}/live.mcap is not: their times cannot be compared"
    )


def test_a_type_that_has_changed_since_is_told_and_the_rest_is_read(tmp_path):
    written(tmp_path / "r.mcap", [pose(0), pose(1, body={"x_m": "far"}), pose(2, body={"x_m": "far"}), pose(3)])
    found, reader = read(tmp_path / "r.mcap")
    assert [entry.packet.seq for entry in found] == [1, 4]
    (note,) = reader.notes()
    assert "a packet of the type 'pose' has a bad body" in note
    assert note.endswith("(2 times)")
    with pytest.raises(RemoteProtocolError, match="malformed"):
        packet_from_data("system", "pose", b"[]")


def test_the_files_of_several_agents_are_one_recording_in_the_order_of_time(tmp_path):
    written(tmp_path / "a.mcap", [pose(number) for number in (0, 2, 4)])
    written(tmp_path / "b.mcap", [pose(number, agent="b") for number in (1, 3)])
    assert [(entry.agent, entry.time_ns // S) for entry in read(tmp_path)[0]] == [
        ("a", 0), ("b", 1), ("a", 2), ("b", 3), ("a", 4)
    ]  # fmt: skip


def filled(parts, count):
    """Write until the parts end or `count` packets are in; returns why they ended."""
    reason = ""
    for number in range(count):
        parts.write(pose(number))
        if number % 50 == 49 and (reason := parts.flush()):
            break
    parts.close()
    return reason


def make_parts(path, split_mib=0.02, limit_mib=0.0, drop_oldest=False, free_mib=0.0):
    return RecordingParts(path, {"agent": "a"}, split_mib, limit_mib, drop_oldest, free_mib)


def test_a_recording_is_split_and_read_as_one(tmp_path):
    parts = make_parts(tmp_path / "r.mcap")
    assert filled(parts, 3000) == ""
    assert len(parts_of(tmp_path / "r.mcap")) > 2
    assert parts_of(tmp_path / "r.mcap")[1] == tmp_path / "r.002.mcap" == part_path(tmp_path / "r.mcap", 2)
    assert [entry.packet.seq for entry in read(tmp_path / "r.mcap")[0]] == list(range(1, 3001))


def test_at_its_limit_a_recording_ends_or_forgets_its_oldest(tmp_path):
    assert filled(make_parts(tmp_path / "stops.mcap", limit_mib=0.05), 5000) == "it has reached its limit of 0.05 MiB"
    parts = make_parts(tmp_path / "drops.mcap", limit_mib=0.05, drop_oldest=True)
    assert filled(parts, 2000) == ""
    left = sorted(tmp_path.glob("drops*.mcap"))
    assert sum(path.stat().st_size for path in left) < 0.09 * 2**20
    last = RecordingReader(left[-1])
    assert list(last.entries())[-1].packet.seq == 2000


def test_a_recording_that_forgot_its_first_file_is_found_by_that_and_the_next_one_is_another(tmp_path):
    parts = make_parts(tmp_path / "r.mcap", limit_mib=0.05, drop_oldest=True)
    assert filled(parts, 3000) == ""
    left = parts_of(tmp_path / "r.mcap")
    assert parts.first not in left
    assert RecordingReader(parts.first).files == left
    again = make_parts(tmp_path / "r.mcap", limit_mib=0.05, drop_oldest=True)
    assert again.first == tmp_path / "r-2.mcap"
    assert filled(again, 2000) == ""
    assert parts_of(tmp_path / "r.mcap") == left


def test_where_the_next_file_cannot_be_begun_the_last_one_is_whole(tmp_path, monkeypatch):
    parts = make_parts(tmp_path / "r.mcap")
    (tmp_path / "r.002.mcap").mkdir()
    with pytest.raises(FileExistsError):
        filled(parts, 3000)
    parts.close()  # as a recorder does then
    entries, reader = read(tmp_path / "r.mcap")
    assert (len(entries) > 50, reader.notes()) == (True, [])


def test_a_recording_ends_before_the_disk_is_full_and_does_not_begin_after_that(tmp_path, monkeypatch):
    parts = make_parts(tmp_path / "r.mcap", free_mib=64.0)
    full = os.statvfs(tmp_path)
    monkeypatch.setattr(
        os, "statvfs", lambda path: SimpleNamespace(f_frsize=full.f_frsize, f_bavail=63 * 2**20 // full.f_frsize)
    )
    parts.write(pose(0))
    assert parts.flush() == ""
    reason = parts.sync()
    assert reason.startswith(f"less than 64 MiB are free on the disk of {tmp_path} (63 MiB; free_mib")
    parts.close()
    assert len(read(tmp_path / "r.mcap")[0]) == 1
    assert filled(make_parts(tmp_path / "much.mcap", free_mib=0.0), 100) == ""
    with pytest.raises(RecordingError, match=r"s\.mcap does not begin: less than 64 MiB are free"):
        make_parts(tmp_path / "s.mcap", free_mib=64.0)
    assert not (tmp_path / "s.mcap").exists()


@pytest.mark.parametrize(("much", "split_mib"), [("SYNC_BYTES", 256.0), ("a new file", 0.02)])
def test_where_much_is_written_nobody_waits_before_it_is_brought_to_the_disk(tmp_path, monkeypatch, much, split_mib):
    if much == "SYNC_BYTES":
        monkeypatch.setattr("pancakes.recording.mcap_writer.SYNC_BYTES", 20_000)
    parts = make_parts(tmp_path / "r.mcap", split_mib)
    synced = []

    def sync(parts: RecordingParts) -> str:
        synced.append(parts)
        return ""

    monkeypatch.setattr(RecordingParts, "sync", sync)
    monkeypatch.setattr(RecordingWriter, "sync", lambda writer: None)
    for number in range(200):  # of 300 bytes each
        parts.write(pose(number))
        assert parts.flush() == ""
    parts.close()
    assert synced


def test_a_recording_that_cannot_begin_leaves_no_file(tmp_path, monkeypatch):
    def full(writer, name, values):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Writer, "add_metadata", full)
    with pytest.raises(RecordingError, match=r"r\.mcap cannot be written: No space left on device"):
        make_parts(tmp_path / "r.mcap")
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten_and_what_cannot_be_written_is_named(tmp_path):
    for name in ("r.mcap", "r-2.mcap", "r-3.mcap"):
        parts = make_parts(tmp_path / "r.mcap")
        assert parts.first == tmp_path / name
        parts.close()
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match=r"the recording .*/file/r\.mcap cannot be written: File exists"):
        make_parts(tmp_path / "file" / "r.mcap")


def test_poses_and_paths_are_shown_in_the_schemas_of_foxglove():
    viewer = Viewer()
    shown = [message for number in range(25) for message in viewer.messages(pose(number))]
    assert [message.schema_name for message in shown[:4]] == [
        "foxglove.PoseInFrame",
        "foxglove.FrameTransforms",
        "foxglove.PosesInFrame",
        "foxglove.PoseInFrame",
    ]
    paths = [message for message in shown if message.schema_name == "foxglove.PosesInFrame"]
    assert [message.time_ns for message in paths] == [0, TRAIL_NS, 2 * TRAIL_NS]
    assert paths[1].data.count(b"position") == 11
    assert shown[0].topic == "/viewer/a/pose"


@pytest.mark.parametrize(
    ("kind", "others"),
    [
        ("motion", {"body": Motion(True, None, None)}),
        ("pose", {"source": "world/client/MotionCapture"}),  # it only passes through
        ("pose", {"body": {"x_m": 1.0}}),  # of a type that is not known here
        ("world_state", {"body": {"bodies": []}}),
    ],
)
def test_of_nothing_else_viewers_are_shown_anything(kind, others):
    assert list(Viewer().messages(pose(1, kind=kind, **others))) == []


def test_viewers_are_shown_no_more_than_they_can_show():
    viewer = Viewer()
    fast = [RecordedPacket(number * S // 50, "a", pose(number).packet) for number in range(100)]
    shown = [message for entry in fast for message in viewer.messages(entry) if message.topic == "/viewer/a/pose"]
    assert len(shown) == 20


def test_recording_of_a_later_format_is_refused(tmp_path, monkeypatch):
    with monkeypatch.context() as later:
        later.setattr("pancakes.recording.mcap_writer.FORMAT", 2)
        later.setattr("pancakes.recording.mcap_writer.__version__", "0.9.0")
        RecordingWriter(tmp_path / "a.mcap", {"agent": "a"}).close()
    with pytest.raises(RecordingError, match=r"a.mcap is of the format 2, which Pancakes 0\.9\.0 has written"):
        read(tmp_path / "a.mcap")
