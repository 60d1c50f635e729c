"""Tests look from outside: none names a private attribute of the product, where ruff's SLF001 cannot see it either."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]
BY_NAME = ("setattr", "getattr", "hasattr", "delattr")


def is_private(name: object) -> bool:
    return isinstance(name, str) and name.startswith("_") and not name.startswith("__")


def private_names(source: str) -> list[tuple[int, str]]:
    """Returns each private name that is imported, or that stands in a string as the name of an attribute."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            found += [(node.lineno, alias.name) for alias in node.names if is_private(alias.name)]
        if not isinstance(node, ast.Call):
            continue
        called = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        if called in BY_NAME:
            texts = [text.value for text in node.args[:2] if isinstance(text, ast.Constant)]
            names = [text.rpartition(".")[2] for text in texts if isinstance(text, str)]
            found += [(node.lineno, name) for name in names if is_private(name)]
    return found


@pytest.mark.parametrize(
    "source",
    [
        "from a import _b",
        "monkeypatch.setattr(a, '_b', None)",
        "monkeypatch.setattr('a._b', None)",
        "getattr(a, '_b')",
        "hasattr(a.c, '_b')",
    ],
)
def test_private_names_are_found(source: str) -> None:
    assert private_names(source) == [(1, "_b")]


def test_public_and_special_names_are_not() -> None:
    assert private_names("from a import __version__, b; getattr(b, '__slots__'); setattr(b, 'c_d', '_e')") == []


def test_no_test_names_a_private_attribute() -> None:
    files = list(TESTS.rglob("*.py"))
    found = [f"{path}:{line}: {name}" for path in files for line, name in private_names(path.read_text())]
    assert len(files) > 100 and found == []
