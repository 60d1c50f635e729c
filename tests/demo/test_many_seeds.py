"""`--seeds` of `pancakes demo`: ranges of seeds, spreads of figures, and command lines that are refused."""

from __future__ import annotations

from pathlib import Path

from click.testing import CliRunner, Result
from hypothesis import given
from hypothesis import strategies as st

from pancakes.tools.cli.main import pancakes
from pancakes.tools.demo.seed_statistics import Spread, seeds_of, spreads_of, text_of_seeds

FAILED, USAGE, BAD_CONFIGURATION = 1, 2, 4
MISTAKES = [
    (["--seeds", "5-1"], USAGE, "'5-1' ends before it begins: write 1-5"),
    (["--seeds", "x"], USAGE, "'x' is not a range of seeds: write seeds as 1-200, or as 3,17,20-29"),
    (["--seeds", "1,,2"], USAGE, "is not a range of seeds"),
    (["--seeds", "-3"], USAGE, "is not a range of seeds"),
    (["--seeds", "1-9999999"], USAGE, "names more than 100,000 seeds"),
    (["--seeds", "1-" + "9" * 60], USAGE, "more than 18 digits"),
    (["--seeds", "1-2", "--seed", "3"], USAGE, "--seed and --seeds"),
    (["--seeds", "1-2", "--view"], USAGE, "--view"),
    (["--seeds", "1-2", "--live"], USAGE, "--virtual"),
    (["--jobs", "2"], USAGE, "--seeds"),
    (["--format", "json"], USAGE, "--seeds"),
    (["--seeds", "1-2", "--jobs", "0"], USAGE, "'--jobs'"),
    (["--seeds", "1-2", "--set", "clock.sped=1"], BAD_CONFIGURATION, "sped"),
]


def demo(*arguments: str | Path) -> Result:
    return CliRunner().invoke(pancakes, ["demo", *map(str, arguments)])


def test_seeds_refuse_a_mistake_before_anything_starts(tmp_path: Path):
    """Each command line is refused with its exit code and a sentence that names the mistake."""
    accepted = []
    for words, code, said in MISTAKES:
        result = demo("encirclement", "--virtual", *words, "--out", tmp_path / "out")
        is_refused = result.exit_code == code and said in result.output and "Traceback" not in result.output
        if not is_refused or (tmp_path / "out").exists():
            accepted.append((words, result.exit_code, result.output))
    assert accepted == []


def test_seeds_name_an_unusable_output_folder(tmp_path: Path):
    (tmp_path / "file").write_text("")
    result = demo("encirclement", "--virtual", "--seeds", "1-2", "--out", tmp_path / "file" / "out")
    assert str(tmp_path / "file" / "out") in result.output and result.exit_code == FAILED


@given(st.sets(st.integers(0, 300), min_size=1))
def test_seed_ranges_read_what_they_write(seeds: set[int]):
    assert seeds_of(text_of_seeds(seeds)) == tuple(sorted(seeds))


def test_seed_ranges_are_sorted_and_unique():
    assert seeds_of("7, 1-3,2-4") == (1, 2, 3, 4, 7)
    assert text_of_seeds((7, 1, 2, 3, 4)) == "1-4,7"


def test_spreads_cover_missions_that_have_the_figure():
    one = {"seed": 1, "duration_s": 9.0, "gap_s": None, "laps": 3, "error_m": {"mean": 0.5}, "parts": [1], "ok": True}
    other = {"seed": 2, "duration_s": 9.0, "gap_s": 0.25, "laps": 3, "error_m": {"mean": 1.0}}
    assert spreads_of([one, other, {}]) == [
        Spread("laps", 2, 3, 3, 3),
        Spread("error_m.mean", 2, 0.5, 0.75, 1.0),
        Spread("gap_s", 1, 0.25, 0.25, 0.25),
    ]
    assert [spread.differs for spread in spreads_of([one, other])] == [False, True, False]
