"""Check the source for faults that ruff, mypy and import-linter do not find. `scripts/check` runs it.

    python scripts/lib/lints.py

It prints a line for each finding and ends with 1 if there are any. Each file is parsed once. A lint is a function from
the parsed files to its findings, and its docstring says why the rule matters. Exceptions are listed beside their lint,
each with its reason. An exception that no longer excuses anything is a finding, too.
"""

from __future__ import annotations

import ast
import builtins
import gc
import sys
import threading
from collections import defaultdict, deque
from collections.abc import Collection, Iterable, Iterator, Mapping
from configparser import ConfigParser
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PRODUCT = ("pancakes/", "plugins/")
TESTS = ("tests/", "trials/")


class Finding(NamedTuple):
    """A fault in the source.

    Attributes:
        path: the file, relative to the root.
        line: the line, from 1.
        text: what is wrong and what to do, in one sentence.
        subject: the key under which an exception would excuse it.
    """

    path: str
    line: int
    text: str
    subject: str = ""

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.text}"


class Source:
    """A parsed file.

    Attributes:
        path: the file, relative to the root.
    """

    def __init__(self, path: str, text: str) -> None:
        self.path = path
        self._nodes: dict[type, list[Any]] = defaultdict(list)
        for node in ast.walk(ast.parse(text)):
            self._nodes[type(node)].append(node)

    def all(self, kind: type) -> list[Any]:
        """Return all nodes of a kind, nested ones too."""
        return self._nodes[kind]


def main(root: Path = ROOT) -> int:
    """Print the findings, and return the exit code."""
    found = sorted(findings(read(root), layers_in(root / "setup.cfg")))
    for finding in found:
        print(finding)
    return bool(found)


def read(root: Path) -> list[Source]:
    """Parse all Python files of the product and its tests."""
    paths = [path for folder in PRODUCT + TESTS for path in sorted((root / folder).rglob("*.py"))]
    return [Source(path.relative_to(root).as_posix(), path.read_text(encoding="utf-8")) for path in paths]


def findings(sources: Collection[Source], layers: Collection[str]) -> Iterator[Finding]:
    """Run all lints."""
    product = [source for source in sources if source.path.startswith(PRODUCT)]
    tests = [source for source in sources if source.path.startswith(TESTS)]
    yield from excused(asked_for_their_type(product), MAY_ASK)
    yield from told_functions(product)
    yield from excused(called_under_a_lock(product), MAY_CALL)
    yield from outside_of_layers(product, layers)
    yield from private_names(tests)


def excused(found: Iterable[Finding], exceptions: Mapping[str, str]) -> Iterator[Finding]:
    """Yield the findings without an exception, and a finding for each exception that excuses nothing."""
    unused = set(exceptions)
    for finding in found:
        unused.discard(finding.subject)
        if finding.subject not in exceptions:
            yield finding
    for subject in unused:
        yield Finding("scripts/lib/lints.py", 1, f"the exception {subject!r} excuses nothing: remove it")


# Actors share nothing ------------------------------------------------------------------------------------------------

MAY_ASK = {
    "pancakes/pytest_plugin.py": "a test looks inside",
    "pancakes/simulation/agent_handle.py": "it looks between two turns, or a test looks inside",
    "pancakes/simulation/simulation.py": "it looks between two turns, on the thread that runs all turns",
    "pancakes/recording/virtual_recorder.py": "it looks between two turns, on the thread that runs all turns",
    "pancakes/tools/replay/virtual_replay.py": "it looks between two turns, on the thread that runs all turns",
    "pancakes/tools/web/virtual_watch.py": "it looks between two turns, on the thread that runs all turns",
}
"""The files that may ask an actor for its type."""


