"""The settings of a task become fields of a page by their JSON Schema."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from pancakes.settings import FilePath, plain_settings
from pancakes.tools.web.orders import MOST_BYTES, fields_of
from pancakes.util.schema import schema_of


@dataclass
class Legs:
    """Its legs.

    Attributes:
        length_m: of each leg.
    """

    length_m: Annotated[float, msgspec.Meta(gt=0, le=2)] = 0.5
    joints: dict[str, float] = field(default_factory=dict)


@dataclass
class Walk:
    """How it walks.

    Attributes:
        step_m: how far it goes at once.
    """

    step_m: Annotated[float, msgspec.Meta(ge=0.1, le=2.0)] = 0.5
    count: int = 4
    gait: Literal["trot", "pace"] = "trot"
    careful: bool = False
    quiet: bool | None = None
    most: int | None = None
    mood: Literal["good"] | None = None
    name: str = "walker"
    log: FilePath = "walk.csv"
    route: tuple[tuple[float, float], ...] = ((0.0, 1.0),)
    either: int | str = 1
    legs: Legs = field(default_factory=Legs)
    spare: Legs | None = None
    weights: NDArray[np.float64] = field(default_factory=lambda: np.array([1.0, 2.0]))
    anything: Any = None


def made(settings: Walk) -> dict[str, dict[str, Any]]:
    fields, left_out = fields_of(schema_of(Walk), plain_settings(settings))
    assert left_out == 0
    return {it["name"]: it for it in json.loads(msgspec.json.encode(fields))}


def test_setting_has_a_field_of_its_kind():
    fields = made(Walk())

    assert {name: it["kind"] for name, it in fields.items()} == {
        "step_m": "number",
        "count": "integer",
        "gait": "choice",
        "careful": "boolean",
        "quiet": "choice",
        "most": "integer",
        "mood": "choice",
        "name": "text",
        "log": "text",
        "route": "json",
        "either": "json",
        "legs.length_m": "number",
        "legs.joints": "json",
        "spare": "json",
        "weights": "json",
        "anything": "json",
    }
    step = fields["step_m"]
    assert (step["min"], step["max"], step["default"], step["value"]) == (0.1, 2.0, 0.5, 0.5)
    assert (step["unit"], step["description"]) == ("m", "how far it goes at once.")
    assert (step["type"], step["bounds"], step["nullable"]) == ("number", ">= 0.1, <= 2", False)
    legs = fields["legs.length_m"]
    assert (legs["path"], legs["description"], legs["min"], legs["max"]) == (["legs", "length_m"], "of each leg.", 0, 2)
    assert fields["gait"]["choices"] == ["pace", "trot"]
    assert fields["quiet"]["choices"] == [True, False, None]
    assert set(fields["mood"]["choices"]) == {"good", None}
    assert (fields["most"]["nullable"], fields["most"]["value"], "min" in fields["most"]) == (True, None, False)
    assert fields["weights"]["value"] == [1.0, 2.0]
    assert fields["anything"]["type"] == "anything"


def test_table_has_fields_unless_it_is_null():
    fields = made(Walk(spare=Legs(1.5)))

    assert fields["spare.length_m"]["value"] == 1.5
    assert "spare" not in fields


def test_unchangeable_value_fixes_its_table():
    fields = made(Walk(count=2**53 + 1, name="x" * 3000, legs=Legs(1.0, {str(number): 1.0 for number in range(900)})))

    assert fields["count"]["fixed"] == "a number that a browser cannot represent"
    assert fields["count"]["value"] == "9007199254740993"
    assert fields["name"]["fixed"] == "3002 characters long" and len(fields["name"]["value"]) < 200
    assert "characters long" in fields["legs.joints"]["fixed"]
    assert fields["legs.length_m"]["value"] == "1.0"
    assert "it is in the same table as legs.joints" in fields["legs.length_m"]["fixed"]
    assert "fixed" not in fields["step_m"]


def test_without_a_schema_values_are_shown():
    fields, left_out = fields_of({}, {"a": 1, "b": {"c": [1]}})
    assert [(it["name"], it["kind"], it["type"], left_out) for it in fields] == [
        ("a", "json", "anything", 0),
        ("b", "json", "anything", 0),
    ]

    fields, left_out = fields_of({}, {f"s{number}": "x" * 1000 for number in range(100)})
    assert len(fields) + left_out == 100 and left_out > 0
    assert len(msgspec.json.encode(fields)) <= MOST_BYTES
