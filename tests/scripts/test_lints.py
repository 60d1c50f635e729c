"""`scripts/lib/lints.py` finds the faults that it looks for, and nothing else."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "lib" / "lints.py"
LAYERS = ["pancakes.agent", "pancakes.kernel", "pancakes.task", "pancakes_x"]
KERNEL = "pancakes/kernel/a.py"
PLUGIN = "plugins/pancakes-x/pancakes_x/a.py"
TEST = "tests/kernel/test_a.py"
TASK = "class Task(Component[int]): ...\nclass Walk(base.Task): ...\n"


@pytest.fixture
def lints(monkeypatch):
    """The module, without the exceptions of the project."""
    spec = importlib.util.spec_from_file_location("lints", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "lints", module)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "MAY_ASK", {})
    monkeypatch.setattr(module, "MAY_CALL", {})
    return module


def lines(lints: ModuleType, path: str, text: str) -> list[int]:
    return [found.line for found in lints.findings([lints.Source(path, text)], LAYERS)]


@pytest.mark.parametrize(
    "asks",
    [
        "isinstance(it, Walk)",
        "isinstance(it, (str, Walk))",
        "isinstance(it, str | Walk)",
        "match it:\n  case Walk(): ...",
    ],
)
@pytest.mark.parametrize("path", [KERNEL, PLUGIN])
def test_lint_finds_an_actor_asked_for_its_type(lints, path, asks):
    assert len(lines(lints, path, f"{TASK}{asks}")) == 1


@pytest.mark.parametrize("asks", ["isinstance(it, str)", "isinstance(it, Walk.Settings)", "Walk(it)"])
def test_lint_allows_other_types_to_be_asked_for(lints, asks):
    assert lines(lints, KERNEL, f"{TASK}{asks}") == []
    assert lines(lints, TEST, f"{TASK}isinstance(it, Walk)") == [], "a test may look"


@pytest.mark.parametrize(
    "text",
    [
        "tell(it, lambda: 1)",
        "tell(it, Do(partial(f, 1)))",
        "self._kernel.tell(it, Do(lambda: 1))",
        "class Do:\n  what: Callable[[], None]\ntell(it, Do(f))",
        "class Do:\n  what: typing.Callable | None\ntell(it, Do(f))",
    ],
)
def test_lint_finds_a_function_in_a_message(lints, text):
    assert len(lines(lints, KERNEL, text)) == 1


@pytest.mark.parametrize(
    "text",
    [
        "tell(it, Do(1))",
        "file.tell()",
        "job.tell(1, lambda: 2)",
        "class Kept:\n  what: Callable\ntell(it, Do(1))",
    ],
)
def test_lint_allows_data_in_a_message(lints, text):
    assert lines(lints, KERNEL, text) == []


@pytest.mark.parametrize("call", ["self._table.find(1)", "found(1)", "self.find(1)", "rows[other.find(1)] = 2"])
def test_lint_finds_a_call_under_a_lock(lints, call):
    assert lines(lints, KERNEL, f"with self._lock:\n  if it:\n    {call}") == [3]


@pytest.mark.parametrize("call", ["rows.append(len(rows))", "self._find(1)", "Row(1)", "rows.sort()"])
def test_lint_allows_containers_under_a_lock(lints, call):
    assert lines(lints, KERNEL, f"with self._lock:\n  {call}") == []
    assert lines(lints, PLUGIN, "with self._lock:\n  other.find()") == [], "no table of actors is there"
    assert lines(lints, KERNEL, "with self._lock:\n  pass\nother.find()\nwith open(it) as file:\n  other.find()") == []


@pytest.mark.parametrize("path", ["pancakes/other.py", "pancakes/tasks.py", "plugins/pancakes-y/pancakes_y/a.py"])
def test_lint_finds_a_module_without_a_layer(lints, path):
    assert lines(lints, path, "") == [1]


@pytest.mark.parametrize("path", ["pancakes/task.py", KERNEL, PLUGIN, "pancakes/__init__.py"])
def test_lint_accepts_a_module_with_a_layer(lints, path):
    assert lines(lints, path, "") == []


@pytest.mark.parametrize(
    "text",
    [
        "from a import _b",
        "monkeypatch.setattr(a, '_b', None)",
        "monkeypatch.setattr('a._b', None)",
        "getattr(a, '_b')",
        "hasattr(a.c, '_b')",
    ],
)
@pytest.mark.parametrize("path", [TEST, "trials/soak/a.py"])
def test_lint_finds_a_private_name_in_a_test(lints, path, text):
    assert lines(lints, path, f"\n{text}") == [2]


def test_lint_allows_public_and_special_names(lints):
    text = "from a import __version__, b\ngetattr(b, '__slots__')\nsetattr(b, 'c_d', '_e')"
    assert lines(lints, TEST, text) == []
    assert lines(lints, KERNEL, "from a import _b") == [], "the product is left to ruff"


def test_lint_exception_excuses_only_its_own_finding(lints, monkeypatch):
    text = "with lock:\n  a.find()\n  b.find()"
    monkeypatch.setattr(lints, "MAY_CALL", {f"{KERNEL}: a": "it is pure"})
    assert lines(lints, KERNEL, text) == [3]


@pytest.mark.parametrize("table", ["MAY_ASK", "MAY_CALL"])
def test_lint_exception_that_excuses_nothing_is_found(lints, monkeypatch, table):
    monkeypatch.setattr(lints, table, {"pancakes/gone.py": "it was there once"})
    (found,) = lints.findings([lints.Source(KERNEL, "")], LAYERS)
    assert found.path == "scripts/lib/lints.py" and "pancakes/gone.py" in found.text


def test_lints_print_place_and_fail(lints, tmp_path, capsys):
    """The command reads all folders and the layers, prints a line for each finding, and ends with 1."""
    (tmp_path / "setup.cfg").write_text("[importlinter:contract:layers]\nlayers =\n    pancakes.a|pancakes.b\n")
    for folder in ("pancakes", "plugins", "tests", "trials"):
        (tmp_path / folder).mkdir()
    (tmp_path / "pancakes" / "b.py").write_text("")
    assert lints.main(tmp_path) == 0 and capsys.readouterr().out == ""
    (tmp_path / "pancakes" / "c.py").write_text("")
    (tmp_path / "tests" / "test_b.py").write_text("import b\nfrom b import _c\n")
    assert lints.main(tmp_path) == 1
    shown = capsys.readouterr().out.splitlines()
    assert [line.partition(": ")[0] for line in shown] == ["pancakes/c.py:1", "tests/test_b.py:2"]
