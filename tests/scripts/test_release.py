"""The checks of a release name each fault of a wheel or a source distribution."""

from __future__ import annotations

import importlib.util
import io
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
METADATA = "Metadata-Version: 2.1\nName: {name}\nVersion: {version}\nLicense: MIT\nRequires-Python: >=3.11\n"
SOURCES = ("pancakes/__init__.py", "pancakes/task.py")
SOUND = {"pancakes/__init__.py": "", "pancakes/task.py": "", "pancakes_agents-1.0.dist-info/LICENSE": "MIT"}


def wheel(folder: Path, files: dict[str, str], name: str = "pancakes-agents", version: str = "1.0") -> Path:
    """Write a wheel."""
    stem = f"{name.replace('-', '_')}-{version}"
    path = folder / f"{stem}-py3-none-any.whl"
    metadata = METADATA.format(name=name, version=version)
    with zipfile.ZipFile(path, "w") as archive:
        for inside, text in {**files, f"{stem}.dist-info/METADATA": metadata}.items():
            archive.writestr(inside, text)
    return path


def sdist(folder: Path, names: tuple[str, ...] = ("LICENSE", "README.md", "setup.cfg", "PKG-INFO")) -> Path:
    """Write a source distribution."""
    path = folder / "pancakes_agents-1.0.tar.gz"
    with tarfile.open(path, "w:gz") as archive:
        for name in names:
            archive.addfile(tarfile.TarInfo(f"pancakes_agents-1.0/{name}"), io.BytesIO())
    return path


def faults(wheels: list[Path], sdists: list[Path]) -> list[str]:
    """Return the faults that are found."""
    spec = importlib.util.spec_from_file_location("release_checks", ROOT / "scripts" / "lib" / "release_checks.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found: list[str] = module.faults_of(wheels, sdists, SOURCES)
    return found


def test_valid_release_has_no_fault(tmp_path: Path):
    assert faults([wheel(tmp_path, SOUND)], [sdist(tmp_path)]) == []


@pytest.mark.parametrize(
    ("left_out", "added", "fault"),
    [
        ("pancakes/task.py", "", "no wheel has pancakes/task.py"),
        ("pancakes_agents-1.0.dist-info/LICENSE", "", "it has no LICENSE"),
        ("", "tests/test_task.py", "it has tests/test_task.py, which belongs to no package"),
        ("", "pancakes/__pycache__/task.pyc", "it has pancakes/__pycache__/task.pyc, which belongs to no package"),
    ],
)
def test_missing_and_extra_files_of_a_wheel_are_named(tmp_path: Path, left_out: str, added: str, fault: str):
    files = {name: text for name, text in SOUND.items() if name != left_out} | ({added: ""} if added else {})
    (found,) = faults([wheel(tmp_path, files)], [sdist(tmp_path)])
    assert found.endswith(fault)


def test_plugin_has_the_projects_version_and_requires_it(tmp_path: Path):
    plugin = {"pancakes/more.py": "", "pancakes_field-1.1.dist-info/LICENSE": "MIT"}
    wheels = [wheel(tmp_path, SOUND), wheel(tmp_path, plugin, "pancakes-field", "1.1")]
    assert faults(wheels, [sdist(tmp_path)]) == [
        "there are 2 wheels and 1 source distributions",
        "the wheels have different versions: 1.0, 1.1",
        "pancakes_field-1.1-py3-none-any.whl: it does not require pancakes-agents",
    ]


def test_missing_files_of_a_source_distribution_are_named(tmp_path: Path):
    found = faults([wheel(tmp_path, SOUND)], [sdist(tmp_path, ("README.md", "setup.cfg", "PKG-INFO"))])
    assert found == ["pancakes_agents-1.0.tar.gz: it has no LICENSE"]