def asked_for_their_type(sources: Collection[Source]) -> Iterator[Finding]:
    """Find `isinstance` and `case` with the class of an actor.

    One actor knows another as a `Reference`, which has no state, so mypy finds a read of any other attribute. After
    `isinstance(it, Task)` mypy allows it: a data race, as the other actor may run on another thread.
    """
    actors = actor_classes(sources)
    for source in sources:
        asks = [call.args[1] for call in source.all(ast.Call) if called(call) == "isinstance" and len(call.args) == 2]
        for types in asks + [case.cls for case in source.all(ast.MatchClass)]:
            for name in sorted(class_names(types) & actors):
                text = f"asks whether an object is the actor {name}: tell it a message, or read a table that it fills"
                yield Finding(source.path, types.lineno, text, source.path)


def class_names(types: ast.expr) -> set[str]:
    """Return the names in the second argument of `isinstance`, without dotted names."""
    if isinstance(types, ast.Tuple):
        return {name for part in types.elts for name in class_names(part)}
    if isinstance(types, ast.BinOp):
        return class_names(types.left) | class_names(types.right)
    return {types.id} if isinstance(types, ast.Name) else set()


def actor_classes(sources: Iterable[Source]) -> set[str]:
    """Return the names of all classes below `Component`."""
    bases = [
        (cls.name, {last_name(base.value if isinstance(base, ast.Subscript) else base) for base in cls.bases})
        for source in sources
        for cls in source.all(ast.ClassDef)
    ]
    found = {"Component"}
    while more := {name for name, above in bases if above & found} - found:
        found |= more
    return found


def told_functions(sources: Collection[Source]) -> Iterator[Finding]:
    """Find functions in messages between actors.

    The receiver would call such a function on its own thread, while the sender continues to use the variables that the
    function has captured.
    """
    messages = set()
    for source in sources:
        for call in source.all(ast.Call):
            if not is_tell(call):
                continue
            for node in ast.walk(call.args[1]):
                if isinstance(node, ast.Lambda) or last_name(node) == "partial":
                    yield Finding(source.path, node.lineno, "tells an actor a function: send data instead")
                elif isinstance(node, ast.Call):
                    messages.add(called(node))
    for source in sources:
        for cls in source.all(ast.ClassDef):
            fields = [node for node in cls.body if isinstance(node, ast.AnnAssign)] if cls.name in messages else []
            for field in fields:
                if any(last_name(node) == "Callable" for node in ast.walk(field.annotation)):
                    text = f"{cls.name} is a message to actors and has a function as field: send data instead"
                    yield Finding(source.path, field.lineno, text)


def is_tell(call: ast.Call) -> bool:
    """Return whether a call is `tell(actor, message)` or `kernel.tell(path, message)`."""
    function = call.func
    of_kernel = isinstance(function, ast.Attribute) and last_name(function.value).lstrip("_") == "kernel"
    return called(call) == "tell" and (of_kernel or isinstance(function, ast.Name)) and len(call.args) == 2


# Locks ---------------------------------------------------------------------------------------------------------------

SHARED = tuple(
    f"pancakes/{package}/"
    for package in ("agent", "config", "durable", "journal", "kernel", "services", "supervision", "util")
) + ("pancakes/service.py", "pancakes/task.py")
"""The packages with tables that actors share."""

MAY_CALL = {
    "pancakes/durable/host_state.py: self._kernel.host": "the clock",
    "pancakes/durable/courier.py: stream": "it is pure, and this lock guards it",
    "pancakes/kernel/dispatchers.py: wake": "a queue",
    "pancakes/kernel/dispatchers.py: worker": "a new thread, which waits for this lock only after its start",
    "pancakes/kernel/stream.py: hint_of": "it compares names",
    "pancakes/kernel/stream.py: mailbox": "the subscriptions of the mailbox, which this lock guards",
    "pancakes/kernel/stream.py: reader": "the subscriptions of the mailbox, which this lock guards",
}
"""The objects that may be called under a lock, as `file: object`, and what they are."""

KINDS = (list, dict, set, deque, threading.Condition, type(threading.Lock()))
HARMLESS = {name for kind in KINDS for name in dir(kind)} | {"endswith", "is_set", "join", "startswith"}
"""The methods of containers, locks and strings: they call nothing back."""


