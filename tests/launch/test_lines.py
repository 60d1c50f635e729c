"""Whatever a process prints, in whichever pieces, becomes lines."""

from pancakes.tools.launch.supervisor import LONGEST, Lines


def test_lines_are_put_together_from_pieces() -> None:
    lines = Lines()

    assert list(lines.feed(b"one\ntw")) == ["one"]
    assert list(lines.feed(b"o\r\n\nthr")) == ["two", ""]
    assert list(lines.rest()) == ["thr"]
    assert list(lines.rest()) == []


def test_a_letter_may_come_in_two_pieces_and_what_is_no_letter_is_shown() -> None:
    lines = Lines()
    first, second = "ä".encode()[:1], "ä".encode()[1:]

    assert list(lines.feed(first)) == []
    assert list(lines.feed(second + b"\n\xff\n")) == ["ä", "�"]


def test_a_line_without_an_end_is_cut() -> None:
    found = list(Lines().feed(b"x" * (LONGEST + 5)))

    assert [len(line) for line in found] == [LONGEST]
