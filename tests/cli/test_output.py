"""The output of verbs as tables and as JSON."""

import json
import sys
from collections.abc import Iterator

import pytest

from pancakes.tools.cli.output import Part, Printer, Rows


def test_output_json_has_no_nan_or_infinity(capsys: pytest.CaptureFixture[str]):
    Printer("json").emit([{"radius_m": float("inf"), "levels": (float("nan"), 0.5)}])

    def refuse(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    assert json.loads(capsys.readouterr().out, parse_constant=refuse) == [{"radius_m": None, "levels": [None, 0.5]}]


def test_output_table_folds_in_a_narrow_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    for name, value in (("TERM", "dumb"), ("COLUMNS", "30"), ("LINES", "25")):
        monkeypatch.setenv(name, value)
    Printer("table").table([{"agent": "gateway", "task": "BatteryWatchdog" * 2}], ("agent", "task"))
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
        Printer("table").table([{"value": value}], ["value"])
        assert capsys.readouterr().out.splitlines()[-2].strip() == text


def test_output_section_has_its_control_characters_escaped(capsys):
    Printer("table").emit(None, {"last failure": "RuntimeError: bang \x1b]0;owned\x07\nand more"})
    shown = capsys.readouterr().out
    assert "\x1b" not in shown.replace("\x1b[1m", "").replace("\x1b[0m", "") and "\x07" not in shown
    assert "bang \\x1b]0;owned\\x07" in shown


def test_output_of_a_generator_runs_only_for_people(capsys: pytest.CaptureFixture[str]):
    def parts() -> Iterator[Part]:
        ran.append(True)
        yield from ("a sentence", Rows([{"x": 1}], ["x"]), {"about": {"y": None}})

    ran: list[bool] = []
    Printer("json").emit([1], parts())
    assert (json.loads(capsys.readouterr().out), ran) == ([1], [])
    Printer("table").emit([1], parts())
    shown = capsys.readouterr().out.splitlines()

    assert ran and shown[0] == "a sentence" and shown[-1].split() == ["y", "-"]


def test_output_for_people_is_not_in_json(capsys: pytest.CaptureFixture[str]):
    for format_ in ("table", "json"):
        Printer(format_).note("on its way")
        Printer(format_).tell("only for people")
        shown = capsys.readouterr()
        expected = ("on its way\nonly for people\n", "") if format_ == "table" else ("", "on its way\n")

        assert (shown.out, shown.err) == expected
