"""How much of what each source says is written down: as tables, in a time of their own."""

import pytest

from pancakes.services.log_writer import WINDOW_S, Kind, LeftOut, Shares, sentence_of

A, B = Kind("r/client/A", False), Kind("r/client/B", False)
URGENT = Kind("r/client/A", True)


def written(shares: Shares, said: list[tuple[float, Kind, int]]) -> tuple[list[int], list[LeftOut]]:
    """Returns the places of the lines that were written, and what was told of the others."""
    through, told = [], []
    for place, (now_s, kind, size) in enumerate(said):
        told += shares.ended(now_s)
        if shares.admits(kind, now_s):
            shares.spend(kind, size)
            through.append(place)
    return through, told


@pytest.mark.parametrize(
    ("said", "through", "told"),
    [
        # Within its share nothing of a source is left out.
        ([(0.0, A, 40), (1.0, A, 40), (4.9, A, 20)], [0, 1, 2], []),
        # Once that is used up, all the rest is, and it is told as soon as the time is over.
        ([(0.0, A, 100), (0.1, A, 1), (4.9, A, 1), (5.0, A, 1)], [0, 3], [LeftOut(A, 2, WINDOW_S)]),
        # A line that is larger than a share is written, but nothing after it.
        ([(0.0, A, 5000), (0.0, A, 1), (5.1, B, 1)], [0, 2], [LeftOut(A, 1, WINDOW_S)]),
        # Others have shares of their own, and so have the source's own warnings and errors.
        ([(0.0, A, 100), (0.1, A, 9), (0.2, B, 9), (0.3, URGENT, 9), (0.4, A, 9)], [0, 2, 3], []),
        # The time counts from a source's first line, and begins anew with the first after that.
        (
            [(0.0, A, 100), (3.0, B, 100), (4.0, A, 1), (4.0, B, 1), (6.0, A, 100), (8.0, A, 1), (11.0, B, 1)],
            [0, 1, 4, 6],
            [LeftOut(A, 1, WINDOW_S), LeftOut(B, 1, WINDOW_S), LeftOut(A, 1, WINDOW_S)],
        ),
        # A single line that is left out is told, too.
        ([(0.0, A, 100), (0.1, A, 1), (9.0, B, 1)], [0, 2], [LeftOut(A, 1, WINDOW_S)]),
        # Errors without end are bounded as well.
        ([(0.0, URGENT, 100), *[(0.1, URGENT, 1)] * 1234, (9.0, A, 1)], [0, 1235], [LeftOut(URGENT, 1234, WINDOW_S)]),
    ],
)
def test_each_source_has_its_share_and_the_rest_is_counted(said, through, told):
    assert written(Shares(100 / WINDOW_S), said) == (through, told)


def test_without_a_limit_everything_is_written():
    shares = Shares(0)
    assert written(shares, [(0.0, A, 10**9)] * 3) == ([0, 1, 2], [])
    assert shares.next_s() is None


def test_it_says_when_there_is_something_to_tell():
    shares = Shares(100 / WINDOW_S)
    written(shares, [(0.0, A, 1), (1.0, B, 100)])
    assert shares.next_s() is None
    written(shares, [(2.0, B, 1)])
    assert shares.next_s() == 1.0 + WINDOW_S


def test_what_is_counted_when_it_stops_is_told_then_and_only_once():
    shares = Shares(100 / WINDOW_S)
    written(shares, [(0.0, A, 100), (1.0, A, 1), (2.0, B, 1)])
    assert shares.stopped(3.0) == [LeftOut(A, 1, 3.0)]
    assert shares.stopped(3.0) == shares.ended(100.0) == []


@pytest.mark.parametrize(
    ("left_out", "sentence"),
    [
        (LeftOut(A, 5312, 5.0), "5,312 more lines in the last 5 s were left out"),
        (LeftOut(A, 1, 5.0), "1 more line in the last 5 s was left out"),
        (LeftOut(A, 2, 0.0), "2 more lines in the last 0.1 s were left out"),
    ],
)
def test_a_person_is_told_how_many(left_out, sentence):
    assert sentence_of(left_out) == sentence
