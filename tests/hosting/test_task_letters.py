"""What is known of the letters that have come for one task."""

from pancakes.durable.delivery import Letter, PacketId
from pancakes.durable.hosting import TaskLetters

MIB = 1024 * 1024


def letter(seq: int, size: int = 0) -> Letter:
    return Letter("b/Count", "a.1", seq, 1, bytes(size), "a")


def test_four_mebibytes_of_letters_wait_for_the_disk_at_most() -> None:
    letters = TaskLetters()
    assert [letters.keep(letter(seq, MIB), None) for seq in (1, 2, 3, 4, 5)] == [True, True, True, True, False]
    assert letters.keep(letter(2, MIB), None), "it is kept already"
    letters.on_disk(PacketId("a.1", 2))
    assert [letters.keep(letter(seq, MIB), None) for seq in (5, 6, 7)] == [True, True, False]


def test_a_thousand_letters_wait_for_the_disk_at_most() -> None:
    letters = TaskLetters()
    assert all(letters.keep(letter(seq), None) for seq in range(1, 1025))
    assert not letters.keep(letter(1025), None)


def test_only_what_is_on_disk_is_consumed() -> None:
    letters = TaskLetters()
    letters.took(letter(1))
    assert letters.consumed({}) == letters.consumed({"a.1": 0}) == letters.consumed({"other": 1}) == ()
    assert letters.consumed({"a.1": 1}) == (PacketId("a.1", 1),)
    # The task has handled more meanwhile than its service knows.
    assert letters.consumed({"a.1": 2}) == (PacketId("a.1", 1),)


def test_the_sender_hears_of_the_newest_letter_once_that_is_on_disk() -> None:
    letters = TaskLetters()
    letters.took(letter(2))
    letters.took(letter(1))  # it came again
    assert letters.on_disk(PacketId("a.1", 1)) == "a"
    assert letters.consumed({"a.1": 2}) == (PacketId("a.1", 2),), "the second is still to come"
    assert letters.on_disk(PacketId("other", 2)) == ""
    assert letters.on_disk(PacketId("a.1", 2)) == "a"
    assert (letters.owed, letters.on_disk(PacketId("a.1", 2))) == ({}, "")
