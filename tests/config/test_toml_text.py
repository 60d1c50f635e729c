"""Plain values as TOML: what is written is read again as it was."""

import math
import tomllib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pancakes.config.toml_writer import document_text, key_text, value_text

KEYS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\x00"), max_size=8)
SCALARS = (
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False)
    | st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
)
VALUES = st.recursive(SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3))


@given(VALUES)
def test_a_value_is_read_as_it_was(value: Any) -> None:
    assert tomllib.loads(f"value = {value_text(value)}") == {"value": value}
    assert "\n" not in value_text(value)


@given(st.dictionaries(KEYS, VALUES, max_size=4))
def test_a_document_is_read_as_it_was(tables: dict[str, Any]) -> None:
    assert tomllib.loads(document_text(tables)) == tables
    assert tomllib.loads(document_text(tables, lambda keys: "where\nit was said")) == tables


def test_a_document_looks_as_a_person_would_write_it() -> None:
    tables = {"schema": 1, "task": {"Scan": {"type": "a.Scan", "settings": {"radius_m": 0.5, "home_m": [1.0, 2.0]}}}}

    assert document_text(tables, lambda keys: "here" if keys[-1] == "type" else "").splitlines() == [
        "schema = 1",
        "",
        "[task.Scan]",
        'type = "a.Scan" # here',
        "",
        "[task.Scan.settings]",
        "radius_m = 0.5",
        "home_m = [1.0, 2.0]",
    ]


def test_what_has_no_value_is_left_out() -> None:
    assert document_text({"a": None, "b": {"c": None, "d": 1}}) == "[b]\nd = 1\n"


@pytest.mark.parametrize(("value", "text"), [(math.nan, "nan"), (-math.inf, "-inf"), (True, "true"), ({}, "{}")])
def test_odd_values(value: Any, text: str) -> None:
    assert value_text(value) == text


def test_keys_are_quoted_where_they_must_be() -> None:
    assert key_text(("task", "a.b", "rate_hz")) == 'task."a.b".rate_hz'
