"""The examples of docs/testing.md, as they stand there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

GUIDE = Path(__file__).parents[2] / "docs" / "testing.md"


def test_the_examples_of_the_guide_run(pytester: pytest.Pytester):
    text = GUIDE.read_text(encoding="utf-8")
    examples = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    pytester.makepyfile(test_guide="\n\n".join(examples))
    count = len(re.findall(r"^def test_", "\n".join(examples), re.MULTILINE))
    assert count > 10
    # `any_agent` runs its test twice.
    pytester.runpytest_subprocess("-W", "error", "--strict-markers").assert_outcomes(passed=count + 1)


def test_the_guide_names_every_fixture_and_option(pytester: pytest.Pytester):
    listed = pytester.runpytest_subprocess("--fixtures", "-q").stdout.str()
    fixtures = re.findall(r"^(\w+) -- .*pancakes.pytest_plugin\.py", listed.replace("/", "."), re.MULTILINE)
    text = GUIDE.read_text(encoding="utf-8")
    assert len(fixtures) == 8
    assert [name for name in fixtures if f"| `{name}` |" not in text] == []
    assert "--pancakes-seed " in text and "--pancakes-seeds " in text


KNOWN = "from pathlib import Path\nfrom pancakes.task import Task, Tick, every, on, reliable\n\n"
"""What the guides use in later examples without importing it once more."""


@pytest.mark.parametrize(
    ("guide", "package", "modules"), [("writing-a-task", "loadwatch", 7), ("writing-a-driver", "nightlight", 5)]
)
def test_the_examples_of_the_other_guides_run(
    pytester: pytest.Pytester, monkeypatch, guide: str, package: str, modules: int
):
    """A block of Python belongs to the file of the package that was named last; the one with tests is a test module."""
    text = (GUIDE.parent / f"{guide}.md").read_text(encoding="utf-8")
    files: dict[str, str] = {f"{package}/__init__.py": ""}
    file = ""
    for found in re.finditer(rf"`({package}/\w+\.py)`|^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        if found[1]:
            file = found[1]
        elif not found[2].startswith("self."):
            name = f"test_{package}.py" if "def test_" in found[2] else file
            files[name] = files.get(name, KNOWN) + found[2] + "\n\n"
    assert len(files) == modules
    for name, source in files.items():
        path = pytester.path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(source, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(pytester.path))
    count = files[f"test_{package}.py"].count("def test_")
    pytester.runpytest_subprocess("-W", "error").assert_outcomes(passed=count)
