"""Write the distributions of `pancakes new` from templates: all files or none."""

from __future__ import annotations

import contextlib
import importlib.metadata
import importlib.util
import keyword
import re
import secrets
import shutil
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

from pancakes.config import DEFAULT_SERVICES
from pancakes.errors import PancakesError
from pancakes.packet import CORE_CHANNELS, body_class
from pancakes.util.plugins import Plugins

KINDS: Final = ("task", "driver", "service", "filter", "cost", "world", "plugin")
LONGEST: Final = 30
"""With longer names the lines of the templates would be too long."""

_TEMPLATES: Final = Path(__file__).parent / "templates"
_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9]*(?:[_-][A-Za-z0-9]+)*")
_WORD_BEGINS: Final = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")
_PLACEHOLDER: Final = re.compile(r"\{\{(\w+)\}\}")
_RESERVED: Final = frozenset(
    ("build", "configs", "conftest", "dist", "pancakes", "pancakes_agents", "reading", "setup", "test", "tests")
)
PURPOSES: Final = {
    "README.md": "how to install, test and run it",
    "setup.cfg": "its name, requirements and entry points",
    "pyproject.toml": "how it is built",
    ".gitignore": "the files that git ignores",
    "reading.txt": "the sensor's reading, in place of hardware",
    "package/__init__.py": "the package",
    "package/packets.py": "its packet types",
    "package/driver.py": "the driver",
    "package/task.py": "the task",
    "package/watch.py": "the task",
    "package/service.py": "the service",
    "package/filter.py": "the filter",
    "package/cost.py": "the cost function",
    "package/world.py": "the world",
    "package/desk.py": "the service and its task",
    "package/tally.py": "the task of the service",
    "configs/package.toml": "an agent that runs it",
    "configs/sensor.toml": "an agent with the sensor and the task",
    "configs/gateway.toml": "an agent with the service",
    "tests/conftest.py": "what the tests share",
    "tests/test_package.py": "its tests, in virtual time",
}
"""The purpose of each file, by the name of its template, in the order in which to read them."""


@dataclass(frozen=True, slots=True)
class Names:
    """The names of a distribution and its contents, all made from one name.

    Attributes:
        dist: the name of the distribution and its folder, such as `scan-target`.
        package: the name of the package, such as `scan_target`; also the prefix of its types.
        cls: the name of its class, such as `ScanTarget`.
    """

    dist: str
    package: str
    cls: str

    @classmethod
    def of(cls, text: str) -> Names:
        """Parse a name in any style: `scan_target`, `scan-target` or `ScanTarget`.

        Raises:
            ValueError: it cannot be the name of a package; the message is a sentence.
        """
        if not _NAME.fullmatch(text):
            raise ValueError(
                f"{text!r} is not a valid name: it must begin with a letter, and may have only the letters a to z,"
                " digits, and single - or _ between its words"
            )
        words = _WORD_BEGINS.sub("_", text.replace("-", "_")).split("_")
        if text.isupper():
            words = [word.lower() for word in words]
        names = cls(
            "-".join(words).lower(), "_".join(words).lower(), "".join(word[0].upper() + word[1:] for word in words)
        )
        names._check()
        return names

    def _check(self) -> None:
        if not 2 <= len(self.package) <= LONGEST:
            raise ValueError(
                f"a name must have 2 to {LONGEST} characters, and {self.package!r} has {len(self.package)}"
            )
        if keyword.iskeyword(self.package) or keyword.issoftkeyword(self.package) or keyword.iskeyword(self.cls):
            raise ValueError(f"{self.package!r} is a keyword of Python: choose another name")
        if self.package in sys.stdlib_module_names:
            raise ValueError(f"Python has a module called {self.package!r}: choose another name")
        if self.package in (*_RESERVED, *CORE_CHANNELS, *DEFAULT_SERVICES):
            raise ValueError(f"{self.package!r} is reserved in Pancakes or its tools: choose another name")
        if self.cls in named_in_templates():
            raise ValueError(f"Pancakes has a class called {self.cls}: choose another name than {self.package!r}")

    def conflict(self, kind: str) -> str:
        """Return which installed module, distribution or packet type has this name already; empty if none has."""
        found = importlib.util.find_spec(self.package)
        if found is not None and found.origin is not None:
            return f"a module called {self.package} is already installed here, in {found.origin}"
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            version = importlib.metadata.version(self.dist)
            return f"a distribution called {self.dist} is already installed here, in version {version}"
        if kind in ("driver", "plugin"):
            Plugins().load_packets()
            known = body_class(self.package)
            if known is not None:
                return f"the packet type {self.package!r} exists already: {known.__module__}.{known.__qualname__}"
        return ""


@dataclass(frozen=True, slots=True)
class File:
    """One file of a distribution.

    Attributes:
        path: its path in the distribution's folder, with `/`.
        purpose: its purpose, in a few words.
        text: its contents.
    """

    path: str
    purpose: str
    text: str


def files_of(kind: str, names: Names) -> list[File]:
    """Return the files of a distribution of one kind (see `KINDS`), in the order in which to read them."""
    values = {"dist": names.dist, "package": names.package, "Class": names.cls}
    named_files = []
    for name, template in _templates(kind):
        text = _PLACEHOLDER.sub(lambda found: values[found[1]], template.read_text(encoding="utf-8"))
        named_files.append((name, File(name.replace("package", names.package), PURPOSES[name], text)))
    order = list(PURPOSES)
    return [file for _, file in sorted(named_files, key=lambda pair: order.index(pair[0]))]


@cache
def named_in_templates() -> frozenset[str]:
    """Return the names of classes that the templates import or define, except the class named by the user."""
    text = "\n".join(template.read_text(encoding="utf-8") for template in sorted(_TEMPLATES.rglob("*.py.in")))
    lines = re.findall(r"^from (?!\{)[\w.]+ import (.+)$", text, re.MULTILINE)
    names = [*re.findall(r"^(?:class )?([A-Z]\w+)(?: = |[(:])", text, re.MULTILINE), *", ".join(lines).split(", ")]
    return frozenset(name for name in names if name[0].isupper() and not name.isupper())


def _templates(kind: str) -> Iterator[tuple[str, Path]]:
    """Yield the name and the path of each template of a kind.

    File names end with `.in`, so that no tool takes them for Python; a leading `dot.` stands for a dot.
    """
    for folder in (_TEMPLATES / "common", _TEMPLATES / kind):
        for template in sorted(folder.rglob("*.in")):
            name = template.relative_to(folder).as_posix().removesuffix(".in")
            yield name.removeprefix("dot"), template


def write(folder: Path, files: list[File]) -> None:
    """Write a distribution's folder: all of it or nothing.

    Args:
        folder: the folder; it must not exist, and its parent must exist.
        files: its files.

    Raises:
        PancakesError: the folder exists already, or cannot be written.
    """
    check_free(folder)
    unfinished = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}")
    try:
        unfinished.mkdir()
        _fill(unfinished, {file.path: file.text for file in files})
        unfinished.rename(folder)
    except OSError as error:
        raise PancakesError(f"{folder} cannot be written: {error.strerror or error}") from None
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _fill(folder: Path, texts: Mapping[str, str]) -> None:
    for path, text in texts.items():
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")


def check_free(folder: Path) -> None:
    """Check that a folder does not exist yet.

    Raises:
        PancakesError: a file or folder of its name exists already.
    """
    if folder.exists() or folder.is_symlink():
        raise PancakesError(f"{folder} exists already: nothing was written")
