"""The state of a task is shortened for people, and kept in the timeline."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from pancakes.tools.short_state import MOST_BYTES, MOST_NODES, ShortState, TreeRow, shortened
from pancakes.tools.web.timeline import StateHistory


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.23456789, "1.23457"),
        (float("nan"), "nan"),
        (None, "-"),
        (True, "yes"),
        ("north", "north"),
        ("\x1b[2J", r"\x1b[2J"),
        ([1, [2.5, "x"], {"a": None}], '[1, [2.5, "x"], {a = -}]'),
        ({}, "{}"),
        (np.array([[1, 2], [3, 4]]), "[[1, 2], [3, 4]] (int64, 2 x 2)"),
        (np.array(1.5), "1.5 (float64, one number)"),
        (b"\x00\xff", "00 ff (2 bytes)"),
    ],
)
def test_value_is_shortened(value: Any, text: str):
    assert shortened({"it": value}) == ShortState((("it", text),), False)


def test_tables_become_dotted_names_to_a_depth():
    deep: Any = 1
    for _ in range(9):
        deep = {"x": deep}
    short = shortened({"a": {"b c": 1, "d": {"e": 2}}, **deep})

    assert short.rows[:2] == (('a."b c"', "1"), ("a.d.e", "2"))
    assert short.rows[2] == ("x.x.x.x.x.x", "{x = {x = {x = 1}}}")


def test_long_values_are_cut_with_their_length():
    short = shortened({"text": "x" * 50, "list": list(range(1000)), "array": np.zeros((30, 20))}, most_chars=20)

    assert short.cut
    assert short.rows == (
        ("text", f"{'x' * 20}… (50 characters)"),
        ("list", "[0, 1, 2, 3, 4, 5, 6… (1000 items)"),
        ("array", "[[0, 0, 0, 0, 0, 0, … (float64, 30 x 20)"),
    )


def node(depth: int, name: str, **others: Any) -> dict[str, Any]:
    """Return a node of a behaviour tree as the state of its task has it."""
    return {
        "name": name,
        "kind": "Walk",
        "depth": depth,
        "status": "RUNNING",
        "message": "",
        "child": -1,
        "kept": {},
        **others,
    }


def test_nodes_of_a_behaviour_tree_stand_apart_from_the_other_fields():
    short = shortened({"nodes": [node(0, "root"), node(1, "leg", status="FAILURE", message="fell")], "blackboard": {}})

    assert short.tree == (TreeRow(0, "root", "Walk", "RUNNING", ""), TreeRow(1, "leg", "Walk", "FAILURE", "fell"))
    assert (short.rows, short.cut) == ((("blackboard", "{}"),), False)
    assert short.size() > len("rootlegfell")


@pytest.mark.parametrize(
    "nodes", [[], 3, [1, 2], [{"name": "root"}], [node(0, "root", status="ASLEEP")], [node(10**9, "root")]]
)
def test_a_field_of_another_kind_is_no_behaviour_tree(nodes: Any):
    short = shortened({"nodes": nodes})
    assert (short.tree, [name for name, _ in short.rows]) == ((), ["nodes"])


def test_large_behaviour_tree_is_cut():
    many = shortened({"nodes": [node(1, f"n{number}") for number in range(MOST_NODES + 1)]})
    long = shortened({"nodes": [node(0, "x" * 50, message="y" * 50)]}, most_chars=20)
    kind = shortened({"nodes": [node(0, "root", kind="x" * 50)]}, most_chars=20)

    assert (len(many.tree), many.cut) == (MOST_NODES, True)
    assert (kind.tree[0].kind, kind.cut) == (f"{'x' * 20}… (50 characters)", True)
    assert (long.tree[0].name, long.tree[0].message, long.cut) == (
        f"{'x' * 20}… (50 characters)",
        f"{'y' * 20}… (50 characters)",
        True,
    )


class Counted(list[Any]):
    """A list that knows how many of its items were looked at."""

    def __init__(self, items: list[Any]) -> None:
        super().__init__(items)
        self.seen = 0

    def __iter__(self) -> Iterator[Any]:
        for item in super().__iter__():
            self.seen += 1
            yield item


def test_large_state_is_cut_without_reading_the_rest():
    large = Counted([[0.5] * 100] * 30_000)
    short = shortened({"list": large, "array": np.zeros((300, 300)), **{f"n{it}": it for it in range(10_000)}})

    assert short.cut and short.rows[0][1].endswith("(30000 items)")
    assert large.seen < 5
    assert sum(len(name.encode()) + len(text.encode()) for name, text in short.rows) <= MOST_BYTES
    assert shortened({"ж" * 500: "ж" * 5000}, most_chars=100).size() < 300
    assert shortened({}) == ShortState((), False)


# The timeline


def state(text: str) -> ShortState:
    return ShortState((("it", text),), False)


def test_last_state_before_a_moment_is_found():
    history = StateHistory()
    for t, text in ((1.0, "one"), (2.0, "one"), (5.0, "two")):
        history.add("a/client/T", t, state(text))
    history.add("b/client/T", 3.0, state("other"))

    assert history.at("a/client/T", 0.5) is None
    assert history.at("a/client/T", 1.5) == (1.5, state("one")), "it was the same before and after"
    assert history.at("a/client/T", 4.0) == (2.0, state("one"))
    assert history.at("a/client/T", 99.0) == (5.0, state("two"))
    assert history.at("b/client/T", 99.0) == (3.0, state("other"))
    assert history.at("c/client/T", 99.0) is None


def test_state_history_is_limited_in_time_and_memory():
    by_time, by_size = StateHistory(span_s=10.0), StateHistory(most_bytes=1000)
    for number in range(100):
        task = f"a/client/T{number % 3}"
        by_time.add(task, float(number), state(f"{number}"))
        by_size.add(task, float(number), state(f"{number:098}"))

    assert [by_time.at(f"a/client/T{number}", 80.0) for number in range(3)] == [None] * 3
    assert by_time.at("a/client/T0", 99.0) == (99.0, state("99"))
    assert [by_size.at(f"a/client/T{number}", 89.0) for number in range(3)] == [None] * 3
    assert by_size.at("a/client/T2", 92.0) == (92.0, state(f"{92:098}"))
