"""The names of the program, and what `--version` prints: the version, and the commit if it is not a release."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

import click

import pancakes

PROGRAM: Final = "pancakes"
VARIABLE: Final = "_PANCAKES_COMPLETE"
"""The environment variable with which a shell asks for completions."""


_Command = TypeVar("_Command", bound=Callable[..., Any])
_PACKAGE: Final = Path(pancakes.__file__).parent
WRITTEN: Final = "commit.txt"
"""The file of the package that holds the commit of a wheel that is not a release; `scripts/release` writes it."""


def version_text(package: Path = _PACKAGE) -> str:
    """Return the version, and the commit if the package is not of a release.

    Args:
        package: the folder of the package.
    """
    try:
        commit = (package / WRITTEN).read_text().strip()
    except OSError:
        commit = _commit_of_clone(package.parent)
    return f"{pancakes.__version__}, not released: commit {commit}" if commit else pancakes.__version__


def _commit_of_clone(root: Path) -> str:
    """Return the commit of a clone, and whether it has changes; empty if this is a release or not a clone."""
    if not (root / ".git").exists():
        return ""
    commit = _git(root, "rev-parse", "--short=12", "HEAD")
    changes = _git(root, "status", "--porcelain", "--untracked-files=no")
    if not changes and f"v{pancakes.__version__}" in _git(root, "tag", "--points-at", "HEAD").split():
        return ""
    return f"{commit} with changes" if changes else commit


def _git(root: Path, *arguments: str) -> str:
    import subprocess  # late import: it would slow each start of an agent

    try:
        found = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, timeout=10.0)
    except (OSError, subprocess.TimeoutExpired):  # git is missing
        return ""
    return found.stdout.strip() if found.returncode == 0 else ""


def version_option(program: str) -> Callable[[_Command], _Command]:
    """Give a command the option `--version`."""

    def show(context: click.Context, parameter: click.Parameter, wanted: bool) -> None:
        if wanted and not context.resilient_parsing:
            from pancakes.tools.cli.output import show_text

            show_text(f"{program}, version {version_text()}")
            context.exit()

    return click.option(
        "--version", is_flag=True, is_eager=True, expose_value=False, callback=show, help="Show the version and exit."
    )
