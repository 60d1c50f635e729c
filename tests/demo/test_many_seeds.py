"""`pancakes demo NAME --virtual --seeds`: the same bytes as alone, a table of all, and what breaks breaks alone."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from click.testing import CliRunner, Result
from demo.broken_seeds import nothing, some_break
from demo.terminal import Terminal
from hypothesis import given
from hypothesis import strategies as st

from pancakes.tools.cli.main import pancakes
from pancakes.tools.demo.many_missions import MissionOutcome, fly_many
from pancakes.tools.demo.seed_ranges import seeds_of, text_of_seeds
from pancakes.tools.demo.spreads import Spread, spreads_of
from pancakes.tools.demo.unattended import MissionWishes

PASSED, FAILED, USAGE, BAD_CONFIGURATION, INTERRUPTED = 0, 1, 2, 4, 130
RESULTS = ("events.jsonl", "trajectory.csv", "summary.json")


def demo(*arguments: str | Path) -> Result:
    return CliRunner().invoke(pancakes, ["demo", *map(str, arguments)])


def flown(seeds: str, folder: Path, wishes: MissionWishes, jobs: int, prepare=nothing) -> dict[int, MissionOutcome]:
    return {it.seed: it for it in fly_many(seeds_of(seeds), folder, wishes, jobs, lambda: False, prepare)}


@pytest.mark.timeout(400)
@pytest.mark.parametrize(
    ("name", "seconds", "folders"),
    [("encirclement", 40.0, ("",)), ("rescue", 180.0, ("",)), ("energy", 20.0, ("plain", "thresholds", "feedback"))],
)
def test_among_many_a_mission_writes_the_same_bytes_as_alone(name, seconds, folders, tmp_path: Path):
    alone = tmp_path / "alone"
    demo(name, "--virtual", "--seed", "5", "--duration", seconds, "--out", alone)
    wishes = MissionWishes(name, seconds)
    one_after_the_other = flown("4-5", tmp_path / "queue", wishes, 1)
    beside_each_other = flown("5-6", tmp_path / "beside", wishes, 2)
    for outcomes in (one_after_the_other, beside_each_other):
        assert {outcome.verdict for outcome in outcomes.values()} <= {"PASS", "FAIL"}
        for path in [Path(folder, result) for folder in folders for result in RESULTS] + [Path("summary.json")]:
            assert (outcomes[5].out / path).read_bytes() == (alone / path).read_bytes(), path
    other = one_after_the_other[4].out / folders[0] / "trajectory.csv"
    assert other.read_bytes() != (alone / folders[0] / "trajectory.csv").read_bytes()


def test_the_table_has_verdicts_spreads_and_how_to_run_again_what_failed(tmp_path: Path):
    arguments = ("encirclement", "--virtual", "--seeds", "1-3", "--duration", "30", "--set", "agent1:clock.speed=1")
    shown = demo(*arguments, "--out", tmp_path / "out")
    assert shown.exit_code == FAILED
    assert "FAIL             3   1-3" in shown.stdout
    assert "homes.agent1.x_m" in shown.stdout and "median" in shown.stdout and "collisions" not in shown.stdout
    assert "  - ScanTarget never moved: agent1 held it to the end" in shown.stdout
    again = "pancakes demo encirclement --virtual --seed 2 --duration 30 --set agent1:clock.speed=1"
    assert f"  run again: {again}\n" in shown.stdout
    kept = json.loads((tmp_path / "out" / "missions.json").read_text())
    told = demo(*arguments, "--format", "json", "--out", tmp_path / "out")
    assert json.loads(told.stdout) == kept
    assert [it["again"] for it in kept["failed"]][1] == again
    assert kept["verdicts"] == [{"verdict": "FAIL", "missions": 3, "seeds": "1-3"}]
    spread = next(it for it in kept["spreads"] if it["figure"] == "homes.agent1.x_m")
    assert spread["missions"] == 3 and spread["min"] < spread["median"] < spread["max"]


def test_a_mission_that_passes_passes(tmp_path: Path):
    shown = demo("encirclement", "--virtual", "--seeds", "1", "--headless", "--out", tmp_path)
    assert shown.exit_code == PASSED
    assert "PASS             1   1" in shown.stdout and "run again" not in shown.stdout
    assert shown.stderr == "seed 1: PASS\n"


def test_what_breaks_in_one_mission_ends_no_other(tmp_path: Path, capfd):
    outcomes = flown("1-8", tmp_path, MissionWishes("encirclement"), 2, some_break)
    assert {seed: outcome.verdict for seed, outcome in outcomes.items()} == {
        1: "PASS", 2: "PASS", 3: "ERROR", 4: "ERROR", 5: "ERROR", 6: "PASS", 7: "PASS", 8: "PASS"
    }  # fmt: skip
    assert outcomes[3].reasons == (
        "its process was ended by SIGKILL: is there enough memory? --jobs runs fewer at once",
    )
    assert outcomes[4].reasons == ("its process ended with exit code 7",)
    assert outcomes[5].reasons[0].startswith("ZeroDivisionError: by hand")
    assert capfd.readouterr().out == ""
    assert psutil.Process().children() == [] or all(
        "resource_tracker" in " ".join(child.cmdline()) for child in psutil.Process().children()
    )


def test_ctrl_c_ends_all_processes_and_shows_what_there_is(tmp_path: Path):
    command = [sys.executable, "-m", "pancakes.tools.cli.main", "demo", "encirclement", "--virtual", "--headless"]
    process = subprocess.Popen(
        [*command, "--seeds", "1-5000", "--duration", "20", "--jobs", "2", "--out", str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stderr is not None
    assert process.stderr.readline().startswith("seed ")
    below = psutil.Process(process.pid).children(recursive=True)
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == INTERRUPTED
    assert "of 5000 missions were run" in err and "Traceback" not in out + err
    assert "Verdicts" in out and (tmp_path / "missions.json").exists()
    assert psutil.wait_procs(below, timeout=30)[1] == []


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--seeds", "5-1"], USAGE, "'5-1' ends before it begins: write 1-5"),
        (["--seeds", "x"], USAGE, "'x' is no range of seeds: write seeds as 1-200, or as 3,17,20-29"),
        (["--seeds", "1,,2"], USAGE, "is no range of seeds"),
        (["--seeds", "-3"], USAGE, "is no range of seeds"),
        (["--seeds", "1-9999999"], USAGE, "names more than 100,000 seeds"),
        (["--seeds", "1-" + "9" * 60], USAGE, "more than 18 digits"),
        (["--seeds", "1-2", "--seed", "3"], USAGE, "--seed and --seeds do not go together"),
        (["--seeds", "1-2", "--view"], USAGE, "--view shows one mission"),
        (["--seeds", "1-2", "--live"], USAGE, "--seeds needs --virtual"),
        (["--jobs", "2"], USAGE, "they need --seeds"),
        (["--format", "json"], USAGE, "they need --seeds"),
        (["--seeds", "1-2", "--jobs", "0"], USAGE, "'--jobs'"),
        (["--seeds", "1-2", "--set", "clock.sped=1"], BAD_CONFIGURATION, "[clock] sped: unknown key"),
    ],
    ids=lambda value: " ".join(value)[:40] if isinstance(value, list) else None,
)
def test_a_mistake_gets_a_sentence_and_nothing_is_started(arguments, code, said, tmp_path: Path):
    result = demo("encirclement", "--virtual", *arguments, "--out", tmp_path / "out")
    assert said in result.output
    assert "Traceback" not in result.output and result.exit_code == code
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_used_is_named(tmp_path: Path):
    (tmp_path / "file").write_text("")
    result = demo("encirclement", "--virtual", "--seeds", "1-2", "--out", tmp_path / "file" / "out")
    assert f"the output folder {tmp_path / 'file' / 'out'} cannot be used" in result.output


@given(st.sets(st.integers(0, 300), min_size=1))
def test_seeds_are_read_as_they_are_written(seeds: set[int]):
    assert seeds_of(text_of_seeds(seeds)) == tuple(sorted(seeds))


def test_seeds_come_once_and_in_order():
    assert seeds_of("7, 1-3,2-4") == (1, 2, 3, 4, 7)
    assert text_of_seeds((7, 1, 2, 3, 4)) == "1-4,7"


def test_a_spread_is_of_the_missions_that_have_the_figure():
    one = {"seed": 1, "duration_s": 9.0, "gap_s": None, "laps": 3, "error_m": {"mean": 0.5}, "parts": [1], "ok": True}
    other = {"seed": 2, "duration_s": 9.0, "gap_s": 0.25, "laps": 3, "error_m": {"mean": 1.0}}
    assert spreads_of([one, other, {}]) == [
        Spread("laps", 2, 3, 3, 3),
        Spread("error_m.mean", 2, 0.5, 0.75, 1.0),
        Spread("gap_s", 1, 0.25, 0.25, 0.25),
    ]
    assert [spread.differs for spread in spreads_of([one, other])] == [False, True, False]


def test_a_bar_on_a_terminal_counts_the_missions_and_goes_away(tmp_path: Path):
    arguments = ("--seeds", "1-3", "--jobs", "1", "--duration", "20", "--out", str(tmp_path / "out"))
    with Terminal(40, 100, "demo", "encirclement", "--virtual", *arguments) as terminal:
        screens = terminal.screens_until("run again: pancakes demo encirclement --virtual --seed 3")
    assert any("1/3 1 failed" in screen for screen in screens)
    assert "/3" not in screens[-1] and "FAIL             3   1-3" in screens[-1]
