"""What `--json FILE` of each command writes: its figures, for programs."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

_F = TypeVar("_F", bound=Callable[..., Any])


def json_option(command: _F) -> _F:
    """Gives a command the option `--json FILE`, as its argument `json_file`."""
    kind = click.Path(dir_okay=False, path_type=Path)
    return click.option("--json", "json_file", type=kind, help="Write the figures to this file too.")(command)


def write(json_file: Path | None, figures: dict[str, Any]) -> None:
    """Writes figures, where a file was named."""
    if json_file is not None:
        json_file.write_text(json.dumps(figures, indent=2, default=list) + "\n")


def spread(values: Sequence[float]) -> dict[str, float]:
    """Returns the least, the middle and the greatest of some values; nothing of none."""
    ordered = sorted(values)
    if not ordered:
        return {}
    return {"least": ordered[0], "median": ordered[len(ordered) // 2], "most": ordered[-1]}