def called_under_a_lock(sources: Iterable[Source]) -> Iterator[Finding]:
    """Find calls of other objects in a `with` block of a lock, in the tables that actors share.

    The called object may take another lock, or call back. Then two threads that take two locks in opposite order would
    wait for each other for ever, and a slow call would block all actors that need the table.
    """
    for source in sources:
        if not source.path.startswith(SHARED):
            continue
        for block in source.all(ast.With):
            if any("lock" in ast.unparse(item.context_expr) for item in block.items):
                for node in (node for statement in block.body for node in ast.walk(statement)):
                    if isinstance(node, ast.Call) and is_foreign(node):
                        function = node.func
                        of = ast.unparse(function.value if isinstance(function, ast.Attribute) else function)
                        text = f"calls {ast.unparse(function)} under a lock: call it before or after"
                        yield Finding(source.path, node.lineno, text, f"{source.path}: {of}")


def is_foreign(call: ast.Call) -> bool:
    """Return whether a call may run other code: it is not of a container, a class, a builtin or a private method."""
    if isinstance(call.func, ast.Attribute):
        own = last_name(call.func.value) == "self" and call.func.attr.startswith("_")
        return not own and call.func.attr not in HARMLESS
    name = ast.unparse(call.func)
    return not hasattr(builtins, name) and not name.lstrip("_")[:1].isupper()


# Layers --------------------------------------------------------------------------------------------------------------


def outside_of_layers(sources: Iterable[Source], layers: Collection[str]) -> Iterator[Finding]:
    """Find modules that are in no layer of `setup.cfg`.

    import-linter checks only the modules that its layers name, so such a module could import anything.
    """
    for source in sources:
        module = module_of(source.path)
        inside = [layer for layer in layers if f"{module}.".startswith(f"{layer}.")]
        if not source.path.endswith("/__init__.py") and not inside:
            text = f"{module} is in no layer of import-linter: add it to one in setup.cfg"
            yield Finding(source.path, 1, text)


def module_of(path: str) -> str:
    """Return the name of the module in a file."""
    parts = path.removesuffix(".py").split("/")
    return ".".join(parts[2:] if parts[0] == "plugins" else parts)


def layers_in(setup: Path) -> list[str]:
    """Return the packages and modules that the layers of import-linter name."""
    parser = ConfigParser()
    parser.read(setup, encoding="utf-8")
    return parser["importlinter:contract:layers"]["layers"].replace("|", " ").replace(":", " ").split()


# Tests ---------------------------------------------------------------------------------------------------------------

BY_NAME = ("setattr", "getattr", "hasattr", "delattr")


def private_names(sources: Iterable[Source]) -> Iterator[Finding]:
    """Find tests that import a private name, or name a private attribute in a string.

    A test of a private name fails when the code is rearranged, and may pass when a public path is broken. ruff's SLF001
    finds `it._private`, but not these.
    """
    for source in sources:
        named = [(node.lineno, alias.name) for node in source.all(ast.ImportFrom) for alias in node.names]
        for call in source.all(ast.Call):
            if called(call) in BY_NAME:
                texts = [text.value for text in call.args[:2] if isinstance(text, ast.Constant)]
                named += [(call.lineno, text.rpartition(".")[2]) for text in texts if isinstance(text, str)]
        for line, name in named:
            if name.startswith("_") and not name.startswith("__"):
                yield Finding(source.path, line, f"names {name}, which is private: test what is visible from outside")


# Nodes ---------------------------------------------------------------------------------------------------------------


def called(call: ast.Call) -> str:
    """Return the name of the called function, without its object or module."""
    return last_name(call.func)


def last_name(node: ast.AST) -> str:
    """Return the last part of a dotted name; empty: the node is something else."""
    return node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""


if __name__ == "__main__":
    gc.disable()  # all trees stay until the end, and scanning them again and again takes longer than parsing them
    sys.exit(main())
