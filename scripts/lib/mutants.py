"""Draw random mutants of an area, run the area's own quick tests against each, and show those that survive.

cosmic-ray makes the mutants. A site (a place in a file, with a kind of change) is drawn first, then one of its possible
changes. Type annotations and `frozen` are not changed, because mypy checks them. The tests run once without a mutant,
to find the lines that each of them runs. For a mutant, only the tests that run its line are run, the quickest first,
until one fails. A run that takes too long counts as killed.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import json
import os
import queue
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "scripts" / "lib" / "mutants.toml"
KILLED, TOO_LONG, SURVIVES = "killed", "killed, as it took too long", "SURVIVES"
NO_TESTS = 5
"""The exit code of pytest if it found no test."""
MEMORY_BYTES = 6 * 1024**3
"""The memory limit, for mutants that allocate without end."""


@dataclass(frozen=True)
class Mutant:
    """A file of the project with one change in it.

    Attributes:
        file: its path below the root.
        start: the line in which the change begins.
        end: the line in which it ends.
        before: the text of the file.
        after: the same with the change.
    """

    file: str
    start: int
    end: int
    before: str
    after: str

    def change(self) -> tuple[str, str]:
        """Return the lines that the change removes and those that it adds, without the space around them."""
        lines = list(difflib.ndiff(self.before.splitlines(), self.after.splitlines()))
        removed, added = ([line[2:].strip() for line in lines if line.startswith(mark)] for mark in ("- ", "+ "))
        return " ".join(filter(None, removed)), " ".join(filter(None, added))

    def diff(self) -> str:
        """Return the change as a unified diff."""
        before, after = self.before.splitlines(), self.after.splitlines()
        return "\n".join(difflib.unified_diff(before, after, self.file, f"{self.file} (mutant)", lineterm="", n=2))


@dataclass
class Trace:
    """The lines that one test runs.

    Attributes:
        test: its name in pytest.
        seconds: how long it takes.
        lines: the lines that it runs, by file.
    """

    test: str
    seconds: float
    lines: dict[str, set[int]] = field(default_factory=dict)


@dataclass(frozen=True)
class Equal:
    """A mutant that is equivalent to the original."""

    file: str
    before: str
    after: str
    why: str

    def is_of(self, mutant: Mutant) -> bool:
        """Return whether a mutant is this one."""
        return (self.file, self.before, self.after) == (mutant.file, *mutant.change())


# Drawing ---------------------------------------------------------------------------------------------------------


def python_files(root: Path, places: Iterable[str]) -> list[str]:
    """Return the Python files at some places below the root: files or folders; missing ones are skipped."""
    found: list[str] = []
    for place in places:
        path = root / place
        files = sorted(path.rglob("*.py")) if path.is_dir() else [path] * path.is_file()
        found.extend(str(file.relative_to(root)) for file in files)
    return found


def left_to_mypy(text: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return the parts of a module that mypy checks: annotations, and whether a class is `frozen`.

    Returns:
        The beginning and end of each, as (line, column).
    """
    nodes: list[ast.expr | None] = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.AnnAssign | ast.arg):
            nodes.append(node.annotation)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            nodes.append(node.returns)
        elif isinstance(node, ast.keyword) and node.arg == "frozen":
            nodes.append(node.value)
    return [
        ((it.lineno, it.col_offset), (it.end_lineno or it.lineno, it.end_col_offset or 0))
        for it in nodes
        if it is not None
    ]


