"""The files that a report's page is made of."""

from __future__ import annotations

from importlib import resources


def static_text(name: str) -> str:
    """Returns the text of a file in `static`."""
    return resources.files("pancakes.tools.report").joinpath("static", name).read_text(encoding="utf-8")
