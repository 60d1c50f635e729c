"""What `--json FILE` of each command writes: its figures, for programs."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

_F = TypeVar("_F", bound=Callable[..., Any])


class _FileToCome(click.Path):
    """A file that can be written in the end: nobody is to learn only then that it cannot."""

    def __init__(self) -> None:
        super().__init__(dir_okay=False, writable=True)

    def convert(self, value: Any, parameter: click.Parameter | None, context: click.Context | None) -> Any:
        path = Path(str(super().convert(value, parameter, context)))
        if not path.parent.is_dir():
            self.fail(f"there is no directory {str(path.parent)!r} for it.", parameter, context)
        if not path.exists() and not os.access(path.parent, os.W_OK):
            self.fail(f"nothing can be written to the directory {str(path.parent)!r}.", parameter, context)
        return path


def json_option(command: _F) -> _F:
    """Gives a command the option `--json FILE`, as its argument `json_file`."""
    text = "Write the figures to this file too."
    return click.option("--json", "json_file", type=_FileToCome(), metavar="FILE", help=text)(command)


def write(json_file: Path | None, figures: Any) -> None:
    """Writes figures, where a file was named."""
    if json_file is not None:
        text = json.dumps(figures, indent=1, default=list, ensure_ascii=False)
        json_file.write_text(f"{text}\n", encoding="utf-8")


def spread(values: Sequence[float]) -> dict[str, float]:
    """Returns the least, the middle and the greatest of some values; nothing of none."""
    ordered = sorted(values)
    if not ordered:
        return {}
    return {"least": ordered[0], "median": ordered[len(ordered) // 2], "most": ordered[-1]}
