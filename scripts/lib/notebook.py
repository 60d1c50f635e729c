"""Run docs/simulation.ipynb in a kernel of its own, and save the output of its cells.

With --check it writes nothing, names the cells whose output has changed, and ends with 1. Pictures may differ.
"""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from traitlets.config import Config

NOTEBOOK = Path(__file__).resolve().parents[2] / "docs" / "simulation.ipynb"
PATIENCE_S = 300


def main() -> None:
    """Run the notebook, and save or check it."""
    arguments = sys.argv[1:]
    if arguments not in ([], ["--check"]):
        print("usage: scripts/notebook [--check]", file=sys.stderr)
        sys.exit(2)
    kept = nbformat.read(NOTEBOOK, as_version=4)
    try:
        ran = run(kept)
    except CellExecutionError as error:
        plain = re.sub(r"\x1b\[[0-9;]*m", "", str(error))
        sys.exit(f"{NOTEBOOK.name}: a cell fails: {plain}")
    if not arguments:
        nbformat.write(ran, NOTEBOOK)
        return
    different = differences(kept, ran)
    for text in different:
        print(text, file=sys.stderr)
    if different:
        sys.exit("run scripts/notebook, and look at what has changed")


def run(notebook: Any) -> Any:
    """Run the notebook from top to bottom in an empty folder, and return the result.

    Raises:
        CellExecutionError: a cell fails.
    """
    fresh = nbformat.from_dict(notebook)
    with tempfile.TemporaryDirectory(prefix="pancakes-notebook-") as folder:
        # Its kernel uses Unix sockets in that folder, and no port.
        config = Config(KernelManager={"transport": "ipc", "ip": f"{folder}/kernel"})
        client = NotebookClient(fresh, config=config, kernel_name="python3", timeout=PATIENCE_S, record_timing=False)
        client.execute(cwd=folder)
    for cell in fresh.cells:
        if cell.cell_type == "code":
            cell["outputs"] = joined(cell.outputs)
    fresh.metadata.pop("language_info", None)  # the machine's Python version does not belong in the page
    return fresh


def joined(outputs: list[Any]) -> list[Any]:
    """Return the outputs of a cell, with consecutive pieces of text joined."""
    found: list[Any] = []
    for output in outputs:
        last = found[-1] if found else None
        if last is not None and output.output_type == last.output_type == "stream" and output.name == last.name:
            last["text"] += output.text
        else:
            found.append(output)
    return found


def differences(kept: Any, ran: Any) -> list[str]:
    """Return a text about each cell whose output differs from the saved one."""
    found = []
    for number, (before, after) in enumerate(zip(kept.cells, ran.cells, strict=True), 1):
        if before.cell_type == "code" and text_of(before) != text_of(after):
            found.append(f"cell {number} prints\n{text_of(after)}\ninstead of the saved\n{text_of(before)}")
    return found


def text_of(cell: Any) -> str:
    """Return the text output of a cell, including its last value."""
    parts = []
    for output in cell.outputs:
        if output.output_type == "stream":
            parts.append(output.text)
        elif "image/png" in output.get("data", {}):
            parts.append("(a picture)\n")
        else:
            parts.append(output.get("data", {}).get("text/plain", ""))
    return "".join(parts)


if __name__ == "__main__":
    main()
