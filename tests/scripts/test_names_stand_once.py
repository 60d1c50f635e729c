"""One word, one meaning: no class and no file of a distribution has a name that another of it has."""

from __future__ import annotations

import ast
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = [ROOT / "pancakes", *sorted(path.parent for path in ROOT.glob("plugins/*/*/__init__.py"))]
MAY_STAND_TWICE = {
    "__init__.py": "Python demands it",
    "settings.py": "the settings of the package that it lies in",
}
VERBS = ROOT / "pancakes" / "tools" / "cli" / "verbs"
"""A verb's file bears the name of what it calls."""


def classes_of(source: str) -> list[str]:
    """Returns the classes that stand at the top of a module."""
    return [node.name for node in ast.parse(source).body if isinstance(node, ast.ClassDef)]


def repeated(named: Iterable[tuple[str, Path]]) -> dict[str, list[str]]:
    """Returns each name that several paths have, with these paths."""
    paths: dict[str, list[str]] = {}
    for name, path in named:
        paths.setdefault(name, []).append(str(path))
    return {name: found for name, found in paths.items() if len(found) > 1}


def test_a_name_that_stands_twice_is_found() -> None:
    sources = {Path("a.py"): "class A:\n    class B: ...\nclass C: ...", Path("b.py"): "class B: ...\nclass C: ..."}
    found = repeated((name, path) for path, source in sources.items() for name in classes_of(source))
    assert found == {"C": ["a.py", "b.py"]}


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_no_class_name_stands_twice(package: Path) -> None:
    found = repeated((name, path) for path in package.rglob("*.py") for name in classes_of(path.read_text()))
    assert found == {}


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.name)
def test_no_file_name_stands_twice(package: Path) -> None:
    paths = [path for path in package.rglob("*.py") if path.parent != VERBS and path.name not in MAY_STAND_TWICE]
    assert paths and repeated((path.name, path) for path in paths) == {}
