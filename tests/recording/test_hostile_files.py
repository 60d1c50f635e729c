"""Recordings that somebody has made up: what is unpacked has bounds, and a number that is text costs that packet."""

import io
import json
import tracemalloc
import zlib

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk
from mcap.writer import MCAP0_MAGIC, Writer
from recording.files import pose, read, written

from pancakes.recording.mcap_records import Damage, records_of
from pancakes.recording.reader import RecordingReader

GIB = 1 << 30
ROW = {
    "source": "a/device/pose",
    "destination": "",
    "stamp": 1.0,
    "seq": 5,
    "cause": None,
    "fence": None,
    "body": {"x_m": 1.0, "y_m": 0.0, "theta_rad": 0.0},
}


def zeros(pack, size):
    """Return so many zeros, packed a piece at a time."""
    return pack(bytes(1 << 20) for _ in range(size >> 20))


def by_zstd(pieces):
    packer = zstandard.ZstdCompressor().compressobj()
    return b"".join([*map(packer.compress, pieces), packer.flush()])


def by_lz4(pieces):
    packer = lz4.frame.LZ4FrameCompressor()
    return b"".join([packer.begin(), *map(packer.compress, pieces), packer.flush()])


@pytest.mark.parametrize("said", [GIB, 1000], ids=["true size", "false size"])
@pytest.mark.parametrize(("compression", "pack"), [("zstd", by_zstd), ("lz4", by_lz4)], ids=["zstd", "lz4"])
def test_a_chunk_that_grows_to_a_gibibyte_is_damaged_and_takes_no_memory(compression, pack, said):
    chunk = Chunk(compression, zeros(pack, GIB), 0, 0, 0, said)
    builder = RecordBuilder()
    chunk.write(builder)
    file = io.BytesIO(MCAP0_MAGIC + builder.end())
    damage = Damage()
    tracemalloc.start()
    try:
        with pytest.raises(Exception):  # noqa: B017 - the file ends here, however the library says so
            list(records_of(file, damage))
        assert tracemalloc.get_traced_memory()[1] < 100 << 20
    finally:
        tracemalloc.stop()
    assert damage.chunks == 1


def test_a_record_that_says_it_is_huge_ends_the_file(tmp_path):
    path = tmp_path / "r.mcap"
    written(path, [pose(1)])
    data = path.read_bytes()
    path.write_bytes(data[:-40] + b"\x05" + (1 << 40).to_bytes(8, "little") + data[-40:])
    entries, reader = read(path)
    assert len(entries) == 1 and reader.notes()


@pytest.mark.parametrize(
    "change",
    [
        {"stamp": "late"},
        {"stamp": None},
        {"seq": "five"},
        {"seq": 1.5},
        {"source": 7},
        {"destination": ["a"]},
        {"cause": ["a/x", "five"]},
        {"cause": 5},
        {"cause": ["a/x"]},
        {"fence": {"task_id": 3}},
        {"fence": ["a/T", ["one", "a"]]},
        {"body": {"x_m": "far", "y_m": 0.0, "theta_rad": 0.0}},
        {"exact": "no base64!"},
        {"exact": 5},
        "deep",
        "long",
    ],
    ids=str,
)
def test_a_value_of_another_type_costs_that_packet_and_is_told(tmp_path, change):
    path = tmp_path / "r.mcap"
    odd = "[" * 100_000 if change == "deep" else json.dumps(ROW)
    if change == "long":
        odd = odd.replace("1.0", "9" * 100_000, 1)
    elif change != "deep":
        odd = json.dumps({**ROW, **change})
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(library="made up")
        writer.add_metadata(
            "pancakes", {"agent": "a", "clock": "time of day", "speed": "fast", "life": "x", "epoch_ns": "?"}
        )
        schema = writer.register_schema("pancakes.pose", "jsonschema", b"{}")
        channel = writer.register_channel("/a/system/pose", "json", schema)
        for number, data in enumerate((json.dumps(ROW), odd, json.dumps({**ROW, "seq": 6}))):
            writer.add_message(channel, 1_000_000_000 + number, data.encode(), 1_000_000_000 + number)
        writer.finish()
    reader = RecordingReader(path)
    reader.mission_time()
    assert [entry.packet.seq for entry in reader.entries()] == [5, 6]
    (note,) = reader.notes()
    assert "'pose'" in note


def test_a_checksum_is_still_looked_at():
    data = b"\x00" * 10
    chunk = Chunk("zstd", by_zstd([data]), 0, 0, zlib.crc32(data) ^ 1, len(data))
    builder = RecordBuilder()
    chunk.write(builder)
    damage = Damage()
    with pytest.raises(Exception):  # noqa: B017 - as above
        list(records_of(io.BytesIO(MCAP0_MAGIC + builder.end()), damage))
    assert damage.chunks == 1
