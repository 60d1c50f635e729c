"""Settings: a dataclass says what may be set; plain values from a file or a packet are checked against it."""

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Literal

import pytest
from msgspec import Meta, Struct

from pancakes.settings import (
    SettingsError,
    change_plain,
    change_settings,
    check_settings,
    make_settings,
    plain_settings,
    required_keys,
)

if TYPE_CHECKING:
    from decimal import Decimal  # while the tests run there is no such name


@dataclass
class Leg:
    length_m: Annotated[float, Meta(gt=0)]
    joints: int = 2

    def __post_init__(self) -> None:
        if self.joints == 13:
            raise ValueError("13 joints cannot be steered")


class Walker:
    @dataclass
    class Settings:
        gait: Literal["walk", "trot"] = "walk"
        speed_mps: float = 0.1
        home_m: tuple[float, float] | None = None
        tail: Leg | None = None
        legs: list[Leg] = field(default_factory=list)
        spare: dict[str, Leg] = field(default_factory=dict)
        anything: Any = None


def problems(settings: Any, cls: type = Walker.Settings) -> list[str]:
    return [str(problem) for problem in check_settings(cls, settings)]


def test_sound_values_become_an_instance():
    settings = make_settings(
        Walker.Settings,
        {"gait": "trot", "speed_mps": 1, "home_m": [1, 2], "tail": {"length_m": 0.2}, "legs": [{"length_m": 1}]},
    )

    assert settings.gait == "trot"
    assert settings.speed_mps == 1.0 and isinstance(settings.speed_mps, float)
    assert settings.home_m == (1.0, 2.0)
    assert settings.tail == Leg(0.2)
    assert settings.legs == [Leg(1.0)]


def test_what_is_left_out_has_its_default():
    assert make_settings(Walker.Settings, {}) == Walker.Settings()


def test_all_mistakes_come_at_once_each_with_its_path():
    assert problems(
        {
            "gait": "trott",
            "speed": 1,
            "home_m": [1, "x"],
            "tail": {"joints": 1.5},
            "legs": [{"length_m": 1}, {"length_m": -1}, {"lenght_m": 1}],
            "spare": {"left front": {"length_m": 1, "joints": 13}},
        }
    ) == [
        "gait: expected one of 'walk', 'trot', not 'trott', did you mean 'trot'?",
        "speed: unknown key, did you mean 'speed_mps'?",
        "home_m[1]: expected a number, got a string",
        "tail.joints: expected an integer, got a number",
        "tail.length_m: is missing",
        "legs[1].length_m: expected a number > 0, not -1",
        "legs[2].lenght_m: unknown key, did you mean 'length_m'?",
        "legs[2].length_m: is missing",
        'spare."left front": 13 joints cannot be steered',
    ]


def test_words_of_several_lists_are_all_named():
    @dataclass
    class Rules:
        may: tuple[Annotated[Literal["look", "end"] | Literal["*"], Meta()], ...] = ()
        least: Literal["look", "end"] | None = None
        most: Literal["all"] | float = 1.0

    assert problems({"may": ["*", "lok"], "least": "edn", "most": 2}, Rules) == [
        "may[1]: expected one of 'look', 'end', '*', not 'lok', did you mean 'look'?",
        "least: expected one of 'look', 'end', not 'edn', did you mean 'end'?",
    ]


def test_a_key_that_is_there_already_is_not_suggested_again():
    assert problems({"gait": "trot", "gate": "trot"}) == ["gate: unknown key"]


def test_whoever_changes_settings_means_a_key_that_is_there():
    walker = make_settings(Walker.Settings, {"speed_mps": 1.0})
    with pytest.raises(SettingsError, match=r"gate: unknown key, did you mean 'gait'\?"):
        change_settings(walker, {"gate": "trot"})
    with pytest.raises(SettingsError, match=r"gate: unknown key$"):
        change_settings(walker, {"gait": "walk", "gate": "trot"})
    assert change_plain(Walker.Settings, {"speed_mps": 1.0}, {"gait": "trot"}).gait == "trot"


def test_a_list_of_the_wrong_length():
    assert problems({"home_m": [1]}) == ["home_m: expected a list of length 2, got 1"]


def test_settings_that_are_no_table():
    assert problems(3) == ["expected a table, got an integer"]


