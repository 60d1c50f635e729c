"""The live view of a demo in a terminal: what a person sees from the first moment to the last."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import pytest
from demo.terminal import Terminal

LENGTH = ("--duration", "10", "--speed", "5")


@pytest.mark.parametrize(("rows", "columns"), [(24, 80), (50, 120)])
def test_terminal_view_keeps_the_page_address_in_sight(tmp_path: Path, rows: int, columns: int):
    arguments = ("demo", "encirclement", "--view", "--control", "--out", str(tmp_path / "out"), *LENGTH)
    with Terminal(rows, columns, *arguments) as terminal:
        screens = terminal.screens_until("until Ctrl-C")
        assert terminal.interrupt() == 1, "the mission was too short for its verdict"
        everything = terminal.everything()
    # A terminal hands long writes on in pieces: only whole boxes count, and a cut line is whole on the next screen.
    running = [screen for screen in screens if " of 10 s" in screen and screen.count("╰") == 2]
    (address,) = set(re.findall(r"http://127\.0\.0\.1:\d+/#token=\S+", everything))
    shown = [f"the page is at {address}" in screen for screen in running]
    assert any(shown) and all(one or after for one, after in pairwise(shown)), running
    assert f"the page stays at {address} until Ctrl-C" in " ".join(everything.split())
    check_boxes(everything)


def test_terminal_view_leaves_no_part_of_a_box(tmp_path: Path):
    with Terminal(24, 80, "demo", "encirclement", "--out", str(tmp_path / "out"), *LENGTH) as terminal:
        terminal.screens_until("are in ")
        terminal.interrupt()
        check_boxes(terminal.everything())


def check_boxes(everything: str) -> None:
    """Checks that the last two boxes are whole, and that nothing is left of those before them."""
    assert "waiting for the agents" not in everything
    assert (everything.count("╭"), everything.count("╰")) == (2, 2), everything
    assert "10.0 of 10 s" in everything and "events ─" in everything
