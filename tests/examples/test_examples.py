"""Each example prints what its docstring says, and each how-to page shows examples as they are."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path

import pytest
from harness.programs import run

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
PAGES = sorted((ROOT / "docs" / "how-to").glob("*.md"))
PUBLIC = {
    "client",
    "control",
    "devices",
    "errors",
    "events",
    "migration",
    "packet",
    "request",
    "service",
    "settings",
    "task",
}
PUBLIC |= {"gym", "simulation", "testing", "trees", "worlds"}
LIMIT_S = 60.0


def said(example: Path) -> str:
    """Returns what an example prints, as its docstring has it."""
    text = ast.get_docstring(ast.parse(example.read_text()), clean=False) or ""
    command = f"$ python examples/{example.name}\n"
    assert text.count(command) == 1, f"the docstring of {example.name} does not show {command.strip()}"
    return text.partition(command)[2]


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda it: it.stem)
def test_example_prints_what_it_says(example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    done = run([sys.executable, "-m", f"examples.{example.stem}"], timeout_s=LIMIT_S, cwd=ROOT)
    assert (done.stdout, done.stderr, done.returncode) == (said(example), "", 0)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda it: it.stem)
def test_example_imports_only_what_is_public(example: Path) -> None:
    for node in ast.walk(ast.parse(example.read_text())):
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        names += [it.name for it in node.names] if isinstance(node, ast.Import) else []
        for name in names:
            package, _, module = name.partition(".")
            assert package != "pancakes" or not module or module in PUBLIC, f"{example.name} imports {name}"


def blocks(page: Path) -> list[tuple[str, str]]:
    """Returns the fenced blocks of a page: what stands behind the fence, and the text."""
    return re.findall(r"^```([^\n]*)\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda it: it.stem)
def test_how_to_page_shows_examples_as_they_are(page: Path) -> None:
    """A block of Python is an example without its docstring; the output follows, and a link names the file."""
    found = blocks(page)
    shown = 0
    for number, (language, code) in enumerate(found):
        if language != "python":
            continue
        linked = re.findall(r"\[`examples/(\w+\.py)`\]\(\.\./\.\./examples/\1\)", page.read_text())
        example = next((it for it in EXAMPLES if it.name in linked and body(it) == code), None)
        assert example is not None, f"{page.name}: this code is no example that the page links to:\n{code}"
        assert found[number + 1] == ("text", said(example)), f"{page.name}: the output of {example.name} differs"
        shown += 1
    assert shown, f"{page.name} shows no example"


def body(example: Path) -> str:
    """Returns an example without its docstring."""
    return example.read_text().partition('"""')[2].partition('"""\n')[2].lstrip("\n")


def test_every_example_is_on_the_page_of_examples() -> None:
    listed = re.findall(r"\[`(\w+\.py)`\]\(\1\)", (ROOT / "examples" / "README.md").read_text())
    assert sorted(listed) == [it.name for it in EXAMPLES]