def test_none_is_good_only_where_the_type_says_so():
    assert problems({"tail": None, "home_m": None}) == []
    assert problems({"gait": None, "speed_mps": None}) == [
        "gait: expected a string, got nothing",
        "speed_mps: expected a number, got nothing",
    ]


def test_nan_is_no_setting_but_may_be_a_state():
    nan = float("nan")

    assert problems({"speed_mps": nan, "anything": {"x": [nan]}, "legs": [{"length_m": nan}]}) == [
        "speed_mps: is not a number (nan)",
        "anything.x[0]: is not a number (nan)",
        "legs[0].length_m: is not a number (nan)",
    ]
    assert make_settings(Walker.Settings, {"speed_mps": nan}, allow_nan=True).speed_mps != 0.1


@pytest.mark.parametrize("allow_nan", [False, True])
def test_what_cannot_be_saved_is_neither_setting_nor_state(allow_nan: bool):
    @dataclass
    class Odd:
        number: int = 0
        name: str = ""
        table: dict[str, list[int]] = field(default_factory=dict)

    for number in (-(2**63) - 1, 2**64):
        said = f"lies beyond what can be saved ({-(2**63)} to {2**64 - 1})"
        assert [str(it) for it in check_settings(Odd, {"number": number}, allow_nan)] == [f"number: {said}"]
        inside = {"table": {"x": [0, number]}}
        assert [str(it) for it in check_settings(Odd, inside, allow_nan)] == [f"table.x[1]: {said}"]
    half = "has a surrogate in it, which is half a letter, and cannot be saved"
    assert [str(it) for it in check_settings(Odd, {"name": "a\udcff"}, allow_nan)] == [f"name: {half}"]
    sound = {"number": 2**64 - 1, "name": "\ue000\ud7ff", "table": {"x": [-(2**63)]}}
    assert check_settings(Odd, sound, allow_nan) == []
    assert make_settings(Odd, sound, allow_nan).number == 2**64 - 1


@pytest.mark.parametrize("error", [KeyError(3), SystemExit(3)])
def test_whatever_a_class_raises_about_its_values_is_a_problem(error: BaseException):
    @dataclass
    class Inner:
        size: int = 0

        def __post_init__(self) -> None:
            if self.size > 2:
                raise error

    @dataclass
    class Outer:
        inner: Inner = field(default_factory=Inner)
        table: dict[str, Inner] = field(default_factory=dict)

    for settings, place in (({"inner": {"size": 3}}, "inner"), ({"table": {"x": {"size": 3}}}, "table.x")):
        (problem,) = check_settings(Outer, settings)
        assert str(problem).startswith(f"{place}: {type(error).__name__}: 3 at test_settings.py:")
    with pytest.raises(SettingsError, match=f"bad settings for a: {type(error).__name__}: 3 at test_settings"):
        make_settings(Inner, {"size": 3}, owner="a")


def test_make_settings_names_the_owner_and_every_mistake():
    with pytest.raises(SettingsError) as error:
        make_settings(Walker.Settings, {"gate": "trot", "speed_mps": "fast"})

    assert str(error.value) == (
        "bad settings for Walker: gate: unknown key, did you mean 'gait'?; speed_mps: expected a number, got a string"
    )
    assert [problem.path for problem in error.value.problems] == [("gate",), ("speed_mps",)]


class TestChange:
    """Settings that arrive by packet change those keys that they name."""

    before = Walker.Settings(gait="trot", home_m=(1.0, 2.0), tail=Leg(0.2, joints=4))

    def test_the_other_keys_stay(self):
        after = change_settings(self.before, {"speed_mps": 0.3})

        assert after == Walker.Settings(gait="trot", speed_mps=0.3, home_m=(1.0, 2.0), tail=Leg(0.2, joints=4))
        assert self.before.speed_mps == 0.1, "nobody who holds the old settings sees them change"

    def test_a_table_is_replaced_as_a_whole(self):
        assert change_settings(self.before, {"tail": {"length_m": 1}}).tail == Leg(1.0)

    def test_all_or_nothing(self):
        with pytest.raises(SettingsError, match="speed_mps: expected a number"):
            change_settings(self.before, {"gait": "walk", "speed_mps": []})


