"""Check the files of a release. Needs only Python."""

from __future__ import annotations

import tarfile
import zipfile
from collections.abc import Collection, Iterable, Sequence
from email.parser import Parser
from pathlib import Path, PurePosixPath

CORE = "pancakes-agents"
LICENCE = "MIT"


def faults_of(wheels: Sequence[Path], sdists: Sequence[Path], sources: Collection[str]) -> list[str]:
    """Return a sentence for each fault of the files of a release.

    Args:
        wheels: the wheels; one is that of the project, the others are its plug-ins'.
        sdists: the source distributions.
        sources: the files of all packages, each as a wheel has it: `pancakes/task.py`.
    """
    faults = []
    if len(wheels) != len(sdists):
        faults.append(f"there are {len(wheels)} wheels and {len(sdists)} source distributions")
    versions = {metadata_of(wheel)["Version"] for wheel in wheels}
    if len(versions) != 1:
        faults.append(f"the wheels have different versions: {', '.join(sorted(versions))}")
    packages, packed = {source.partition("/")[0] for source in sources}, set[str]()
    for wheel in wheels:
        faults += [f"{wheel.name}: {fault}" for fault in faults_of_wheel(wheel, packages)]
        packed |= set(names_in(wheel))
    faults += [f"no wheel has {source}" for source in sorted(set(sources) - packed)]
    for sdist in sdists:
        faults += [f"{sdist.name}: {fault}" for fault in faults_of_sdist(sdist)]
    return faults


def faults_of_wheel(wheel: Path, packages: Collection[str]) -> list[str]:
    """Return the faults of one wheel, each as a clause.

    Args:
        wheel: the wheel.
        packages: the packages of the release.
    """
    metadata, names = metadata_of(wheel), names_in(wheel)
    faults = []
    if LICENCE not in (metadata["License"], metadata["License-Expression"]):
        faults.append(f"its metadata does not name the licence {LICENCE}")
    if not any(PurePosixPath(name).name == "LICENSE" for name in names):
        faults.append("it has no LICENSE")
    if not metadata["Requires-Python"]:
        faults.append("its metadata does not name the Python that it needs")
    if metadata["Name"] != CORE and not any(it.startswith(CORE) for it in metadata.get_all("Requires-Dist", [])):
        faults.append(f"it does not require {CORE}")
    own = f"{'-'.join(wheel.name.split('-')[:2])}.dist-info"
    for name in names:
        parts = PurePosixPath(name).parts
        if parts[0] not in {*packages, own} or "__pycache__" in parts:
            faults.append(f"it has {name}, which belongs to no package")
    return faults


def faults_of_sdist(sdist: Path) -> list[str]:
    """Return the faults of one source distribution, each as a clause."""
    with tarfile.open(sdist) as archive:
        names = {"/".join(PurePosixPath(name).parts[1:]) for name in archive.getnames()}
    return [f"it has no {name}" for name in ("LICENSE", "README.md", "setup.cfg", "PKG-INFO") if name not in names]


def metadata_of(wheel: Path) -> object:
    """Return the metadata of a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [it for it in archive.namelist() if it.endswith(".dist-info/METADATA")]
        return Parser().parsestr(archive.read(name).decode())


def names_in(wheel: Path) -> list[str]:
    """Return the names of a wheel's files."""
    with zipfile.ZipFile(wheel) as archive:
        return archive.namelist()


def packaged(root: Path, packages: Iterable[str]) -> list[str]:
    """Return the files of packages below a folder, as a wheel has them."""
    return [
        str(path.relative_to(root))
        for package in packages
        for path in sorted((root / package).rglob("*"))
        if path.is_file() and "__pycache__" not in path.parts
    ]
