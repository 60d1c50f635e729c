"""`pancakes new`: the files that it writes work at once, and a bad name leaves nothing behind."""

from __future__ import annotations

import configparser
import importlib.metadata
import json
import os
import re
import subprocess
from pathlib import Path

import pytest
from cli.made_packages import made, new

from pancakes.errors import PancakesError
from pancakes.tools.cli.verbs import scaffold
from pancakes.tools.cli.verbs.scaffold import KINDS, LONGEST, File, Names, files_of, write

LONG = "abcdefghijklmnopqrstuvwxyzabcd"
WITHOUT = ("-p", "no:hypothesispytest")
"""What pytest loads here besides, and takes longer than the tests that were written."""


@pytest.mark.parametrize("kind", KINDS)
class TestWhatIsWritten:
    def test_created_tests_pass(self, kind, tmp_path, rig):
        made(kind, tmp_path, rig)
        tested = rig.run("-m", "pytest", "-q", "-W", "error", "-p", "no:cacheprovider", *WITHOUT, whole=True)
        assert tested.process.wait(60.0) == 0, tested.everything()
        assert re.search(r"\b[4-9] passed", tested.everything())

    def test_ruff_accepts_created_files_of_any_name(self, kind, tmp_path):
        ruff = pytest.importorskip("ruff")
        for name in ("ab", "wind-speed", LONG):
            assert new(kind, name, "--into", str(tmp_path)).exit_code == 0
        for command in (["check"], ["format", "--check", "--diff"]):
            found = subprocess.run(
                [ruff.find_ruff_bin(), *command, "--no-cache", "."], cwd=tmp_path, capture_output=True, text=True
            )
            assert found.returncode == 0, found.stdout

    def test_created_readme_lists_its_files(self, kind, tmp_path):
        dry = new(kind, "green-house", "--into", str(tmp_path), "--dry-run", "--format", "json")
        assert list(tmp_path.iterdir()) == []
        wet = new(kind, "green-house", "--into", str(tmp_path), "--format", "json")
        expected, written = json.loads(dry.stdout), json.loads(wet.stdout)
        assert [row["file"] for row in expected] == [row["file"] for row in written]
        assert {row["written"] for row in expected} == {False}
        assert {row["written"] for row in written} == {True}
        folder = tmp_path / "green-house"
        assert {row["file"] for row in written} == {str(path) for path in folder.rglob("*") if path.is_file()}

        readme = (folder / "README.md").read_text()
        named = re.findall(r"`((?:green_house|tests|configs)/[\w.]+|reading\.txt)`", readme)
        assert named
        assert all((folder / name).is_file() for name in named)
        python = {path.relative_to(folder).as_posix() for path in folder.rglob("*.py")}
        assert python - {"green_house/__init__.py"} <= set(named)


def test_new_has_a_purpose_for_every_template():
    paths = {file.path for kind in KINDS for file in files_of(kind, Names.of("package"))}
    assert paths == set(scaffold.PURPOSES)


def test_new_templates_are_installed_with_the_package():
    parser = configparser.ConfigParser()
    parser.read(Path(__file__).parents[2] / "setup.cfg")
    assert "templates/**/*.in" in parser["options.package_data"]["pancakes.tools.cli.verbs"]


def test_new_prints_the_next_commands(tmp_path):
    told = new("task", "scan_target", "--into", str(tmp_path)).stdout
    assert f"cd {os.path.relpath(tmp_path / 'scan-target')}\n" in told
    assert "pip install -e " in told
    assert "pancakes-agent --config configs/scan_target.toml\n" in told
    told = new("plugin", "other", "--into", str(tmp_path), "--dry-run").stdout
    assert "Nothing was written." in told
    assert "pip install" not in told


def test_new_makes_names_of_one_word():
    for text, *names in (
        ("scan_target", "scan-target", "scan_target", "ScanTarget"),
        ("scan-target", "scan-target", "scan_target", "ScanTarget"),
        ("ScanTarget", "scan-target", "scan_target", "ScanTarget"),
        ("scanTarget", "scan-target", "scan_target", "ScanTarget"),
        ("HTTPServer", "http-server", "http_server", "HTTPServer"),
        ("LED", "led", "led", "Led"),
        ("x2y", "x2y", "x2y", "X2y"),
        ("pancakes-garden", "pancakes-garden", "pancakes_garden", "PancakesGarden"),
    ):
        assert Names.of(text) == Names(*names)