class TestClassesThatCannotBeSettings:
    """An author's mistake is told in a sentence, too."""

    def test_a_class_without_the_decorator(self):
        class Plain:
            class Settings:
                radius_m: float = 1.0

        assert problems({}, Plain.Settings) == ["Plain.Settings is no dataclass: decorate it with @dataclass"]

    def test_a_subclass_that_forgot_the_decorator(self):
        class Runner:
            class Settings(Walker.Settings):
                stamina: float = 1.0

        assert problems({"stamina": 2}, Runner.Settings) == [
            "Runner.Settings adds keys to inherited ones without @dataclass: decorate it with that"
        ]

    def test_a_subclass_that_adds_nothing_is_sound(self):
        class Runner:
            class Settings(Walker.Settings):
                pass

        assert problems({"gait": "trot"}, Runner.Settings) == []

    def test_a_type_that_cannot_be_resolved(self):
        @dataclass
        class Settings:
            radius_m: "Decimal"

        (problem,) = problems({"radius_m": 1}, Settings)
        assert "cannot be checked: name 'Decimal' is not defined" in problem


class Wheel(Struct):
    radius_m: Annotated[float, Meta(gt=0)]
    spokes: list[str] = []
    name: str = "front"

    def __post_init__(self):
        if self.name == "fifth":
            raise ValueError("a cart has four wheels")


class TestStructures:
    """A `msgspec.Struct` does as well as a dataclass."""

    def test_sound_values_become_an_instance_and_plain_again(self):
        wheel = make_settings(Wheel, {"radius_m": 0.5, "spokes": ["a"]})

        assert wheel == Wheel(0.5, ["a"], "front")
        assert plain_settings(wheel) == {"radius_m": 0.5, "spokes": ["a"], "name": "front"}
        assert change_settings(wheel, {"name": "rear"}) == Wheel(0.5, ["a"], "rear")

    @pytest.mark.parametrize(
        ("settings", "said"),
        [
            ({"radius_m": -1.0}, ["radius_m: expected a number > 0, not -1.0"]),
            ({}, ["radius_m: is missing"]),
            ({"radius_m": float("nan")}, ["radius_m: is not a number (nan)"]),
            ({"radius_m": 1.0, "name": "fifth"}, ["a cart has four wheels"]),
            (
                {"radius": 1.0, "spokes": ["a", 2], "name": 3},
                [
                    "radius: unknown key, did you mean 'radius_m'?",
                    "spokes[1]: expected a string, got an integer",
                    "name: expected a string, got an integer",
                    "radius_m: is missing",
                ],
            ),
        ],
    )
    def test_all_mistakes_come_at_once_each_with_its_path(self, settings, said):
        found = [str(problem) for problem in check_settings(Wheel, settings)]
        assert len(found) == len(said)
        for problem, start in zip(found, said, strict=True):
            assert problem.startswith(start)

    @pytest.mark.parametrize("how", [{"array_like": True}, {"tag": True}, {"rename": "camel"}])
    def test_one_that_is_no_table_of_its_fields_cannot_be_settings(self, how):
        class Row(Struct, **how):
            row_count: int = 0

        assert problems({}, Row) == ["Row is no table: make it a Struct without array_like, tag and rename"]

    def test_as_plain_values_each_field_is_there_down_to_the_innermost(self):
        class Spoke(Struct, omit_defaults=True):
            length_m: float = 0.3

        @dataclass
        class Tyre:
            width_m: float = 0.1
            spokes: list[Spoke] = field(default_factory=lambda: [Spoke()])

        class Bicycle(Struct):
            front: Tyre
            others: dict[str, tuple[Tyre, ...]]

        tyre = {"width_m": 0.1, "spokes": [{"length_m": 0.3}]}
        bicycle = make_settings(Bicycle, {"front": {}, "others": {"spare": [{}]}})

        assert plain_settings(bicycle) == {"front": tyre, "others": {"spare": (tyre,)}}
        assert plain_settings(make_settings(Tyre, {})) == tyre


class LaterNeeded(Struct, kw_only=True):
    gain: float = 1.0
    port: str
    limits: dict[str, float] = {}


def test_required_keys_may_follow_defaults():
    assert required_keys(LaterNeeded) == ("port",)


def test_free_tables_are_checked_with_the_rest():
    assert check_settings(LaterNeeded, {"port": "a", "limits": {"low": 1.0}}) == []
    (odd,) = check_settings(LaterNeeded, {"port": "a", "limits": {"low": math.inf}})
    assert odd.path == ("limits", "low")
    (bad,) = check_settings(LaterNeeded, {"port": "a", "limits": {"low": "x"}})
    assert bad.path == ("limits", "low")
