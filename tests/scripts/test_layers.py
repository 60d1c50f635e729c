"""Each module of Pancakes stands in one of the layers that import-linter checks."""

from configparser import ConfigParser
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def layers() -> list[str]:
    parser = ConfigParser()
    parser.read(ROOT / "setup.cfg")
    lines = parser["importlinter:contract:layers"]["layers"].split("\n")
    return [name.strip() for line in lines for name in line.split(":") if name.strip()]


def modules() -> list[str]:
    files = [file.relative_to(ROOT) for file in (ROOT / "pancakes").rglob("*.py")]
    return [".".join(file.with_suffix("").parts) for file in files if file.name != "__init__.py"]


def test_each_module_stands_in_one_layer():
    known = layers()
    outside = [
        module for module in modules() if sum(module == name or module.startswith(f"{name}.") for name in known) != 1
    ]
    assert not outside, f"setup.cfg names no layer for {', '.join(outside)}"
