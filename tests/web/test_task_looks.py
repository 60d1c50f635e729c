"""What a page gets about a task that a person looks at, and may change, over real sockets."""

from __future__ import annotations

import json
from typing import Any

import pytest
from web.page_rig import Fleet, answer_to, ask, page

from pancakes.control import Configure, Describe, Refusal, Reply
from pancakes.errors import NoAnswerError, UnreachableError
from pancakes.tools.web.page_server import PageServer

SCHEMA = {"type": "object", "properties": {"gain": {"type": "number", "minimum": 0, "default": 1.0}}}
TASK = {"agent": "a", "task": "client/T"}
TOLD = {
    "service": "client",
    "task": "T",
    "settings": {"gain": 2.0},
    "settings_schema": SCHEMA,
    "timers": [{"timer": "step", "rate_hz": 4.0, "ticks": 7, "missed": 0, "lateness_max_s": 0.1}],
}
WITH_STATE = Reply(None, {**TOLD, "state": {"count": 7, "text": "x" * 5000}, "mission_s": 3.0})
PLAIN = Reply(None, {**TOLD, "state": "stopped"})


def test_task_has_state_settings_and_timers(server: PageServer, fleet: Fleet):
    fleet.looks = {True: WITH_STATE}
    with page(server) as connection:
        result = ask(connection, "task", **TASK)["result"]
    assert fleet.looked == [("a", Describe("client/T", state=True))]
    assert (result["state"]["rows"][0], result["state"]["t"], result["state"]["cut"]) == (["count", "7"], 1.0, True)
    assert len(result["state"]["rows"][1][1]) < 120
    assert result["no_state"] == ""
    (gain,) = result["settings"]
    assert (gain["name"], gain["value"], gain["min"], gain["default"]) == ("gain", 2.0, 0, 1.0)
    assert result["timers"] == [{"timer": "step", "rate_hz": 4.0, "ticks": 7, "missed": 0}]


def test_missing_state_has_a_reason(server: PageServer, fleet: Fleet):
    fleet.looks = {True: Reply(Refusal("conflict", "a/client/T is stopped, not running")), False: PLAIN}
    with page(server) as connection:
        result = ask(connection, "task", **TASK)["result"]
        assert (result["state"], result["no_state"]) == (None, "a/client/T is stopped, not running")
        assert result["settings"][0]["value"] == 2.0

        fleet.looks = {True: NoAnswerError("nothing came in time"), False: PLAIN}
        result = ask(connection, "task", agent="b", task="client/T")["result"]
        assert result["no_state"] == "b/client/T has not told its state within 3 s: it may be busy"
        assert result["settings"][0]["value"] == 2.0

        fleet.looks = {
            True: Reply(Refusal("not_found", "c has no task 'T'")),
            False: Reply(Refusal("not_found", "c has no task 'T'")),
        }
        refused = ask(connection, "task", agent="c", task="client/T")
        assert (refused["ok"], refused["reason"]) == (False, "c has no task 'T'")


def test_past_states_are_shown(server: PageServer, fleet: Fleet):
    fleet.feed.take_detail("a", WITH_STATE.result)
    fleet.looks = {True: UnreachableError("a cannot be reached")}
    with page(server) as connection:
        past = ask(connection, "task", **TASK, t=4.0)["result"]
        before = ask(connection, "task", **TASK, t=0.5)["result"]
        present = ask(connection, "task", **TASK)["result"]
    assert past["state"]["rows"][0] == ["count", "7"] and past["no_state"] == ""
    assert before["state"] is None and "the timeline has no state of this task at this moment" in before["no_state"]
    assert present["state"] == past["state"] and present["no_state"] == "a cannot be reached"
    assert len(fleet.looked) == 1, "about the past no agent is asked"


def test_many_pages_ask_an_agent_once(server: PageServer, fleet: Fleet):
    fleet.waiting = []
    with page(server) as one, page(server) as other:
        for connection in (one, one, other):
            connection.send(json.dumps({"id": 7, "ask": "task", **TASK}))
        for connection in (one, other):  # each has been heard once what it asks after that is answered
            connection.send(json.dumps({"id": 8, "ask": "hello"}))
            answer_to(connection, 8)
        (only,) = fleet.waiting
        only.set_result(WITH_STATE)
        for connection in (one, one, other):
            assert answer_to(connection, 7)["result"]["settings"]


@pytest.mark.parametrize(
    "question", [{}, {"agent": "a"}, {"agent": "a", "task": "T"}, {**TASK, "agent": "../a"}, {**TASK, "t": "x"}]
)
def test_question_without_a_task_is_refused(server: PageServer, fleet: Fleet, question: dict[str, Any]):
    with page(server) as connection:
        answer = ask(connection, "task", **question)
    assert not answer["ok"] and "malformed" in answer["reason"]
    assert fleet.looked == []


def test_refused_settings_are_named(server: PageServer, fleet: Fleet):
    order = {**TASK, "do": "configure", "settings": {"gain": -1}, "dry_run": True}
    problems = {"problems": [{"path": ["gain"], "text": "expected a number >= 0, not -1"}]}
    fleet.answer = Reply(Refusal("invalid", "bad settings for T: gain: expected a number >= 0, not -1"), problems)
    with page(server) as connection:
        refused = ask(connection, "order", **order)
    assert fleet.asked == [("a", Configure("client/T", {"gain": -1}, dry_run=True))]
    assert (refused["ok"], refused["result"]) == (False, problems)


def test_read_only_page_changes_no_settings(onlooker: PageServer, fleet: Fleet):
    fleet.looks = {True: WITH_STATE}
    with page(onlooker) as connection:
        assert ask(connection, "task", **TASK)["result"]["settings"][0]["value"] == 2.0
        for change in ({"do": "configure", "settings": {"gain": 3}}, {"do": "rate", "rate_hz": 1}):
            answer = ask(connection, "order", **TASK, **change)
            assert not answer["ok"] and "start it with --control" in answer["reason"]
    assert fleet.asked == []


def test_oversized_order_reaches_no_agent(server: PageServer, fleet: Fleet):
    big = json.dumps({"id": 7, "ask": "order", **TASK, "do": "configure", "settings": {"a": 10**400}})
    with page(server) as connection:
        many = ask(connection, "order", **TASK, do="configure", settings={f"s{number}": 1 for number in range(65)})
        connection.send(big)
        answer = answer_to(connection, 7)
    assert "65 settings at once are too many" in many["reason"]
    assert not answer["ok"] and answer["reason"]
    assert fleet.asked == []
