"""The messages of a recording: what JSON cannot say of a body comes out exactly all the same."""

import math
from dataclasses import dataclass, field
from datetime import UTC, datetime
from decimal import Decimal
from enum import Enum
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import pytest
from recording.files import pose, read, written

from pancakes.devices import Motion, Pose
from pancakes.errors import LocalProtocolError
from pancakes.packet import packet_type
from pancakes.recording.message_format import data_of, packet_from_data
from pancakes.recording.reader import RecordingReader

if TYPE_CHECKING:
    from fractions import Fraction


@packet_type("test.scan")
@dataclass(frozen=True)
class Scan:
    """What JSON cannot hold."""

    ranges_m: np.ndarray
    raw: bytes = b""
    best_m: float = math.inf


@packet_type("test.anything")
@dataclass(frozen=True)
class Anything:
    """What may hold anything."""

    value: Any


class Way(Enum):
    """Go as its value."""

    LEFT = "left"


@dataclass(frozen=True)
class Place:
    """Part of another."""

    name: str
    at_m: tuple[float, float] = (0.0, 0.0)


@packet_type("test.told")
@dataclass(frozen=True)
class Told:
    """Of what JSON can say all."""

    raw: bytes
    ranges_m: list[float] = field(default_factory=list)
    places: tuple[Place, ...] = ()
    by_name: dict[str, int] = field(default_factory=dict)
    way: Way = Way.LEFT


@packet_type("test.own_code")
@dataclass(frozen=True, eq=False)
class OwnCode:
    """Has code of its own that goes wrong where two are compared."""

    value: Any
    __hash__ = object.__hash__

    def __eq__(self, other):
        return np.array([True, True])  # whose truth is no boolean


@packet_type("test.for_checks_only")
@dataclass(frozen=True)
class ForChecksOnly:
    """Names a type that is imported for checks only."""

    value: int
    what: "Fraction | None" = None


def test_what_json_cannot_hold_comes_out_exactly_all_the_same(tmp_path):
    scan = Scan(np.arange(6.0).reshape(2, 3), b"\x00\xff", math.inf)
    nan = pose(1, body=Pose(math.nan, math.inf, 0.0))
    written(tmp_path / "r.mcap", [pose(0, kind="test.scan", body=scan), nan])
    (first, second), _ = read(tmp_path / "r.mcap")
    assert np.array_equal(first.packet.body.ranges_m, scan.ranges_m)
    assert (first.packet.body.raw, first.packet.body.best_m) == (b"\x00\xff", math.inf)
    assert math.isnan(second.packet.body.x_m)
    assert second.packet.body.y_m == math.inf


def test_a_body_with_nothing_in_a_field_is_written_once():
    bodies = [Motion(True, None, None), Motion(True, math.nan, None)]
    once, twice = [data_of(pose(0, kind="motion", body=body).packet) for body in bodies]
    assert b'"exact"' not in once
    assert b'"exact"' in twice


@pytest.mark.parametrize(
    "body",
    [{"raw": b"\x00\xff"}, {"deep": [{"raw": b""}]}, Anything(b"\x00"), Anything({"x": math.inf}), Anything(None)],
)
def test_a_body_of_which_not_all_is_known_comes_out_exactly_too(tmp_path, body):
    """JSON writes bytes as text, and nobody could tell afterwards."""
    entry = pose(0, kind="test.anything" if isinstance(body, Anything) else "nobody.knows.this", body=body)
    written(tmp_path / "r.mcap", [pose(1), entry, pose(2)])
    assert read(tmp_path / "r.mcap")[0][1] == entry


def test_a_body_of_which_json_says_all_comes_out_as_it_was(tmp_path):
    body = Told(b"\x00\xff", [0.1, -0.0, 1e300], (Place("a", (1.0, 2.0)),), {"x": 2**63}, Way.LEFT)
    entry = pose(0, kind="test.told", body=body)
    written(tmp_path / "r.mcap", [entry])
    assert read(tmp_path / "r.mcap")[0] == [entry]
    without_number = pose(0, kind="test.told", body=Told(b"", [math.nan]))
    data = data_of(without_number.packet)
    assert repr(packet_from_data("system", "test.told", data)) == repr(without_number.packet)


@pytest.mark.parametrize(
    ("body", "seen"),
    [
        (Anything(datetime(2026, 1, 2, tzinfo=UTC)), Anything("2026-01-02T00:00:00Z")),
        (Anything(Decimal("1.5")), Anything("1.5")),
        (Anything({2}), Anything([2])),
        (Anything({1: None}), Anything({"1": None})),
        ({"by_number": {1: 2.0}}, {"by_number": {"1": 2.0}}),
    ],
)
def test_what_does_not_travel_is_recorded_as_well_as_it_goes(tmp_path, body, seen):
    """It is heard on its own agent all the same."""
    kind = "test.anything" if isinstance(body, Anything) else "nobody.knows.this"
    written(tmp_path / "r.mcap", [pose(1), pose(2, kind=kind, body=body)])
    assert [entry.packet.body for entry in read(tmp_path / "r.mcap")[0][1:]] == [seen]


def test_what_could_not_be_read_again_is_refused():
    with pytest.raises(LocalProtocolError, match="its body.value is of the type Raw, which does not travel"):
        data_of(pose(0, kind="test.anything", body=Anything(msgspec.Raw(b"no json"))).packet)


@pytest.mark.parametrize("value", [1.5, math.nan, b"\x00"])
def test_a_class_whose_own_code_goes_wrong_is_recorded_exactly(tmp_path, value):
    written(tmp_path / "r.mcap", [pose(1), pose(2, kind="test.own_code", body=OwnCode(value))])
    assert repr(read(tmp_path / "r.mcap")[0][1].packet.body) == repr(OwnCode(value))


def test_a_class_that_names_what_is_not_imported_costs_only_its_own_packets(tmp_path):
    body = ForChecksOnly(1)
    written(tmp_path / "r.mcap", [pose(1), pose(2, kind="test.for_checks_only", body=body), pose(3)])
    reader = RecordingReader(tmp_path / "r.mcap")
    assert [entry.packet.seq for entry in reader.entries()] == [2, 4]
    assert "name 'Fraction' is not defined" in reader.notes()[0]
