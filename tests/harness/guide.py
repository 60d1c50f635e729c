"""The guides and their examples, and how to run the commands of one as `scripts/readme` does."""

from __future__ import annotations

import importlib.util
import re
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 60.0
_TYPED = re.compile(r"^\w*\$ (.*)$")
_UNMARKED = re.compile(r"^(?:pancakes|scripts/)")


class Example(NamedTuple):
    """A fenced block of a guide.

    Attributes:
        guide: the guide's path in the project.
        line: the line that the block begins at.
        info: what stands behind its fence, such as `python` or `sh background`.
        text: the block.
    """

    guide: str
    line: int
    info: str
    text: str

    @property
    def language(self) -> str:
        return self.info.partition(" ")[0]

    @property
    def commands(self) -> list[str]:
        """What a reader types: all of a block `sh`; in others what follows a prompt, or begins with `pancakes`."""
        if self.language == "sh":
            found = _readme().blocks(f"```sh\n{self.text}```\n")
            return [statement.text for block in found for statement in _readme().statements(block)]
        if self.language not in ("console", ""):
            return []
        prompted = [match[1] for line in self.text.splitlines() if (match := _TYPED.match(line))]
        return prompted or [line for line in self.text.splitlines() if not self.language and _UNMARKED.match(line)]

    def __str__(self) -> str:
        return f"{self.guide}:{self.line}"


def guides() -> list[str]:
    """Returns the paths of all guides in the project, without the reference, which is generated."""
    found = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "how-to").glob("*.md")]
    found += [*(ROOT / "plugins").glob("*/README.md")]
    return sorted(path.relative_to(ROOT).as_posix() for path in found)


@cache
def examples(guide: str) -> tuple[Example, ...]:
    """Returns the fenced blocks of a guide, in their order."""
    blocks = _readme().blocks((ROOT / guide).read_text(encoding="utf-8"))
    return tuple(Example(guide, block.line, block.info, block.text) for block in blocks)


def example(guide: str, begin: str) -> Example:
    """Returns the only block of a guide whose text, or whose first command, begins with `begin`."""
    found = [it for it in examples(guide) if it.text.startswith(begin) or (it.commands or [""])[0].startswith(begin)]
    assert len(found) == 1, f"{guide} has {len(found)} blocks that begin with {begin!r}"
    return found[0]


def run_guide(guide: Path, place: Path) -> None:
    """Saves the files of a guide, runs its commands in a folder of their own, and fails where one of them does.

    Args:
        guide: the text.
        place: a folder for all that is made.
    """
    readme = _readme()
    found = readme.blocks(guide.read_text())
    folder = place / "folder"
    for made in (folder, place / "home"):
        made.mkdir()
    (place / "run").mkdir(mode=0o700)
    (place / "venv").symlink_to(sys.prefix)
    for block in found:
        kind, _, name = block.info.partition(" ")
        if name and block.info not in (readme.BACKGROUND, readme.OUTPUT):
            assert kind and "/" not in name
            (folder / name).write_text(block.text)
    failures = readme.run(readme.commands(found), guide.name, folder, place, LIMIT_S)
    assert failures == []


@cache
def _readme() -> ModuleType:
    lib = ROOT / "scripts" / "lib"
    sys.path.insert(0, str(lib))
    try:
        spec = importlib.util.spec_from_file_location("readme_of_scripts", lib / "readme.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module
        spec.loader.exec_module(module)
        return module
    finally:
        sys.path.remove(str(lib))
