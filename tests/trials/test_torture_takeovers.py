"""`scripts/torture takeovers` judges by what tasks and actuators wrote, deals out each kind, and goes on."""

from __future__ import annotations

import json
import random
from collections import Counter
from pathlib import Path

import pytest
from torture.deck import Deck
from torture.guarded_faults import Takeovers
from torture.strokes import KINDS
from torture.takeover_tally import Heard, TakeoverTally, Traces, percentile


@pytest.mark.parametrize(
    ("epochs", "late", "doubled"),
    [
        ("0a 0a 1b 1b 2c", 0, 0),
        ("0a 1b 0a 1b 2c 1b 2c", 2, 0),
        ("0a 1b 0a 0a 1b", 2, 1),
        ("1b 1c 1b 1c 1b 1b", 3, 1),
    ],
)
def test_acts_under_a_passed_epoch_are_late_and_two_in_a_row_are_doubled(
    tmp_path: Path, epochs: str, late: int, doubled: int
) -> None:
    path, tally = tmp_path / "One.count", TakeoverTally()
    traces = Traces(path)
    for number, epoch in enumerate(epochs.split()):
        with path.open("a") as file:
            file.write(f"{number} {epoch[0]} {epoch[1]} {number}\n1 1")  # the next line is on its way
        traces.read(tally)
        path.write_text(path.read_text()[: -len("1 1")])
    assert (tally.late, tally.doubled, tally.acts) == (late, doubled, len(epochs.split()))


@pytest.mark.parametrize(
    ("heard", "wrong"),
    [
        ("1 0\n2 1\n3 2\n", 0),
        ("1 0\n2 1\n2 1\n3 2\n", 0),  # a copy that is gone had heard it too, and was not told of
        ("1 0\n2 1\n2 2\n", 1),
        ("1 0\n3 1\n", 1),
    ],
)
def test_a_packet_with_an_effect_twice_or_never_shows(tmp_path: Path, heard: str, wrong: int) -> None:
    path, tally = tmp_path / "One.heard", TakeoverTally()
    path.write_text(heard)
    Heard(path).read(tally)
    assert len(tally.wrong) == wrong


def test_late_acts_are_allowed_once_for_each_stop_of_each_thread_and_each_kind_must_be_reached() -> None:
    tally = TakeoverTally(faults=Counter({"short stop": 1}), late=2)
    assert tally.failures(("short stop",)) == []
    assert "no fault of the kind 'cut' was made" in tally.failures(("cut",))
    tally.late = 3
    assert "3 acts were late" in tally.failures(())[0]
    assert TakeoverTally(standstills=["none acts"]).failures(()) == ["none acts"]


def test_a_deck_deals_out_each_kind_as_often_as_any_other_but_none_that_does_not_fit() -> None:
    deck = Deck(KINDS, 3 * len(KINDS), random.Random(1))
    dealt = Counter(iter(deck.deal, ""))
    assert set(dealt.values()) == {3} and len(dealt) == len(KINDS)
    deck = Deck(KINDS, 100, random.Random(1))
    assert "cut" not in {deck.deal(["cut"]) for _ in range(99)}
    assert deck.deal(KINDS) == ""


def test_what_was_done_is_kept_and_not_done_again(tmp_path: Path) -> None:
    done = TakeoverTally(faults=Counter({"cut": 7}), acts=5, killed_s=[2.5])
    (tmp_path / "done").write_text(2 * (json.dumps(done.figures()) + "\n"))
    tally = Takeovers(tmp_path).run(faults=14, fleets=1)
    assert (tally.faults, tally.acts, tally.killed_s) == (Counter({"cut": 14}), 10, [2.5, 2.5])


def test_percentiles_are_values_that_were_measured() -> None:
    values = [float(value) for value in range(1, 101)]
    assert (percentile(values, 50), percentile(values, 99)) == (50.0, 99.0)
