"""What is wrong with a command line, or with a demo's files, gets a sentence and an exit code; nothing is started."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from pancakes.tools.cli.main import pancakes

USAGE, REFUSED, BAD_CONFIGURATION = 2, 1, 4


def demo(*arguments: str | Path) -> Result:
    return CliRunner().invoke(pancakes, ["demo", *map(str, arguments)])


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


@pytest.mark.parametrize("mode", ["--virtual", "--headless"])
@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["encirclment"], USAGE, "unknown demo 'encirclment', did you mean 'encirclement'?"),
        (["encirclement", "--configs", "nowhere/at/all"], USAGE, "Directory 'nowhere/at/all' does not exist"),
        (["encirclement", "--speed", "0"], USAGE, "'--speed'"),
        (["encirclement", "--seed", "-1"], USAGE, "'--seed'"),
        (["encirclement", "--duration", "0"], USAGE, "'--duration'"),
        (["encirclement", "--set", "clock.sped=1"], BAD_CONFIGURATION, "[clock] sped: unknown key"),
        (["encirclement", "--set", "nonsense"], BAD_CONFIGURATION, "nonsense"),
        (
            ["encirclement", "--set", "agent3:clock.speed=1"],
            BAD_CONFIGURATION,
            "agent3: is none of the agents world, agent1, agent2, sensor, did you mean 'agent",
        ),
        (
            ["encirclement", "--set", "agent1:task.ScanTarget.settings.radius=1"],
            BAD_CONFIGURATION,
            "[task.ScanTarget] settings.radius: unknown key",
        ),
        (
            ["encirclement", "--set", "agent1:task.ScanTarget.settings.radius_m=-1"],
            BAD_CONFIGURATION,
            "settings.radius_m: expected a number > 0, not -1",
        ),
        (["encirclement", "--set", "agent1:device.motors.driver=sim.wheels"], BAD_CONFIGURATION, "sim.wheels"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else None,
)
def test_a_mistake_gets_a_sentence(mode: str, arguments: list[str], code: int, said: str, out: Path) -> None:
    result = demo(*arguments, mode, "--out", out)
    assert said in result.output
    assert "Traceback" not in result.output and "defect" not in result.output
    assert result.exit_code == code
    assert not out.exists()


def test_faults_of_the_network_need_a_virtual_one(out: Path) -> None:
    result = demo("encirclement", "--faults", "--out", out)
    assert result.exit_code == USAGE and "--virtual" in result.output


def test_a_demo_with_leases_is_not_run_faster_than_they_are(out: Path) -> None:
    result = demo("rescue", "--live", "--headless", "--speed", "12.5", "--out", out)
    assert result.exit_code == USAGE and not out.exists()
    assert "the demo 'rescue' runs at 12 mission seconds a second at most, not at 12.5" in result.output


def test_an_output_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    out = tmp_path / "file" / "out"
    result = demo("encirclement", "--virtual", "--out", out)
    assert result.exit_code == REFUSED
    assert result.output == f"the output folder {out} cannot be used: Not a directory\n"


def test_an_output_folder_that_is_a_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    result = demo("encirclement", "--virtual", "--out", tmp_path / "file")
    assert result.exit_code == USAGE and "is a file" in result.output


def test_a_folder_without_the_agents_files_is_named(tmp_path: Path, out: Path) -> None:
    result = demo("encirclement", "--virtual", "--configs", tmp_path, "--out", out)
    assert result.exit_code == BAD_CONFIGURATION
    assert f"{tmp_path / 'world.toml'}: file: there is no such file" in result.output


def test_all_mistakes_of_a_file_are_told_with_their_lines(tmp_path: Path, out: Path) -> None:
    source = Path(__file__).parents[2] / "configs" / "encirclement"
    for path in source.iterdir():
        (tmp_path / path.name).write_text(path.read_text(encoding="utf-8"), encoding="utf-8")
    broken = tmp_path / "agent1.toml"
    text = broken.read_text(encoding="utf-8").replace("alpha_per_m", "alpha").replace("sim.sonar", "sim.sonnar")
    broken.write_text(text, encoding="utf-8")
    lines = text.splitlines()
    result = demo("encirclement", "--virtual", "--configs", tmp_path, "--out", out)
    assert result.exit_code == BAD_CONFIGURATION
    for word, meant in (("sim.sonnar", "sim.sonar"), ("alpha", "alpha_per_m")):
        number = next(number for number, line in enumerate(lines, 1) if word in line)
        (told,) = [line for line in result.output.splitlines() if line.startswith(f"{broken}:{number}: ")]
        assert f"did you mean {meant!r}?" in told


def test_the_demos_are_listed() -> None:
    result = demo("--list")
    assert result.exit_code == 0
    listed = [line.split()[0] for line in result.output.splitlines()]
    known = {"encirclement", "energy", "intruder", "pioneer", "rescue", "sensor-field"}
    assert listed == sorted(listed) and known <= set(listed)
