"""No circle of imports, and one of imports for types alone joins two files at most."""

from __future__ import annotations

import ast
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = [ROOT / "pancakes", *sorted(path.parent for path in ROOT.glob("plugins/*/*/__init__.py"))]
PAIRS_OF_ONE_IDEA = [{"pancakes.runtime.kernel.component", "pancakes.runtime.kernel.kernel"}]
"""Pairs of files whose types name each other, because the two are one idea."""


def modules() -> dict[str, ast.Module]:
    """Returns the modules of all packages, by name."""
    found = {}
    for package in PACKAGES:
        for path in package.rglob("*.py"):
            parts = path.relative_to(package.parent).with_suffix("").parts
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            found[name] = ast.parse(path.read_text(encoding="utf-8"))
    return found


def is_for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")


def imported(node: ast.AST, known: Collection[str], types: bool) -> Iterator[str]:
    """Yields the known modules that a piece of code imports, also late; `types`: also those for types alone."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names if alias.name in known)
    elif isinstance(node, ast.ImportFrom) and node.module is not None:
        for alias in node.names:
            whole = f"{node.module}.{alias.name}"
            yield from (name for name in [whole if whole in known else node.module] if name in known)
    for child in ast.iter_child_nodes(node):
        if types or not is_for_types(node):
            yield from imported(child, known, types)


def graph(sources: Mapping[str, ast.Module], types: bool) -> dict[str, set[str]]:
    """Returns what each module imports."""
    return {name: set(imported(tree, sources, types)) - {name} for name, tree in sources.items()}


def circles(edges: Mapping[str, set[str]]) -> list[set[str]]:
    """Returns the largest sets of modules of which each imports each other, by way of others perhaps."""
    reached: dict[str, set[str]] = {}
    for name in edges:
        found, left = set[str](), [name]
        while left:
            new = edges[left.pop()] - found
            found |= new
            left.extend(new)
        reached[name] = found
    joined = {frozenset(other for other in reached[name] if name in reached[other]) for name in edges}
    return [set(circle) for circle in joined if circle]


def test_circles_are_found_with_types_and_without() -> None:
    sources = {
        "a": ast.parse("from b import x"),
        "b": ast.parse("def f():\n    import c"),
        "c": ast.parse("if TYPE_CHECKING:\n    from a import y\nimport d"),
        "d": ast.parse(""),
    }
    assert circles(graph(sources, types=True)) == [{"a", "b", "c"}]
    assert circles(graph(sources, types=False)) == []


def test_no_imports_form_a_circle() -> None:
    sources = modules()
    assert len(sources) > 400 and circles(graph(sources, types=False)) == []


def test_imports_for_types_alone_form_pairs_at_most() -> None:
    assert circles(graph(modules(), types=True)) == PAIRS_OF_ONE_IDEA
