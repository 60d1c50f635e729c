"""What a page says of events, and which of them are news."""

from __future__ import annotations

from typing import Any

import pytest
from web.samples import record

from pancakes.tools.web.event_words import sentence_of
from pancakes.tools.web.fleet_model import FleetModel


def migration(outcome: str, by: str, *lines: tuple[str, str, str], winner: str = "", **fields: Any) -> dict[str, Any]:
    said = [{"peer": peer, "answer": answer, "fate": fate} for peer, answer, fate in lines]
    about: dict[str, Any] = {
        "task": "Patrol",
        "source": "beta",
        "asked_by": by,
        "outcome": outcome,
        "winner": winner,
        "lines": said,
    }
    return record("beta", "migration", **about, **fields)


REFUSED, SILENT = ("a", "refused", "refused"), ("b", "silent", "silent")


@pytest.mark.parametrize(
    ("told", "sentence"),
    [
        (migration("stayed", "rule", REFUSED, SILENT), "Patrol stays on beta: no agent can take it (rule)"),
        (migration("stayed", "cli-1", REFUSED, to="a"), "Patrol stays on beta: a cannot take it"),
        (migration("stayed", "rule", SILENT), "Patrol stays on beta: no agent answers (rule)"),
        (migration("stayed", "rule"), "Patrol stays on beta: no agent was asked (rule)"),
        (migration("stayed", "cli-1", ("a", "bid", "failed")), "Patrol stays on beta: the migration to a failed"),
        (migration("moved", "guardians", winner="a"), "a took Patrol over from beta"),
        (migration("moved", "rule", winner="a"), "Patrol moved to a"),
        (record("a", "permit_given", task="Patrol", without_s=0.00424), "its guardians let a run Patrol"),
        (record("a", "asked", what="stop", task="T", by="cli-1", number=2), "a is asked to stop T by cli-1"),
        (
            record("a", "drive_begun", device="motors", by="alice.1/x", taken_from="", holder="a/client/Go"),
            "alice.1 drives motors of a by hand: a/client/Go waits",
        ),
        (
            record("a", "drive_begun", device="motors", by="alice.1/x", taken_from="bob.1/x", holder=""),
            "alice.1 drives motors of a by hand, taken over from bob.1",
        ),
        (
            record("a", "drive_ended", device="motors", by="alice.1/x", reason="ended", holder="a/client/Go"),
            "alice.1 no longer drives motors of a: a/client/Go goes on",
        ),
        (
            record("a", "drive_ended", device="motors", by="alice.1/x", reason="silent", holder=""),
            "alice.1 no longer drives motors of a, and is silent",
        ),
        (
            record("a", "drive_ended", device="motors", by="alice.1/x", reason="stopped", holder=""),
            "alice.1 no longer drives motors of a: the drive was stopped",
        ),
        (record("a", "halted", by="alice.1/x", reason="a child", number=1), "a is halted by alice.1: a child"),
        (record("a", "halted", by="b/client/T", reason="", number=1), "a is halted by b"),
        (record("a", "halt_ended", by="alice.1/x", number=1), "alice.1 ended the halt of a"),
        (
            record("a", "command_filtered", device="motors", filter="apart", doing="holds", reason="no pose"),
            "a/motors: the filter apart holds it: no pose",
        ),
        (
            record("a", "command_filtered", device="motors", filter="apart", doing="passes", reason=""),
            "a/motors: the filter apart lets commands pass again",
        ),
        (record("a", "asked", what="shutdown", by="cli-1/x"), "a is asked to shutdown by cli-1"),
    ],
)
def test_events_are_sentences(told: dict[str, Any], sentence: str):
    assert sentence_of(told) == sentence


def test_steps_of_protocols_are_not_news():
    model = FleetModel()
    model.tell(record("a", "no_dead_man", task="Patrol", device="motors"), 0.0)
    model.tell(record("a", "task_called", task="Patrol", epoch=2, silent_s=2.04), 0.0)
    model.tell(record("a", "mission_joined", peer="b", bound_s=0.001), 0.0)
    model.tell(record("a", "permit_given", task="Patrol", without_s=0.004), 0.0)
    told = {event["text"]: event["quiet"] for event in model.events.since(0)}
    assert told == {
        "motors of a keeps its last command if its process ends": True,
        "a is called to take Patrol over: its owner is silent for 2.0 s": True,
        "a has its mission time from b": True,
        "its guardians let a run Patrol": False,
    }


@pytest.mark.parametrize("kind", ["migration", "asked", "task_called", "guards_chosen"])
def test_own_event_of_that_name_is_shown(kind: str):
    assert sentence_of(record("a", kind, task=3, lines=7, x="y")).startswith(f"a: {kind.replace('_', ' ')} (")
