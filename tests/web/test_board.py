"""The board: a page that was away gets the newest values, and nothing else is kept for it."""

from pancakes.tools.web.timeline import Board


def test_changes_since_any_version_are_returned():
    board = Board()
    board.set("a", 1)
    board.set("b", 2)
    seen = board.version
    board.set("a", 3)

    assert board.since(0) == {"b": 2, "a": 3}
    assert board.since(seen) == {"a": 3}
    assert board.since(board.version) == {}


def test_equal_value_is_not_a_change():
    board = Board()
    board.set("a", [1, 2])
    seen = board.version
    board.set("a", [1, 2])

    assert board.version == seen


def test_removed_value_is_a_change():
    board = Board()
    board.set("task/a/client/T", {})
    seen = board.version
    board.set("task/a/client/T", None)

    assert board.since(seen) == {"task/a/client/T": None}
    assert board.all() == {}
    assert board.keys("task/") == []


def test_many_changes_of_one_value_are_merged():
    board = Board()
    for number in range(100):
        board.set("a", number)

    assert board.since(0) == {"a": 99}
