"""How heavy a body is: nothing is asked of those that cannot be heavy, and little of the others."""

from __future__ import annotations

import enum
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import pytest

from pancakes import control, events
from pancakes.devices import types as devices
from pancakes.weight import LIGHT_BYTES, MOST_VALUES, SAMPLE, light_on_the_wire, weigh, weigher

if TYPE_CHECKING:
    from somewhere import Unknown


class Colour(enum.Enum):
    RED = "red"


@dataclass(frozen=True)
class Fixed:
    number: int
    share: float | None
    is_on: bool
    colour: Colour
    where: tuple[float, float]
    pose: devices.Pose
    mode: Literal["a", "b"]
    bounded: Annotated[int, msgspec.Meta(ge=0)]


@dataclass(frozen=True)
class Frame:
    number: int
    data: bytes


@dataclass(frozen=True)
class Named:
    number: int
    name: str | None
    parts: tuple[float, ...] = ()


@dataclass(frozen=True)
class Anything:
    number: int
    what: Any


@dataclass(frozen=True)
class Strange:
    number: int
    of: Unknown


@pytest.mark.parametrize("cls", [Fixed, devices.Pose, devices.Twist, devices.Motion, devices.Battery])
def test_a_body_of_a_fixed_size_is_not_weighed(cls):
    assert weigher(cls) is None


@pytest.mark.parametrize(
    "cls", [Frame, Named, Anything, Strange, dict, devices.Infrared, control.Reply, events.Event, events.LogLine]
)
def test_a_body_that_may_be_large_is_weighed(cls):
    assert weigher(cls) is not None


@pytest.mark.parametrize(
    ("body", "least", "most"),
    [
        (Frame(1, bytes(1 << 20)), 1 << 20, (1 << 20) + 1024),
        (Frame(1, b""), 0, 64),
        (Named(1, "x" * 5000), 5000, 5200),
        (Named(1, None, tuple(map(float, range(10_000)))), 240_000, 480_000),
        (Anything(1, {"a": bytes(3000), "b": [bytes(3000)] * 10}), 33_000, 34_000),
        (Anything(1, Frame(1, bytes(9000))), 9000, 9200),
        (Strange(1, OrderedDict(a=bytearray(2000))), 2000, 2200),  # type: ignore[arg-type]
        ({"unknown": "here", "data": bytes(70_000)}, 70_000, 70_200),
        (Anything(1, memoryview(bytes(8000))), 8000, 8200),
    ],
)
def test_the_weight_is_about_what_it_takes(body, least, most):
    measure = weigher(type(body))
    assert measure is not None
    assert least <= measure(body) <= most
    assert measure(body) > LIGHT_BYTES or most < LIGHT_BYTES


def test_an_array_weighs_what_its_numbers_take():
    numpy = pytest.importorskip("numpy")
    assert 800_000 <= weigh(Anything(1, numpy.zeros((100, 1000)))) <= 801_000


def test_of_a_long_list_a_sample_stands_for_the_rest():
    seen = []

    class Watched(msgspec.Struct):
        @property
        def nbytes(self) -> int:
            seen.append(1)
            return 1000

    assert 1_000_000 <= weigh([Watched()] * 1000) <= 1_100_000
    assert len(seen) <= SAMPLE


def test_what_a_body_says_of_itself_wrongly_harms_nobody():
    """Python checks no annotation, and a body of another class may come under the same name."""
    measure = weigher(Frame)
    assert measure is not None
    assert measure(Frame(1, None)) < LIGHT_BYTES  # type: ignore[arg-type]
    assert 5000 <= measure({"number": 1, "data": bytes(5000)}) <= 5100


def test_a_body_that_holds_itself_is_weighed_to_the_end():
    endless: list[Any] = []
    endless += [endless] * 2
    assert weigh(endless) > 0


def test_the_work_is_bounded_however_a_body_is_built():
    looks = 0

    class Watched(msgspec.Struct):
        more: Any = None

        @property
        def nbytes(self) -> None:
            nonlocal looks
            looks += 1

    body: Any = [Watched(n) for n in range(100)]
    for _ in range(4):
        body = [Watched(body)] * 100
    assert weigh(body) > 1_000_000
    assert looks <= MOST_VALUES


@dataclass(frozen=True)
class Row:
    numbers: list[int]


@pytest.mark.parametrize(
    ("cls", "light"), [(Fixed, LIGHT_BYTES), (Frame, LIGHT_BYTES), (events.LogLine, LIGHT_BYTES), (Row, 0), (dict, 0)]
)
def test_text_and_bytes_weigh_no_more_than_on_the_wire(cls: type, light: int) -> None:
    assert light_on_the_wire(cls) == light
