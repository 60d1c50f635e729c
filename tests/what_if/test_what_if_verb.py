"""`pancakes what-if` at a terminal: tables, JSON, and sentences where there is nothing to say."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from cli.processes import Rig
from what_if.burning import BurningFleet

TASKS = {"a": {"One": (20_000, 20.0), "Two": (10_000, 20.0)}, "b": {}}


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> Iterator[Rig]:
    rig = Rig(tmp_path_factory.mktemp("what_if"))
    try:
        with BurningFleet(rig, TASKS):
            yield rig
    finally:
        rig.close()


def test_a_move_shows_its_bids_and_what_it_would_do(rig: Rig):
    done = rig.pancakes("what-if", "migrate", "a/One", "--for", "1s")
    assert done.returncode == 0, done.stderr
    assert "measuring for 1 s" in done.stderr
    out = done.stdout
    for text in ("Bids", "active tasks 0", "If a/client/One migrates to b", "then", "Based on", "Uncertainty", "±"):
        assert text in out, out
    assert "battery" in out and "unknown" in out


def test_the_same_as_json_and_nothing_has_changed(rig: Rig):
    done = rig.pancakes("what-if", "rate", "a/One", "40", "--for", "1s", "--format", "json")
    told = json.loads(done.stdout)
    assert told["change"] == "a/client/One ticks at 40 Hz"
    (agent,) = told["agents"]
    after = agent["load_after"]
    assert agent["agent"] == "a" and after["low"] <= after["value"] <= after["high"] and after["value"] > agent["load"]
    rows = {row["task"]: row for row in rig.listed("task", "list")}
    assert rows["One"]["rate_hz"] == 20.0 and rows["One"]["agent"] == "a"


def test_an_agent_that_goes_names_the_place_of_each_task(rig: Rig):
    told = json.loads(rig.pancakes("what-if", "without", "a", "--for", "1s", "--format", "json").stdout)
    assert {row["task"]: row["goes to"] for row in told["tasks"]} == {"client/One": "b", "client/Two": "b"}
    after = {it["agent"]: it["load_after"]["value"] for it in told["agents"]}
    assert after["a"] == 0.0 and after["b"] > 0.0
    none = json.loads(rig.pancakes("what-if", "without", "b", "--for", "1s", "--format", "json").stdout)
    assert none["tasks"] == [] and [it["agent"] for it in none["agents"]] == ["b"]


@pytest.mark.parametrize(
    ("arguments", "code", "sentence"),
    [
        (["migrate", "a/Onee"], 1, "a has no task 'Onee', did you mean 'One'?"),
        (["migrate", "a/One", "--to", "x"], 1, "x"),
        (["migrate", "x/One"], 3, "x"),
        (["migrate", "a/One", "--cost", "nonsense"], 1, "knows no cost function 'nonsense'"),
        (["migrate", "a"], 2, "'a' is not a valid task name"),
        (["rate", "a/One", "-1"], 2, "-1"),
        (["rate", "a/One", "5", "--timer", "x"], 1, "has no timer 'x', only burn"),
        (["rate", "a/One", "5", "--for", "0.01s"], 2, "a measurement takes 0.1 to 600 s"),
        (["rate", "a/One", "5", "--for", "x"], 2, "'x' is not a time"),
        (["without", "x"], 3, "x"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_what_cannot_be_asked_gets_a_sentence(arguments, code: int, sentence: str, rig: Rig, tmp_path: Path):
    done = rig.pancakes("what-if", *arguments)
    assert sentence in done.stderr and "Traceback" not in done.stderr
    assert done.returncode == code and done.stdout == ""
