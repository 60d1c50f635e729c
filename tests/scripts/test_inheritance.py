"""A service or a task stands two levels below `Component`, so that few other classes are to be read with it.

What several tasks of one kind have in common may lie between.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = [ROOT / "pancakes", *sorted(path.parent for path in ROOT.glob("plugins/*/*/__init__.py"))]
IN_COMMON = {"AdjustingTask", "DrivingTask", "LogWriter", "RowFile"}
"""What several tasks of one kind have in common."""


def levels(bases: Mapping[str, list[str]]) -> dict[str, int]:
    """Returns how many levels each class stands below `Component`; those that do not are left out."""
    found = {"Component": 0}
    while more := {
        name: 1 + max(found[base] for base in above if base in found)
        for name, above in bases.items()
        if name not in found and any(base in found for base in above)
    }:
        found |= more
    return found


def bases_of(source: str) -> dict[str, list[str]]:
    """Returns the bases of each class in a module, without parameters of types."""
    classes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef)]
    return {cls.name: [ast.unparse(base).partition("[")[0] for base in cls.bases] for cls in classes}


def test_levels_are_counted_by_way_of_all_bases() -> None:
    source = "class Task(Component): ...\nclass A(Other, Task): ...\nclass B(A[int]): ...\nclass C(Other): ..."
    assert levels(bases_of(source)) == {"Component": 0, "Task": 1, "A": 2, "B": 3}


def test_no_class_stands_deeper_than_what_tasks_of_one_kind_have_in_common() -> None:
    bases: dict[str, list[str]] = {}
    for package in PACKAGES:
        for path in package.rglob("*.py"):
            bases |= bases_of(path.read_text(encoding="utf-8"))
    found = levels(bases)
    assert {"Root", "ClientService", "TaskMigrator", "Trajectory", "ScanTarget"} <= set(found)
    assert {name for name, level in found.items() if level > 2 and not IN_COMMON & set(bases[name])} == set()
    assert {name: found[name] for name in IN_COMMON} == dict.fromkeys(IN_COMMON, 2)
