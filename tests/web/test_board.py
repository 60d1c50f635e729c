"""The board: whoever was away gets the newest values, and nothing else is kept for them."""

from pancakes.tools.web.timeline import Board


def test_changes_are_told_since_any_version():
    board = Board()
    board.set("a", 1)
    board.set("b", 2)
    seen = board.version
    board.set("a", 3)

    assert board.since(0) == {"b": 2, "a": 3}
    assert board.since(seen) == {"a": 3}
    assert board.since(board.version) == {}


def test_a_value_that_stays_the_same_is_no_change():
    board = Board()
    board.set("a", [1, 2])
    seen = board.version
    board.set("a", [1, 2])

    assert board.version == seen


def test_what_is_taken_away_is_told_to_those_who_may_have_seen_it():
    board = Board()
    board.set("task/a/client/T", {})
    seen = board.version
    board.set("task/a/client/T", None)

    assert board.since(seen) == {"task/a/client/T": None}
    assert board.all() == {}
    assert board.keys("task/") == []


def test_a_hundred_changes_of_one_value_are_one_change_to_whoever_was_away():
    board = Board()
    for number in range(100):
        board.set("a", number)

    assert board.since(0) == {"a": 99}
