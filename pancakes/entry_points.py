"""The entry points of installed distributions, read as `importlib.metadata` reads them, but without it.

That imports 52 modules (it reads the lines of a header with the parser for e-mail, and looks into zip archives):
2.1 MiB of an agent's 25, and 17 ms of the 144 that its start takes. So directories are read here, which is where all
that pip installs is; and where Python finds distributions elsewhere as well, it is asked all the same.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from importlib.machinery import PathFinder
from typing import Any

Read = Callable[[str], str | None]
"""Returns the text of one of a distribution's files, such as `entry_points.txt`; None where it has none."""


def distributions() -> Iterator[tuple[str, Read]]:
    """Yields where each distribution is, and what reads its files, in the order of `sys.path`."""
    if not _are_all_in_directories():
        from importlib.metadata import distributions as all_distributions

        for distribution in all_distributions():
            yield str(getattr(distribution, "_path", "a distribution")), distribution.read_text
        return
    for root in sys.path:
        try:
            names = os.listdir(root or ".")
        except OSError:
            continue  # an import passes over what is not there as well
        for name in names:
            if name.lower().endswith((".dist-info", ".egg-info")):
                place = os.path.join(root, name)
                yield place, partial(_read, place)


def _are_all_in_directories() -> bool:
    if any(hasattr(finder, "find_distributions") and finder is not PathFinder for finder in sys.meta_path):
        return False
    return not any(path.endswith(".egg") or os.path.isfile(path) for path in sys.path)


def _read(place: str, name: str) -> str | None:
    try:
        with open(os.path.join(place, name), encoding="utf-8") as file:
            return file.read()
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return None


def header(read: Read, key: str) -> str:
    """Returns a value of the header of a distribution's metadata, such as `Name`.

    Raises:
        ValueError: it is not there.
    """
    for line in (read("METADATA") or read("PKG-INFO") or "").splitlines():
        name, colon, value = line.partition(":")
        if not line:
            break  # the description follows
        if colon and name.lower() == key.lower():
            return value.strip()
    raise ValueError(f"its metadata has no {key}")


def points(text: str) -> Iterator[tuple[str, str, str]]:
    """Yields the group, the name and the value (`module:attribute`) of each entry point."""
    group = ""
    for line in map(str.strip, text.splitlines()):
        if line.startswith("[") and line.endswith("]"):
            group = line[1:-1].strip()
        elif line and not line.startswith("#"):
            name, _, value = line.partition("=")
            yield group, name.strip(), value.strip()


def load(value: str) -> Any:
    """Imports what an entry point names; that may raise anything."""
    module, _, path = value.partition("[")[0].partition(":")  # in brackets stand extras, which nobody asks for
    found = import_module(module.strip())
    for name in filter(None, path.strip().split(".")):
        found = getattr(found, name)
    return found
