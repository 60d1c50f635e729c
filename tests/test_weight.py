"""How heavy a body is: nothing is asked of those that cannot be heavy, and little of the others."""

from __future__ import annotations

import enum
from array import array
from collections import OrderedDict, UserDict, deque
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import msgspec
import pytest
from seeded import for_each

from pancakes import control, devices, events
from pancakes.kernel.payload_size import LIGHT_BYTES, MOST_VALUES, SAMPLE, is_small, weigh, weight_of

if TYPE_CHECKING:
    from collections.abc import Sized


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


class Place(NamedTuple):
    number: int
    name: Annotated[str, msgspec.Meta(max_length=64)]


@dataclass(frozen=True)
class Brief:
    place: Place
    places: Annotated[tuple[Place, ...], msgspec.Meta(max_length=5)]


@dataclass(frozen=True)
class Lengthy:
    number: int
    text: Annotated[str, msgspec.Meta(max_length=1000)]


@dataclass(frozen=True)
class Crowded:
    places: Annotated[tuple[Place, ...], msgspec.Meta(max_length=100)]


@dataclass(frozen=True)
class Anything:
    number: int
    what: Any


@dataclass(frozen=True)
class Strange:
    number: int
    of: Sized


def test_weight_is_not_taken_of_fixed_sizes():
    def check(cls):
        assert is_small(cls)

    for_each([Fixed, Place, Brief, devices.Pose, devices.Twist, devices.Motion, devices.Battery], check)


def test_weight_of_bodies_that_may_be_large():
    def check(cls):
        assert not is_small(cls)

    for_each(
        [
            Frame,
            Named,
            Lengthy,
            Crowded,
            Anything,
            Strange,
            dict,
            devices.Infrared,
            control.Reply,
            events.Event,
            events.LogLine,
        ],
        check,
    )


def test_weight_is_about_what_it_takes():
    def check(case):
        body, least, most = case
        assert least <= weigh(body) <= most
        assert weight_of(body) == (weigh(body) if least > LIGHT_BYTES else 0)

    for_each(
        [
            (Frame(1, bytes(1 << 20)), 1 << 20, (1 << 20) + 1024),
            (Frame(1, b""), 0, 64),
            (Named(1, "x" * 5000), 5000, 5200),
            (Named(1, None, tuple(map(float, range(10_000)))), 240_000, 480_000),
            (Anything(1, {"a": bytes(3000), "b": [bytes(3000)] * 10}), 33_000, 34_000),
            (Anything(1, Frame(1, bytes(9000))), 9000, 9200),
            (Strange(1, OrderedDict(a=bytearray(3000))), 3000, 3200),
            ({"unknown": "here", "data": bytes(70_000)}, 70_000, 70_200),
            (Anything(1, memoryview(bytes(8000))), 8000, 8200),
        ],
        check,
    )


IMAGE = bytes(1 << 20)


def test_weight_finds_what_is_large_anywhere():
    """Also between numbers, deep inside, and among many small things."""

    def check(what):
        assert len(IMAGE) <= weigh(what) <= 1.01 * len(IMAGE)
        assert len(IMAGE) <= weigh(events.Event("frame", {"what": what})) <= 1.01 * len(IMAGE)

    for_each(
        [
            {"width": 640, "data": IMAGE, "height": 480},
            {"camera": {"front": {"frame": {"width": 640, "data": IMAGE, "height": 480}}}},
            {**{f"setting{n}": n for n in range(40)}, "data": IMAGE, "number": 1},
            {**{f"setting{n}": "on" for n in range(200)}, "data": IMAGE, "name": "front"},
            {"cameras": {f"camera{n}": {"on": False, "data": IMAGE if n == 3 else b"", "number": n} for n in range(8)}},
            [1, IMAGE, 2],
            [{"number": 1}, {"number": 2}, {"data": IMAGE}],
        ],
        check,
    )


@pytest.mark.parametrize(
    "what",
    [
        array("d", IMAGE),
        deque([1, IMAGE]),
        MappingProxyType({"data": IMAGE}),
        UserDict(data=IMAGE),
        {1: IMAGE}.values(),
    ],
)
def test_what_cannot_travel_is_weighed_as_well(what):
    """It may be published for tasks of the same agent."""
    assert len(IMAGE) <= weigh(Anything(1, what)) <= 1.01 * len(IMAGE)


@pytest.mark.parametrize("pairs", [20, 50, 500])
def test_where_small_and_large_take_turns_the_sample_has_both(pairs):
    large = bytes(10_000)
    for row in ([b"head", large] * pairs, [[b"head"], [large]] * pairs, [[large], [b"head"]] * pairs):
        assert pairs * 8_000 <= weigh(row) <= pairs * 12_000


@dataclass(frozen=True)
class Part:
    text: str


@dataclass(frozen=True)
class Parts:
    parts: list[Part]


def test_where_small_and_large_rows_take_turns_the_sample_has_both():
    for row in ([Part(""), Part("x" * 10_000)], [Part("x" * 10_000), Part("")]):
        assert 300_000 <= weigh(Parts(row * 40)) <= 500_000


def test_an_array_weighs_what_its_numbers_take():
    numpy = pytest.importorskip("numpy")
    assert 800_000 <= weigh(Anything(1, numpy.zeros((100, 1000)))) <= 801_000


def test_of_a_long_list_a_sample_stands_for_the_rest():
    seen = []

    class Watched:
        @property
        def nbytes(self) -> int:
            seen.append(1)
            return 1000

    assert 990_000 <= weigh([Watched()] * 1000) <= 1_100_000
    assert len(seen) <= 2 * SAMPLE


def test_what_a_body_says_of_itself_wrongly_harms_nobody():
    """Python checks no annotation, and a body of another class may come under the same name."""
    nothing: Any = None
    assert weight_of(Frame(1, nothing)) == 0
    assert 5000 <= weight_of({"number": 1, "data": bytes(5000)}) <= 5100


def test_a_body_that_holds_itself_is_weighed_to_the_end():
    endless: list[Any] = []
    endless += [endless] * 2
    assert weigh(endless) > 0


def test_the_work_is_bounded_however_a_body_is_built():
    looks = 0

    class Watched:
        def __init__(self, more: Any) -> None:
            self.more = more

        def __len__(self) -> int:
            return len(self.more)

        def __iter__(self) -> Any:
            return iter(self.more)

        def __contains__(self, item: Any) -> bool:
            return item in self.more

        @property
        def nbytes(self) -> None:
            nonlocal looks
            looks += 1

    body: Any = [Watched([n]) for n in range(100)]
    for _ in range(4):
        body = [Watched(body)] * 100
    weight = weigh(body)
    assert weight > 100_000
    assert looks <= MOST_VALUES
