"""What agents say on `log`, as a person reads it."""

from __future__ import annotations

import pytest

from pancakes.client.sentences import sentence_of


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
