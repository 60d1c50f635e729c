"""What agents say on `log`, as a person reads it."""

from __future__ import annotations

import pytest

from pancakes.client.rows import sentence_of


@pytest.mark.parametrize(
    ("kind", "to", "sentence"),
    [
        ("migration_asked", "", "a asks all neighbours to take Walk"),
        ("migration_asked", "b", "a asks only b to take Walk"),
        ("migration", "", "Walk moved to b"),
        ("migration", "b", "Walk moved to b (only b was asked)"),
    ],
)
def test_a_move_says_whether_only_one_agent_was_asked(kind: str, to: str, sentence: str):
    record = {"agent": "a", "kind": kind, "task": "Walk", "outcome": "moved", "winner": "b", "to": to}
    assert sentence_of(record) == sentence


def test_what_becomes_of_a_guarded_task_is_said():
    lost = {"agent": "a", "kind": "permit_lost", "task": "Walk"}
    assert sentence_of(lost) == "Walk is paused on a: its guardians do not answer"
    taken = {"agent": "c", "kind": "taken_over", "task": "Walk", "by": "b", "source_agent": "a"}
    assert sentence_of(taken) == "b took Walk over from a, which is silent"
