"""The page's own files, as they are sent to a browser."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from typing import Final

TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}


@dataclass(frozen=True, slots=True)
class StaticFile:
    """A file, and what kind of file it is."""

    type: str
    data: bytes


def static_files() -> dict[str, StaticFile]:
    """Returns the files by the path under which they are asked for; nothing else is ever sent."""
    found = {}
    for file in resources.files("pancakes.tools.web").joinpath("static").iterdir():
        suffix = file.name[file.name.rfind(".") :]
        if suffix in TYPES:
            found[f"/{file.name}"] = StaticFile(TYPES[suffix], file.read_bytes())
    found["/"] = found["/index.html"]
    return found
