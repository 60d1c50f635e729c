"""The public API is what public_api.txt says: each public name with its signature.

A line that goes or changes breaks somebody's program: say so in the changelog. After a change that is meant:

    .venv/bin/python tests/test_public_api.py --write
"""

from __future__ import annotations

import ast
import configparser
import difflib
import importlib
import inspect
import subprocess
import sys
import textwrap
from collections.abc import Iterator, Mapping
from enum import Enum
from pathlib import Path
from types import ModuleType
from typing import Any, ForwardRef

import click
import msgspec
import pytest

from pancakes.tools.cli.agent_command import agent as pancakes_agent
from pancakes.tools.cli.main import pancakes
from pancakes.util.plugins import Plugins

HERE = Path(__file__).resolve().parent
SNAPSHOT = HERE / "public_api.txt"
MODULES = (
    "pancakes",
    "pancakes.devices",
    "pancakes.devices.driver",
    "pancakes.client",
    "pancakes.control",
    "pancakes.errors",
    "pancakes.events",
    "pancakes.filters.filter",
    "pancakes.gym",
    "pancakes.migration",
    "pancakes.packet",
    "pancakes.pytest_plugin",
    "pancakes.request",
    "pancakes.service",
    "pancakes.settings",
    "pancakes.simulation",
    "pancakes.task",
    "pancakes.testing",
    "pancakes.trees",
    "pancakes.worlds",
)
"""What the guides import, and what those inherit."""
WRITE = f".venv/bin/python {Path(__file__).relative_to(HERE.parent)} --write"


def test_public_api_is_as_written_down():
    difference = difflib.unified_diff(
        SNAPSHOT.read_text(encoding="utf-8").splitlines(), api(), "tests/public_api.txt", "the code", lineterm="", n=0
    )
    shown = "\n".join(difference)
    assert not shown, f"the public API has changed:\n{shown}\n\nIf that is meant: {WRITE}, and a line in CHANGELOG.md"


def test_public_names_are_loaded_when_they_are_used():
    code = (
        "import sys, pancakes; before = {name for name in sys.modules if name.startswith('pancakes')}; "
        "assert before == {'pancakes'}, before; "
        "from pancakes import Task; assert 'pancakes.client' not in sys.modules; "
        "names = [name for name in dir(pancakes) if not name.startswith('_')]; "
        "assert all(hasattr(pancakes, name) for name in names) and 'Client' in names"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_name_that_is_not_public_is_refused():
    with pytest.raises(ImportError, match="cannot import name 'Tsk'"):
        from pancakes import Tsk  # noqa: F401


def api() -> list[str]:
    """Returns the public API, a name with its signature in a line."""
    lines = [line for name in MODULES for line in of_module(importlib.import_module(name))]
    return sorted({*lines, *of_entry_points(), *of_commands()})


# Modules and classes ---------------------------------------------------------------------------------------------


def of_module(module: ModuleType) -> Iterator[str]:
    """Returns the lines of a module: what it exports, or else what it defines without an underscore."""
    tree = ast.parse(inspect.getsource(module))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):  # `import X as X`: what a module hands on
            yield from (f"{module.__name__}.{it.name}: of {node.module}" for it in node.names if it.name == it.asname)
    exported: list[str] | None = getattr(module, "__all__", None)
    assigned = dict(assigned_in(tree.body))
    functions = [node for node in tree.body if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))]
    defined = [node.name for node in (*functions, *(node for node in tree.body if isinstance(node, ast.ClassDef)))]
    fixtures = {node.name for node in functions if any("fixture" in ast.unparse(it) for it in node.decorator_list)}
    for name in exported if exported is not None else [*defined, *assigned]:
        if name.startswith(("_", "pytest_")) and name != "__version__":
            continue
        value = getattr(module, name)
        path = f"{module.__name__}.{name}"
        if name in fixtures:
            yield f"{path}: fixture"
        elif inspect.isclass(value) and value.__module__.startswith("pancakes"):
            yield from of_class(value, path)
        elif inspect.isroutine(value):
            yield f"{path}{shown(inspect.signature(value))}"
        else:
            yield f"{path}: {assigned.get(name) or type(value).__name__}"


