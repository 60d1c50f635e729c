"""`pancakes demo NAME --virtual --seeds`: the same bytes as alone, a table of all, and what breaks breaks by itself."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from pathlib import Path

import psutil
from demo.broken_seeds import some_break
from demo.many_missions import RESULTS, demo, flown
from harness.programs import Program, pancakes

from pancakes.tools.demo.monte_carlo import MissionWishes

FAILED, INTERRUPTED = 1, 130


def test_seeds_table_has_verdicts_spreads_and_commands(tmp_path: Path):
    """What is printed and kept of three missions, each of which writes the same bytes as when it is run alone."""
    arguments = ("--virtual", "--duration", "10", "--set", "agent1:clock.speed=1")
    shown = demo("encirclement", *arguments, "--seeds", "1-3", "--jobs", "2", "--out", tmp_path / "out")
    assert shown.exit_code == FAILED
    assert "FAIL             3   1-3" in shown.stdout
    assert "homes.agent1.x_m" in shown.stdout and "median" in shown.stdout and "collisions" not in shown.stdout
    assert "  - ScanTarget never moved" in shown.stdout
    again = "pancakes demo encirclement --virtual --seed 2 --duration 10 --set agent1:clock.speed=1"
    assert f"  run again: {again}\n" in shown.stdout
    kept = json.loads((tmp_path / "out" / "missions.json").read_text())
    assert [it["again"] for it in kept["failed"]][1] == again
    assert kept["verdicts"] == [{"verdict": "FAIL", "missions": 3, "seeds": "1-3"}]
    spread = next(it for it in kept["spreads"] if it["figure"] == "homes.agent1.x_m")
    assert spread["missions"] == 3 and spread["min"] < spread["median"] < spread["max"]

    demo("encirclement", *arguments, "--seed", "3", "--out", tmp_path / "alone")
    for name in RESULTS:
        (among_many,) = tmp_path.glob(f"out/*3/{name}")
        assert among_many.read_bytes() == (tmp_path / "alone" / name).read_bytes(), name


def test_seeds_print_as_json_what_they_keep(tmp_path: Path):
    told = demo("encirclement", "--virtual", "--duration", "1", "--seeds", "1", "--format", "json", "--out", tmp_path)
    assert told.exit_code == FAILED
    assert json.loads(told.stdout) == json.loads((tmp_path / "missions.json").read_text())


def test_seeds_survive_missions_that_break(tmp_path: Path, capfd):
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
    others = ("resource_tracker", "harness.forked_program")
    left = [" ".join(child.cmdline()) for child in psutil.Process().children()]
    assert [command for command in left if not any(other in command for other in others)] == []


def test_seeds_end_at_ctrl_c_with_results_so_far(tmp_path: Path):
    many = ("--seeds", "1-5000", "--duration", "5", "--jobs", "2", "--out", str(tmp_path))
    process = Program(
        pancakes("demo", "encirclement", "--virtual", "--headless", *many),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
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
