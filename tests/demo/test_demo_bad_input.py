"""What is wrong with a command line, or with a demo's files, gets a sentence and an exit code; nothing is started."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from pancakes.tools.cli.main import pancakes

USAGE, REFUSED, BAD_CONFIGURATION = 2, 1, 4


MISTAKES = [
    (("--configs", "nowhere/at/all"), USAGE, "nowhere/at/all"),
    (("--speed", "0"), USAGE, "'--speed'"),
    (("--seed", "-1"), USAGE, "'--seed'"),
    (("--duration", "0"), USAGE, "'--duration'"),
    (("--set", "clock.sped=1"), BAD_CONFIGURATION, "sped"),
    (("--set", "nonsense"), BAD_CONFIGURATION, "nonsense"),
    (("--set", "agent3:clock.speed=1"), BAD_CONFIGURATION, "agent3"),
    (("--set", "agent1:task.ScanTarget.settings.radius=1"), BAD_CONFIGURATION, "settings.radius"),
    (("--set", "agent1:task.ScanTarget.settings.radius_m=-1"), BAD_CONFIGURATION, "settings.radius_m"),
    (("--set", "agent1:device.motors.driver=sim.wheels"), BAD_CONFIGURATION, "sim.wheels"),
]


def demo(*arguments: str | Path) -> Result:
    return CliRunner().invoke(pancakes, ["demo", *map(str, arguments)])


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


@pytest.mark.parametrize("mode", ["--virtual", "--headless"])
def test_demo_refuses_a_mistake_before_anything_starts(mode: str, out: Path) -> None:
    """Each command line is refused with its exit code and a sentence that names the mistake."""
    accepted = []
    for words, code, said in MISTAKES:
        result = demo("encirclement", *words, mode, "--out", out)
        is_plain = "Traceback" not in result.output and "defect" not in result.output
        if result.exit_code != code or said not in result.output or not is_plain or out.exists():
            accepted.append((words, result.exit_code, result.output))
    assert accepted == []


def test_demo_suggests_the_name_of_a_demo(out: Path) -> None:
    result = demo("encirclment", "--out", out)
    assert result.exit_code == USAGE and "did you mean 'encirclement'?" in result.output and not out.exists()


def test_demo_refuses_faults_without_virtual_time(out: Path) -> None:
    result = demo("encirclement", "--faults", "--out", out)
    assert result.exit_code == USAGE and "--virtual" in result.output


def test_demo_refuses_control_without_a_live_page(out: Path) -> None:
    for words, said in ((("--control",), "--view"), (("--view", "--control", "--virtual"), "--virtual")):
        result = demo("encirclement", *words, "--out", out)
        assert result.exit_code == USAGE and said in result.output and not out.exists()


def test_demo_with_leases_refuses_a_higher_speed(out: Path) -> None:
    result = demo("rescue", "--live", "--headless", "--speed", "12.5", "--out", out)
    assert result.exit_code == USAGE and not out.exists()
    assert "'rescue'" in result.output and "12.5" in result.output


def test_demo_names_an_output_folder_it_cannot_make(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    out = tmp_path / "file" / "out"
    result = demo("encirclement", "--virtual", "--out", out)
    assert result.exit_code == REFUSED
    assert result.output == f"the output folder {out} cannot be used: Not a directory\n"


def test_demo_refuses_a_file_as_output_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    result = demo("encirclement", "--virtual", "--out", tmp_path / "file")
    assert result.exit_code == USAGE and "is a file" in result.output


def test_demo_names_a_missing_configuration(tmp_path: Path, out: Path) -> None:
    result = demo("encirclement", "--virtual", "--configs", tmp_path, "--out", out)
    assert result.exit_code == BAD_CONFIGURATION
    assert str(tmp_path / "world.toml") in result.output


def test_demo_reports_mistakes_of_files_with_lines(tmp_path: Path, out: Path) -> None:
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


def test_demo_list_has_all_demos() -> None:
    result = demo("--list")
    assert result.exit_code == 0
    listed = [line.split()[0] for line in result.output.splitlines()]
    known = {"encirclement", "energy", "intruder", "pioneer", "rescue", "sensor-field"}
    assert listed == sorted(listed) and known <= set(listed)