BAD_NAMES = [
    ("2fast", "'2fast' is not a valid name: it must begin with a letter, and may have only the letters a to z,"),
    ("a--b", "is not a valid name"),
    ("_a", "is not a valid name"),
    ("a.b", "is not a valid name"),
    ("../up", "is not a valid name"),
    ("größe", "is not a valid name"),
    ("ab\n", "is not a valid name"),
    ("", "is not a valid name"),
    ("a", "a name must have 2 to 30 characters, and 'a' has 1"),
    ("a" * (LONGEST + 1), "has 31"),
    ("class", "'class' is a keyword of Python"),
    ("Match", "'match' is a keyword of Python"),
    ("none", "'none' is a keyword of Python"),
    ("random", "Python has a module called 'random'"),
    ("pancakes", "'pancakes' is reserved in Pancakes or its tools"),
    ("ctrl", "'ctrl' is reserved"),
    ("device", "'device' is reserved"),
    ("Sensor", "Pancakes has a class called Sensor: choose another name than 'sensor'"),
]


def test_new_refuses_a_bad_name_and_leaves_nothing(tmp_path):
    for text, why in BAD_NAMES:
        with pytest.raises(ValueError, match=re.escape(why)):
            Names.of(text)
        refused = new("task", "--into", str(tmp_path), "--", text)
        assert refused.exit_code == 2 and "Traceback" not in refused.stderr, text
    for kind, name, why in (
        ("task", "numpy", "a module called numpy is already installed here, in "),
        ("task", "pytest-timeout", "pytest_timeout"),
        ("driver", "sonar", "the packet type 'sonar' exists already: pancakes.devices.Sonar: choose another"),
    ):
        refused = new(kind, name, "--into", str(tmp_path))
        assert refused.exit_code == 1 and why in refused.stderr, "it would hide what is installed"
    refused = new("task", "scan_target", "--into", str(tmp_path / "nowhere"))
    assert refused.exit_code == 2 and "does not exist" in refused.stderr
    assert list(tmp_path.iterdir()) == []
    assert importlib.metadata.version("pancakes-agents")
    assert "is already installed here" in Names("pancakes-agents", "zz", "Zz").conflict("task")


def test_new_refuses_names_used_in_templates():
    """A user's class must not hide one that its own files import or define."""
    names = set()
    for kind in KINDS:
        for file in files_of(kind, Names.of("zz")):
            if file.path.endswith(".py"):
                for line in re.findall(r"^from (?!zz)[\w.]+ import (.+)$", file.text, re.MULTILINE):
                    names.update(line.split(", "))
                names.update(re.findall(r"^class (\w+)", file.text, re.MULTILINE))
                names.update(re.findall(r"^([A-Z]\w+) = ", file.text, re.MULTILINE))
    classes = {name for name in names if name[0].isupper() and not name.isupper() and not name.startswith("Zz")}
    assert classes == scaffold.named_in_templates()


def test_new_does_not_change_an_existing_folder(tmp_path):
    (tmp_path / "scan-target").mkdir()
    (tmp_path / "scan-target" / "precious").write_text("mine")
    for options in ((), ("--dry-run",)):
        refused = new("task", "ScanTarget", "--into", str(tmp_path), *options)
        assert refused.exit_code == 1
        assert refused.stderr == f"{tmp_path / 'scan-target'} exists already: nothing was written\n"
    with pytest.raises(PancakesError, match="/scan-target exists already"):
        write(tmp_path / "scan-target", [File("one.txt", "", "1")])  # it came to be meanwhile
    assert [path.name for path in tmp_path.rglob("*")] == ["scan-target", "precious"]


def test_new_leaves_nothing_after_a_failed_write(tmp_path):
    files = [File("one.txt", "", "1"), File("one.txt/two.txt", "", "2")]
    with pytest.raises(PancakesError, match=r"/made cannot be written: (Not a directory|File exists)"):
        write(tmp_path / "made", files)
    assert list(tmp_path.iterdir()) == []
