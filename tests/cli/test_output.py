"""How the verbs print what they have found."""

import json
import sys

import pytest

from pancakes.tools.cli.output import show, show_json, show_sections


def test_output_json_has_only_numbers_that_json_knows(capsys: pytest.CaptureFixture[str]):
    show_json([{"radius_m": float("inf"), "levels": (float("nan"), 0.5)}])

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    assert json.loads(capsys.readouterr().out, parse_constant=refuse) == [{"radius_m": None, "levels": [None, 0.5]}]


def test_output_table_fits_a_narrow_terminal_and_cuts_nothing(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    for name, value in (("TERM", "dumb"), ("COLUMNS", "30"), ("LINES", "25")):
        monkeypatch.setenv(name, value)
    show([{"agent": "gateway", "task": "BatteryWatchdog" * 2}], ("agent", "task"), "table")
    shown = capsys.readouterr().out
    assert max(len(line) for line in shown.splitlines()) <= 30
    text = "".join(shown.split())

    assert "…" not in text
    assert text.count("W") == 2


def test_output_table_keeps_brackets_of_lists(capsys: pytest.CaptureFixture[str]):
    for value, text in (
        (["pose", "motors"], "pose, motors"),
        ([[0.0, 0.0], [1.5, 1.0]], "[[0, 0], [1.5, 1]]"),
        ([(1.0, 2.0)], "[[1, 2]]"),
        ([[]], "[[]]"),
        ({"left": [1, 2], "right": None}, "left [1, 2], right -"),
        ([{"x_m": 1.0, "y_m": 2.0}], "[{x_m 1, y_m 2}]"),
        ([], "-"),
    ):
        show([{"value": value}], ["value"], "table")
        assert capsys.readouterr().out.splitlines()[-2].strip() == text


def test_output_section_has_its_control_characters_escaped(capsys):
    show_sections({"last failure": "RuntimeError: bang \x1b]0;owned\x07\nand more"})
    shown = capsys.readouterr().out
    assert "\x1b" not in shown.replace("\x1b[1m", "").replace("\x1b[0m", "") and "\x07" not in shown
    assert "bang \\x1b]0;owned\\x07" in shown