def assigned_in(body: list[ast.stmt]) -> Iterator[tuple[str, str]]:
    """Returns the names that are assigned at the top of a module, with their annotations as they are written."""
    for node in body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            yield node.target.id, ast.unparse(node.annotation)
        elif isinstance(node, ast.Assign):
            yield from ((target.id, "") for target in node.targets if isinstance(target, ast.Name))


def of_class(cls: type, path: str) -> Iterator[str]:
    """Returns the lines of a class: its bases, how it is called, and its fields and methods.

    Those that it inherits are among them, from classes that are private too: who derives from it must not use their
    names.
    """
    bases = ", ".join(base.__name__ for base in cls.__bases__ if base is not object and not is_private(base))
    yield f"{path}: class({bases})"
    own = [base for base in cls.__mro__ if base.__module__.partition(".")[0] == "pancakes"]
    annotations = {name: text for base in reversed(own) for name, text in vars(base).get("__annotations__", {}).items()}
    called = parameters_of(cls)
    if called is not None:
        yield f"{path}{shown(called, annotations)}"
    lines: dict[str, str] = {}
    for base in own:
        for name, line in members(base):
            lines.setdefault(name, line)
    for name, line in lines.items():
        if called is None or name not in called.parameters:
            yield f"{path}.{name}{line}"


def is_private(cls: type) -> bool:
    """Returns whether a class is of a module of Pancakes that is not public."""
    return cls.__module__.partition(".")[0] == "pancakes" and cls.__module__ not in MODULES


def parameters_of(cls: type) -> inspect.Signature | None:
    """Returns how a class is called; None: it says nothing of its own about that."""
    if issubclass(cls, msgspec.Struct):
        return inspect.Signature(parameters_of_struct(cls))
    own = [base for base in cls.__mro__ if base.__module__.partition(".")[0] == "pancakes"]
    if issubclass(cls, BaseException) and not any("__init__" in vars(base) for base in own):
        return None
    try:
        return inspect.signature(cls)
    except ValueError:  # a class without a signature, such as one that is made by C
        return None


def parameters_of_struct(cls: type[msgspec.Struct]) -> list[inspect.Parameter]:
    """Returns the parameters of a Struct. What `inspect` says of one depends on whether its annotations resolve."""
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    assert isinstance(node, ast.ClassDef)
    by_name = any(keyword.arg == "kw_only" for keyword in node.keywords)
    kind = inspect.Parameter.KEYWORD_ONLY if by_name else inspect.Parameter.POSITIONAL_OR_KEYWORD
    names, defaults = cls.__struct_fields__, cls.__struct_defaults__
    given = [*([inspect.Parameter.empty] * (len(names) - len(defaults))), *defaults]
    pairs = zip(names, given, strict=True)
    return [
        inspect.Parameter(name, kind, default=inspect.Parameter.empty if value is msgspec.NODEFAULT else value)
        for name, value in pairs
    ]


def members(cls: type) -> Iterator[tuple[str, str]]:
    """Returns the public names of a class itself, without those of its bases, each with the rest of its line."""
    annotations: dict[str, Any] = vars(cls).get("__annotations__", {})
    for name in dict.fromkeys([*annotations, *vars(cls)]):
        if name.startswith("_"):
            continue
        value = vars(cls).get(name)
        if isinstance(value, (staticmethod, classmethod)):
            yield name, f"{shown(inspect.signature(value.__func__))} [{type(value).__name__}]"
        elif inspect.isfunction(value):
            yield name, ("" if not inspect.iscoroutinefunction(value) else " async ") + shown(inspect.signature(value))
        elif isinstance(value, property):
            yield (
                name,
                f": {inspect.signature(value.fget).return_annotation} [property]" if value.fget else ": property",
            )
        elif name in annotations:
            yield name, f": {Text(annotations[name])!r}"
        elif inspect.isclass(value):
            yield name, ": class"
        else:
            yield name, f": {type(value).__name__}"


