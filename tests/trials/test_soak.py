"""`scripts/soak`: its judgement of made-up series, and a short run in virtual time."""

from __future__ import annotations

import json
import os
import random
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from soak import __main__ as command
from soak.agents import Fleet, NotInTimeError, names_of
from soak.judgement import MORE_PIECES, Sample, leaks, lost_pieces, memory_fault, shown, trend
from soak.vitals import Vitals, vitals_of

HOUR_S = 3600.0


def test_soak_in_virtual_time_passes(program: Any, tmp_path: Path) -> None:
    """By the real command."""
    path = tmp_path / "figures.json"
    ended = program("soak", "--virtual", "--agents", "12", "--minutes", "0.25", "--json", path)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    figures = json.loads(path.read_text())
    assert (figures["moved"], figures["links"], figures["seed"], figures["passed"]) == (12, 12 * 11, 1, True)


def test_soak_exit_code_tells_of_faults(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Options without effect, and a file that cannot be written, are refused at once."""

    def run(*options: str) -> int:
        return CliRunner().invoke(command.soak, list(options)).exit_code

    monkeypatch.setattr(command, "steady_figures", lambda *_: ({}, ["a lost b"]))
    assert run("--steady") == 1
    monkeypatch.setattr(command, "steady_figures", lambda *_: ({}, []))
    assert run("--steady") == 0
    monkeypatch.setattr(command, "names_of", None)  # a fleet that is made all the same fails
    monkeypatch.setattr(command, "virtual_figures", None)
    refused = [["--steady", "--virtual"], ["--steady", "--leak", "1"], ["--virtual", "--leak", "1"]]
    refused += [["--steady", "--seed", "1"], ["--json", f"{tmp_path}/none/figures.json"], ["--json", str(tmp_path)]]
    assert [run(*options) for options in refused] == [2] * 6


def test_soak_names_agents_that_end_by_themselves(tmp_path: Path) -> None:
    with Fleet(tmp_path, names_of(2), {"a001": "[task.None]\ntype = 7\n"}) as fleet:
        fleet.start()
        with pytest.raises(NotInTimeError, match="a001 ended by itself"):
            fleet.until(fleet.is_full_mesh, "all meet")


def series(length_s: float, mib_per_h: float = 0.0, noise_mib: float = 0.0) -> list[Sample]:
    """Return samples of memory over time, one every five seconds."""
    draw = random.Random(1)
    return [
        Sample(time_s, vitals(int(1024 * (25 + mib_per_h * time_s / HOUR_S + draw.uniform(-noise_mib, noise_mib)))))
        for time_s in [5.0 * number for number in range(int(length_s / 5) + 1)]
    ]


def vitals(rss_kib: int = 25_000, threads: int = 7, sockets: int = 6, files: int = 8) -> Vitals:
    return Vitals(rss_kib, rss_kib, threads, sockets, files)


def test_soak_judges_the_growth_of_memory() -> None:
    """Over an hour by the slope; over minutes by the growth, as noise hides the slope. Outliers do not count."""
    points = [(sample.time_s, sample.vitals.rss_kib / 1024) for sample in series(HOUR_S, 2.0, noise_mib=3.0)]
    assert trend(points).per_hour == pytest.approx(2.0, abs=0.5)
    outliers = {0: 1.0, 3: 1.0, 598: 90.0, 599: 90.0}
    assert trend([(float(second), outliers.get(second, 25.0)) for second in range(600)]).per_hour == 0.0
    for mib_per_h, is_well in {0.0: True, 0.8: True, 1.2: False, 30.0: False}.items():
        fault, found = memory_fault("a", series(HOUR_S - 600, mib_per_h, noise_mib=0.2))
        assert (fault == "") is is_well and found is not None, mib_per_h
        assert found.per_hour == pytest.approx(mib_per_h, abs=0.1)
    for mib_per_h, is_well in {6.0: True, 15.0: True, 30.0: False}.items():
        fault, found = memory_fault("a", series(300, mib_per_h))
        assert (fault == "") is is_well and found is not None, mib_per_h
        assert found.growth == pytest.approx(mib_per_h / 12, abs=0.05)
    fault, found = memory_fault("a", series(10))
    assert fault and found is None, "a process that was hardly looked at has not passed"
    assert "1 MiB/h" in shown(HOUR_S - 600) and "30 MiB/h" in shown(240)


def test_soak_judges_what_is_held_at_rest() -> None:
    """By memory blocks, threads, sockets and files; the least of several samples counts."""
    before = Sample(0.0, vitals(), workers=1, state_files=6, pieces=150_000)
    assert lost_pieces("a", before, Sample(9.0, vitals(), pieces=150_000 + MORE_PIECES)) == ""
    assert lost_pieces("a", before, Sample(9.0, vitals(), pieces=157_000))
    assert lost_pieces("a", before, Sample(9.0, vitals())), "it was never collected"
    looks = (
        Sample(0.0, vitals(threads=7, sockets=9), workers=1, pieces=0),
        Sample(2.0, vitals(threads=9, sockets=6), workers=1, pieces=150_400),
        Sample(4.0, vitals(threads=8, sockets=7), workers=1, pieces=150_900),
    )
    least = looks[0].least(looks[1]).least(looks[2])
    assert (least.vitals.threads, least.vitals.sockets, least.pieces, least.time_s) == (7, 6, 150_400, 4.0)
    after = Sample(9.0, vitals(threads=9, sockets=7, files=10), workers=2, state_files=9)
    assert leaks("a", before, after, records=8) == [
        "a: 9 threads, at most 8 are allowed",
        "a: 7 sockets, at most 6 are allowed",
        "a: 8 other open files, at most 7 are allowed",
        "a: 9 files in its state directory, at most 8 are allowed",
    ]
    # The file of a task that has come is no leak, nor is the second worker of a pool.
    before = Sample(0.0, vitals(), workers=0, state_files=6)
    after = Sample(9.0, vitals(threads=8, sockets=5, files=10), workers=2, state_files=8)
    assert leaks("a", before, after, records=8) == []
    here = vitals_of(os.getpid())
    with Path("/proc/self/stat").open():
        more = vitals_of(os.getpid())
    assert (more.files, more.sockets) == (here.files + 1, here.sockets)
