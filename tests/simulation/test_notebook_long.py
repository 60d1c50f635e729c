"""The notebook of the documentation runs, and prints what is kept of it."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import nbformat
import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "scripts" / "lib" / "notebook.py"


@pytest.fixture(scope="module")
def notebook() -> ModuleType:
    """The script's module; it is no part of any package."""
    spec = importlib.util.spec_from_file_location("notebook", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def cell(*texts: str) -> nbformat.NotebookNode:
    outputs = [nbformat.v4.new_output("stream", name="stdout", text=text) for text in texts]
    return nbformat.v4.new_code_cell("print()", outputs=outputs)


def test_notebook_prints_what_is_kept_of_it():
    done = subprocess.run([sys.executable, str(SCRIPT), "--check"], capture_output=True, text=True)
    # On a busy machine libzmq may say at the very end that a file descriptor of its own had nothing to read.
    said = [line for line in done.stderr.splitlines() if "src/signaler.cpp" not in line]
    assert (done.returncode, said) == (0, [])


def test_notebook_names_a_cell_that_prints_something_else(notebook):
    kept = nbformat.v4.new_notebook(cells=[cell("one\n"), cell("two\n", "three\n")])
    same = nbformat.v4.new_notebook(cells=[cell("one\n"), cell("two\nthree\n")])
    other = nbformat.v4.new_notebook(cells=[cell("one\n"), cell("two\n")])
    assert notebook.differences(kept, same) == []
    (text,) = notebook.differences(kept, other)
    assert text.startswith("cell 2 prints\ntwo\n")
    assert len(notebook.joined(kept.cells[1].outputs)) == 1


def test_notebook_run_ends_at_a_cell_that_fails(notebook):
    broken = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell("1 / 0")])
    with pytest.raises(notebook.CellExecutionError, match="ZeroDivisionError"):
        notebook.run(broken)