def shown(signature: inspect.Signature, annotations: Mapping[str, str] | None = None) -> str:
    """Returns a signature with its annotations as they stand in the source.

    Args:
        signature: the signature.
        annotations: those of the fields of a class, by name: msgspec resolves them.
    """
    fields = annotations or {}
    parameters = []
    for it in signature.parameters.values():
        written = fields.get(it.name, it.annotation)
        annotation = it.empty if written is it.empty else Text(written)
        default = it.empty if it.default is it.empty else Text(default_of(it.default))
        parameters.append(it.replace(annotation=annotation, default=default))
    returns = signature.return_annotation
    returns = signature.empty if returns in (signature.empty, "None", None) else Text(returns)
    return str(signature.replace(parameters=parameters, return_annotation=returns))


def default_of(value: Any) -> str:
    """Returns a default in words that are the same in each run and for each version of Python."""
    if isinstance(value, Enum):
        return str(value)
    if callable(value):
        return str(getattr(value, "__qualname__", "..."))
    text = repr(value)
    return "..." if " at 0x" in text or text.startswith("<") else text


class Text:
    """What a signature shows as it is."""

    def __init__(self, text: Any) -> None:
        if isinstance(text, ForwardRef):
            text = text.__forward_arg__
        self.text = text if isinstance(text, str) else inspect.formatannotation(text)

    def __repr__(self) -> str:
        return self.text


# Entry points and commands ---------------------------------------------------------------------------------------


def of_entry_points() -> Iterator[str]:
    """Returns the entry points of the distribution, by their groups."""
    parser = configparser.ConfigParser(delimiters=("=",))
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(HERE.parent / "setup.cfg")
    for group, text in parser["options.entry_points"].items():
        for line in text.strip().splitlines():
            yield f"[{group}] {line.partition('=')[0].strip()}"


def of_commands() -> Iterator[str]:
    """Returns the verbs of the command line, each with its arguments, and their options."""
    yield from of_command("pancakes-agent", pancakes_agent)
    yield from of_command("pancakes", pancakes)


def of_command(path: str, command: click.Command) -> Iterator[str]:
    """Returns the lines of a command and of those below it, but for commands of plug-ins."""
    arguments = [it for it in command.params if isinstance(it, click.Argument)]
    yield " ".join([f"$ {path}", *(f"{it.name.upper()}{taken(it)}" for it in arguments if it.name)])
    for option in command.params:
        if isinstance(option, click.Option) and not option.hidden:
            for name in (*option.opts, *option.secondary_opts):
                yield f"$ {path} {name}{taken(option)}"
    if isinstance(command, click.Group):
        context = click.Context(command)
        others = set(Plugins().names("pancakes.commands")) if command is pancakes else set()
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            if found is not None and not found.hidden and name not in others:
                yield from of_command(f"{path} {name}", found)


def taken(parameter: click.Parameter) -> str:
    """Returns what an option or an argument takes."""
    kind = parameter.type
    words = list(map(str, kind.choices)) if isinstance(kind, click.Choice) else [kind.name]
    flag = isinstance(parameter, click.Option) and (parameter.is_flag or parameter.count)
    more = [word for word, so in (("required", parameter.required), ("repeated", is_repeated(parameter))) if so]
    return ("" if flag else f" <{'|'.join(words)}>") + (f" [{', '.join(more)}]" if more else "")


def is_repeated(parameter: click.Parameter) -> bool:
    return parameter.nargs == -1 or bool(getattr(parameter, "multiple", False))


def main() -> None:
    """Writes the snapshot."""
    if sys.argv[1:] != ["--write"]:
        sys.exit(f"usage: {WRITE}")
    SNAPSHOT.write_text("\n".join(api()) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
