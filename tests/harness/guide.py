"""Runs the commands of a guide in the environment of the tests, as `scripts/readme` does in a fresh one."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 60.0


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