def draw(root: Path, files: Sequence[str], count: int, source: random.Random) -> list[Mutant]:
    """Return at most `count` different mutants of some files."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator, operator_names

    kinds = [get_operator(name) for name in sorted(operator_names())]
    operators = [kind() for kind in kinds if not kind.arguments()]
    sites: dict[tuple[str, str, Any], list[tuple[Any, int, Any]]] = {}
    texts = {file: (root / file).read_text(encoding="utf-8") for file in files}
    for file, text in texts.items():
        nodes, types = list(ast_nodes(get_ast(text))), left_to_mypy(text)
        for operator in operators:
            positions = [position for node in nodes for position in operator.mutation_positions(node)]
            family = type(operator).__name__.partition("_")[0]
            for number, (start, end) in enumerate(positions):
                if not any(first <= start and end <= last for first, last in types):
                    sites.setdefault((file, family, start), []).append((operator, number, end))
    mutants: list[Mutant] = []
    for file, family, start in source.sample(sorted(sites), len(sites)):
        if len(mutants) == count:
            break
        operator, number, end = source.choice(sites[file, family, start])
        try:
            after = mutate_code(texts[file], operator, number)
        except AttributeError:  # cosmic-ray cannot change `except a.b`, yet lists it as a site
            continue
        if after is not None and after != texts[file]:
            mutants.append(Mutant(file, start[0], end[0], texts[file], after))
    return mutants


def tests_for(mutant: Mutant, traces: Sequence[Trace]) -> list[Trace]:
    """Return the tests that may notice a mutant, the quickest first.

    These are the tests that run its line. A line that runs at import runs only in the first test that imports it,
    so it belongs to all tests that run any line of that module, and to the tests of a file that names it.
    """
    nodes = list(ast.walk(ast.parse(mutant.before)))
    bodies = [(node.body[0].lineno, node.end_lineno or 0) for node in nodes if isinstance(node, ast.FunctionDef)]
    touched = [(trace, trace.lines.get(mutant.file, set())) for trace in traces]
    if any(first <= mutant.start <= last for first, last in bodies):
        simple = [node for node in nodes if isinstance(node, ast.stmt) and not hasattr(node, "body")]
        around = [node for node in simple if node.lineno <= mutant.start <= (node.end_lineno or node.lineno)]
        first, last = (around[0].lineno, around[0].end_lineno or 0) if around else (mutant.start, mutant.end)
        chosen = [trace for trace, lines in touched if not lines.isdisjoint(range(first, last + 1))]
    else:
        chosen = [trace for trace, lines in touched if lines or names_module(trace.test, mutant.file)]
    return sorted(chosen, key=lambda trace: trace.seconds)


@cache
def names_module(test: str, file: str) -> bool:
    """Return whether the file of a test names the module in a file of the project."""
    path = ROOT / test.partition("::")[0]
    return path.is_file() and file.removesuffix(".py").replace("/", ".") in path.read_text(encoding="utf-8")


# Running ---------------------------------------------------------------------------------------------------------


class Tree:
    """A copy of the project in which tests run.

    Args:
        root: the project.
        place: an empty folder for the copy.
        patience_s: how much longer than without a mutant the tests may take, in seconds.
    """

    def __init__(self, root: Path, place: Path, patience_s: float = 30.0) -> None:
        self.root = place / "tree"
        self._patience_s = patience_s
        listed = subprocess.run(
            ["git", "-C", str(root), "ls-files", "-z", "-co", "--exclude-standard"], capture_output=True, check=True
        )
        for name in listed.stdout.decode().split("\0"):
            if name and (root / name).is_file():
                (self.root / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(root / name, self.root / name)
        self._notes = place / "notes.json"
        for name in ("run", "state"):
            (place / name).mkdir(mode=0o700)
        self._environment = {key: value for key, value in os.environ.items() if not key.startswith("PANCAKES_")}
        self._environment |= {
            "XDG_RUNTIME_DIR": str(place / "run"),
            "XDG_STATE_HOME": str(place / "state"),
            "PANCAKES_RUNTIME_DIR": str(place / "run"),
            "PYTHONPATH": f"{self.root}:{Path(__file__).parent}",
        }

    def trace(self, test_file: str, sources: Sequence[str]) -> tuple[list[Trace], list[str]]:
        """Run a file of tests; return the lines that each test runs, and the names of tests that fail."""
        self._notes.unlink(missing_ok=True)
        self._pytest([test_file], {"MUTANTS_SOURCES": ":".join(sources)}, None)
        if not self._notes.is_file():
            return [], [test_file]
        notes = json.loads(self._notes.read_text())
        traces = {name: Trace(name, seconds) for name, seconds in notes["passed"].items()}
        for file, by_line in notes["lines"].items():
            for line, names in by_line.items():
                for name in names:
                    if name in traces:
                        traces[name].lines.setdefault(file, set()).add(int(line))
        return list(traces.values()), notes["failed"]

    def verdict(self, mutant: Mutant, tests: Sequence[Trace]) -> str:
        """Return the verdict of some tests on a mutant: `KILLED`, `TOO_LONG` or `SURVIVES`."""
        file = self.root / mutant.file
        self._write(file, mutant.after)
        try:
            seconds = sum(test.seconds for test in tests)
            order = [test.test for test in tests]
            files = list(dict.fromkeys(name.partition("::")[0] for name in order))
            limit_s = self._patience_s + 3.0 * seconds
            code = self._pytest(files, {"MUTANTS_ORDER": json.dumps(order)}, limit_s)
            return TOO_LONG if code is None else SURVIVES if code in (0, NO_TESTS) else KILLED
        finally:
            self._write(file, mutant.before)

    def _write(self, file: Path, text: str) -> None:
        file.write_text(text, encoding="utf-8")
        # Python's cache cannot tell two texts of the same length apart that are written within a second.
        for cached in (file.parent / "__pycache__").glob(f"{file.stem}.*.pyc"):
            cached.unlink()

    def _pytest(self, files: Sequence[str], orders: dict[str, str], limit_s: float | None) -> int | None:
        """Run pytest; return its exit code, or None if it took too long."""
        orders = {"MUTANTS_NOTES": str(self._notes), **orders}
        orders_file = self._notes.with_name("orders.json")
        orders_file.write_text(json.dumps(orders))
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "mutants_plugin", "-p", "no:cacheprovider"]
        if "MUTANTS_SOURCES" in orders:
            command.remove("-x")
        process = subprocess.Popen(
            [*command, *files],
            cwd=self.root,
            env={**self._environment, "MUTANTS": str(orders_file)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        resource.prlimit(process.pid, resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        try:
            return process.wait(limit_s)
        except subprocess.TimeoutExpired:
            return None
        finally:
            try:
                os.killpg(process.pid, signal.SIGKILL)  # also processes that a test left behind
            except ProcessLookupError:
                pass
            process.wait()


def main() -> int:
    """Draw and judge mutants; return 1 if fewer than nine of ten are killed."""
    table = tomllib.loads(TABLE.read_text(encoding="utf-8"))
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n\n")[0])
    parser.add_argument("area", choices=table["areas"])
    parser.add_argument("--count", type=int, default=100, help="number of mutants (default: 100)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the drawing (default: 1)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="number of parallel runs")
    options = parser.parse_args()
    area = table["areas"][options.area]
    sources, tests = python_files(ROOT, area["sources"]), python_files(ROOT, area["tests"])
    equals = [Equal(it["file"], it["before"], it["after"], it["why"]) for it in table.get("equal", ())]
    mutants = draw(ROOT, sources, options.count, random.Random(options.seed))
    with tempfile.TemporaryDirectory(prefix="mutants-") as directory, ThreadPoolExecutor(options.jobs) as pool:
        trees: queue.Queue[Tree] = queue.Queue()
        for number in range(options.jobs):
            place = Path(directory, str(number))
            place.mkdir()
            trees.put(Tree(ROOT, place))

        def trace(test_file: str) -> tuple[list[Trace], list[str]]:
            tree = trees.get()
            try:
                return tree.trace(test_file, sources)
            finally:
                trees.put(tree)

        def judge(mutant: Mutant) -> str:
            tree = trees.get()
            try:
                return tree.verdict(mutant, tests_for(mutant, traces))
            finally:
                trees.put(tree)

        traces: list[Trace] = []
        quick = [it for it in tests if Path(it).name.startswith("test_") and not it.endswith("_full.py")]
        for found, failed in pool.map(trace, quick):
            traces.extend(found)
            for name in failed:
                print(f"skipped, because it fails without a mutant: {name}", flush=True)
        print(f"{len(traces)} tests, {len(mutants)} mutants of {options.area} (seed {options.seed})", flush=True)
        killed = same = 0
        for number, (mutant, verdict) in enumerate(zip(mutants, pool.map(judge, mutants), strict=True), 1):
            equal = next((it for it in equals if it.is_of(mutant)), None)
            if verdict == SURVIVES and equal is not None:
                verdict = f"equal to the original: {equal.why}"
                same += 1
            killed += verdict != SURVIVES
            print(f"{number:4} {mutant.file}:{mutant.start} {verdict}", flush=True)
            if verdict == SURVIVES:
                print(mutant.diff() + "\n", flush=True)
    print(f"{options.area}: {killed} of {len(mutants)} killed, {same} of these equal to the original")
    return 0 if killed >= 0.9 * len(mutants) else 1


if __name__ == "__main__":
    sys.exit(main())
