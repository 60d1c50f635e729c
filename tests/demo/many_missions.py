"""Many missions, each in one of several processes, as tests run them."""

from __future__ import annotations

from pathlib import Path

from click.testing import CliRunner, Result
from demo.broken_seeds import nothing

from pancakes.tools.cli.main import pancakes
from pancakes.tools.demo.monte_carlo import MissionOutcome, MissionWishes, fly_many
from pancakes.tools.demo.seed_statistics import seeds_of

RESULTS = ("events.jsonl", "trajectory.csv", "summary.json")


def demo(*arguments: str | Path) -> Result:
    return CliRunner().invoke(pancakes, ["demo", *map(str, arguments)])


def flown(seeds: str, folder: Path, wishes: MissionWishes, jobs: int, prepare=nothing) -> dict[int, MissionOutcome]:
    return {it.seed: it for it in fly_many(seeds_of(seeds), folder, wishes, jobs, lambda: False, prepare)}


def check_same_bytes(name: str, seconds: float, folders: tuple[str, ...], tmp_path: Path) -> None:
    """Checks that seed 5 writes the same bytes after another mission of its process, and beside one, as by itself."""
    alone = tmp_path / "alone"
    demo(name, "--virtual", "--seed", "5", "--duration", str(seconds), "--out", alone)
    wishes = MissionWishes(name, seconds)
    one_after_the_other = flown("4-5", tmp_path / "queue", wishes, 1)
    beside_each_other = flown("5-6", tmp_path / "beside", wishes, 2)
    for outcomes in (one_after_the_other, beside_each_other):
        assert {outcome.verdict for outcome in outcomes.values()} <= {"PASS", "FAIL"}
        for path in [Path(folder, result) for folder in folders for result in RESULTS] + [Path("summary.json")]:
            assert (outcomes[5].out / path).read_bytes() == (alone / path).read_bytes(), path
    other = one_after_the_other[4].out / folders[0] / "trajectory.csv"
    assert other.read_bytes() != (alone / folders[0] / "trajectory.csv").read_bytes()
