"""Read the entry points of installed distributions, as `importlib.metadata` does, without importing it.

That imports 50 modules (a parser for e-mail reads headers, others look into zip archives): a tenth of the time until
an agent ticks, and 2 MiB. So what pip installs, which is in directories, is read here; `importlib.metadata` is asked
only if Python finds distributions elsewhere, too.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from functools import partial, reduce
from importlib import import_module
from importlib.machinery import PathFinder
from typing import Any, Final, NamedTuple

_INFO: Final = (".dist-info", ".egg-info")


class Distribution(NamedTuple):
    """An installed distribution.

    Attributes:
        root: the directory or archive that it is in.
        read: returns the text of one of its files, such as `entry_points.txt`; None: it has no such file.
    """

    root: str
    read: Callable[[str], str | None]

    def header(self, key: str) -> str:
        """Return a value of the header of its metadata, such as `Name`.

        Raises:
            ValueError: it is missing.
        """
        for line in (self.read("METADATA") or self.read("PKG-INFO") or "").splitlines():
            if not line:
                break  # its description follows
            name, colon, value = line.partition(":")
            if colon and name.lower() == key.lower():
                return value.strip()
        raise ValueError(f"its metadata has no {key}")


def distributions() -> Iterator[Distribution]:
    """Yield all distributions, in the order of `sys.path`; one may occur twice."""
    if not _are_all_in_directories():
        from importlib import metadata  # see above

        for found in metadata.distributions():
            yield Distribution(str(found.locate_file("")), found.read_text)
        return
    for root in sys.path:
        try:
            names = os.listdir(root or ".")
        except OSError:
            continue  # an import skips missing directories too
        for name in names:
            if name.lower().endswith(_INFO):
                yield Distribution(root, partial(_read, os.path.join(root, name)))


def _are_all_in_directories() -> bool:
    if any(hasattr(finder, "find_distributions") and finder is not PathFinder for finder in sys.meta_path):
        return False
    return not any(path.endswith(".egg") or os.path.isfile(path) for path in sys.path)


def _read(directory: str, name: str) -> str | None:
    try:
        with open(os.path.join(directory, name), encoding="utf-8") as file:
            return file.read()
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return None


class EntryPoint(NamedTuple):
    """One entry point.

    Attributes:
        group: its group, such as `pancakes.tasks`.
        name: its name.
        place: `module:attribute`.
    """

    group: str
    name: str
    place: str


def points_in(text: str) -> Iterator[EntryPoint]:
    """Yield the entry points that the text of an `entry_points.txt` states.

    Raises:
        ValueError: a line is not an entry point.
    """
    group = ""
    for line in map(str.strip, text.splitlines()):
        if line.startswith("[") and line.endswith("]"):
            group = line[1:-1].strip()
        elif line and not line.startswith("#"):
            name, equals, place = map(str.strip, line.partition("="))
            if not equals:
                raise ValueError(f"{line!r} is not an entry point")
            yield EntryPoint(group, name, place)


def load(place: str) -> Any:
    """Import the object of an entry point; that may raise anything."""
    module, _, path = place.partition("[")[0].partition(":")  # extras are in brackets
    return reduce(getattr, filter(None, path.strip().split(".")), import_module(module.strip()))
