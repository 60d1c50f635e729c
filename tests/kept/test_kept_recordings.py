"""Recordings of earlier versions: listed, explained, reported, replayed, and run again."""

from __future__ import annotations

import json
from typing import Any

import pytest
from click.testing import CliRunner, Result
from kept.conftest import Kept

from pancakes.tools.cli.main import pancakes


@pytest.fixture
def run(kept: Kept) -> Any:
    """Runs a verb in the folder of the copy, and returns its result, or the JSON that it prints."""

    def run(*arguments: str) -> Result:
        result = CliRunner().invoke(pancakes, arguments)
        assert result.exit_code == 0, result.output
        return result

    return run


def test_kept_recording_is_listed(run: Any):
    (about,) = json.loads(run("record", "info", "recording", "--format", "json").stdout)
    assert about["whole"] and about["begins"] == "in virtual time" and about["packets"] > 100
    assert [(it["task_id"], it["agent"], it["epoch"]) for it in about["tasks"]] == [
        ("a/Drive", "a", 0),
        ("a/Drive", "b", 1),
    ]
    assert {"pose", "motors", "event"} <= {topic["type"] for topic in about["topics"]}


def test_kept_recording_is_whole(run: Any):
    rows = json.loads(run("record", "repair", "recording", "--dry-run", "--format", "json").stdout)
    assert [row["done"] for row in rows] == ["whole already"] * 2


def test_kept_recording_runs_again_as_it_did(kept: Kept, run: Any):
    stays = json.loads(run("rerun", "recording", "Drive", "--format", "json").stdout)
    assert [(stay["agent"], stay["agrees"], stay["whole"]) for stay in stays] == [("a", True, True), ("b", True, True)]
    compared = [it for stay in stays for it in stay["streams"] if it["type"] == "motors"]
    assert sum(it["equal"] for it in compared) == kept.expected["recording"]["commands"]


def test_kept_recording_differs_with_other_settings(run: Any):
    result = CliRunner().invoke(pancakes, ["rerun", "recording", "Drive", "--stay", "1", "--set", "gain=2"])
    assert result.exit_code == 1 and "v_mps was 0.125, is 0.5" in result.output


def test_kept_recording_says_why_a_command_was_given(kept: Kept, run: Any):
    told = json.loads(run("why", "recording", "--format", "json").stdout)
    assert (told["commands"], told["uncaused"]) == (kept.expected["recording"]["commands"], 0)
    chains = [kind["steps"] for kind in told["kinds"]]
    assert sorted(chains) == [[f"{name}/device/pose pose", f"{name}/client/Drive motors"] for name in "ab"]


def test_kept_recording_is_replayed(kept: Kept, run: Any):
    """Into an agent in virtual time whose sensor says nothing of its own: it gives the commands that it gave then."""
    text = (kept.folder / "recording" / "a.toml").read_text()
    for old, new in (("static.pose", "null.pose"), ("settings = { x_m = 0.25, y_m = 0.5 }", ""), ("start = false", "")):
        assert old in text
        text = text.replace(old, new)
    (kept.folder / "again.toml").write_text(text)
    run("replay", "recording/a.mcap", "--config", "again.toml", "--out", "again")
    (about,) = json.loads(run("record", "info", "again", "--format", "json").stdout)
    counts = {topic["type"]: topic["packets"] for topic in about["topics"]}
    assert counts["motors"] > 10
