"""The wheels of a deployment: those of Pancakes and its plug-ins, and what they need on a host."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import stat
import subprocess
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from email.message import Message
from email.parser import Parser
from importlib.metadata import Distribution, PackageNotFoundError, distributions
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Final
from urllib.parse import unquote, urlsplit

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from pancakes.errors import PancakesError
from pancakes.util.files import user_folder
from pancakes.util.plugins import GROUPS
from pancakes.util.toml import toml_values

PIP: Final = "pip"
CORE: Final = "pancakes-agents"
"""The distribution of Pancakes itself."""
ORIGIN: Final = "direct_url.json"
"""The file of an installed distribution that says where it came from, unless from an index."""
OLDEST_GLIBC: Final = 17
"""No wheel is for an older glibc than 2.17."""
_OLD_NAMES: Final = ("manylinux2014", "manylinux2010", "manylinux1")
MOST_KEPT: Final = 40
"""So many builds and sets of libraries are kept on this machine, the last ones that were used."""
UNREACHED: Final = re.compile(
    r"connection broken by|NewConnectionError|ConnectTimeoutError|Failed to establish a new connection"
    r"|Name or service not known|Temporary failure in name resolution|ProxyError|Network is unreachable"
)
"""How pip says that it cannot reach an index; that it has found nothing there follows from that."""
_LEFT_OUT: Final = shutil.ignore_patterns(".*", "venv", "build", "dist", "runs", "*.egg-info", "__pycache__")


@dataclass(frozen=True, order=True)
class Wheel:
    """One wheel on this machine.

    Attributes:
        path: the file.
        digest: a digest of what is in it. When it was built does not count: a build of the same sources is the same.
        unpacked_bytes: the size of what is in it.
    """

    path: Path
    digest: str
    unpacked_bytes: int

    @property
    def name(self) -> str:
        """The name of the file."""
        return self.path.name


@dataclass(frozen=True)
class Platform:
    """What a wheel has to be made for.

    Attributes:
        python: the minor version, `3.11`.
        tags: the platforms of wheels that run there, the best first.
    """

    python: str
    tags: tuple[str, ...]

    @classmethod
    def of(cls, python: Sequence[int], platform: str, libc: Sequence[str]) -> Platform:
        """Return that of a host.

        Args:
            python: its version.
            platform: as `sysconfig.get_platform` says it, such as `linux-aarch64`.
            libc: as `platform.libc_ver` says it, such as `("glibc", "2.36")`.

        Raises:
            PancakesError: it is no Linux.
        """
        return cls(f"{python[0]}.{python[1]}", tuple(_tags(platform, libc)))


def wheel_at(path: Path) -> Wheel:
    """Return a wheel.

    Raises:
        PancakesError: the file is none.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            files = sorted(archive.infolist(), key=lambda it: it.filename)
            whole = hashlib.sha256()
            for file in files:
                data = archive.read(file)
                if file.filename.endswith(".dist-info/RECORD"):
                    data = b"\n".join(sorted(data.splitlines()))  # its order is that in which files were found
                told = f"{file.filename}\n{file.external_attr >> 16 & stat.S_IXUSR}\n"
                whole.update(told.encode() + hashlib.sha256(data).digest())
    except (OSError, zipfile.BadZipFile, zlib.error) as error:
        raise PancakesError(f"{path} is no wheel: {error}") from None
    return Wheel(path, whole.hexdigest()[:16], sum(file.file_size for file in files))


def given_wheels(paths: Iterable[Path]) -> list[Wheel]:
    """Return the wheels that a person has named, or that lie in a folder which that person has named.

    Raises:
        PancakesError: there are none, or none of Pancakes is among them, or two of one distribution.
    """
    files: list[Path] = []
    for path in paths:
        found = sorted(path.glob("*.whl")) if path.is_dir() else [path]
        if not found:
            raise PancakesError(f"{path} has no wheels in it: scripts/release puts them into dist")
        files += found
    wheels = [wheel_at(path) for path in dict.fromkeys(files)]
    by_name: dict[str, Wheel] = {}
    for wheel in wheels:
        name = distribution_of(wheel)
        if name in by_name:
            raise PancakesError(f"{by_name[name].path} and {wheel.path} are both of {name}: name one of them")
        by_name[name] = wheel
    if CORE not in by_name:
        raise PancakesError(f"no wheel of {CORE} is among {', '.join(map(str, paths))}: name it as well")
    return wheels


def installed_wheels(folder: Path) -> list[Wheel]:
    """Make wheels of the Pancakes that is installed here, and of the plug-ins beside it.

    A clone or a folder that is installed as such is built as it is now; what came from an index is fetched from there.
    What was built or fetched before is taken again.

    Args:
        folder: where they go.

    Raises:
        PancakesError: one cannot be made.
    """
    for number, own in enumerate(_own_distributions()):
        source = _source_of(own)
        name, version = own.metadata["Name"], own.version
        if source is None:
            wanted = f"{name}=={version}"
            command = ["download", "--no-deps", "--only-binary=:all:", wanted, "--dest"]
            shutil.copytree(_kept("wheels", wanted, command, name), folder, dirs_exist_ok=True)
            continue
        if source.suffix == ".whl" and source.is_file():
            shutil.copy(source, folder)
            continue
        if not source.is_dir():
            raise PancakesError(f"{name} is installed from {source}, which is gone: name its wheel with --wheels")
        copy = folder / f"source-{number}"
        shutil.copytree(source, copy, symlinks=True, ignore=_LEFT_OUT)  # nothing of an older build gets in
        isolation = ["--no-build-isolation"] if _is_built_with_what_is_here(source) else []
        command = ["wheel", *isolation, "--no-deps", str(copy), "--wheel-dir"]
        shutil.copytree(_kept("wheels", _digest_of_tree(copy), command, name), folder, dirs_exist_ok=True)
        shutil.rmtree(copy)
    return [wheel_at(path) for path in sorted(folder.glob("*.whl"))]


def libraries_for(own: Sequence[Wheel], extras: Sequence[str], platform: Platform, anew: bool = False) -> list[Wheel]:
    """Return the wheels that some wheels need on a platform, with that of pip, which installs them there.

    They are fetched once and kept, so that a fleet keeps the libraries that it has as long as it needs the same.

    Args:
        own: the wheels of Pancakes and its plug-ins.
        extras: those of Pancakes that are installed with it.
        platform: the platform.
        anew: whether newer ones are looked for.

    Raises:
        PancakesError: one cannot be had for that platform.
    """
    needs = [line for wheel in own for line in (distribution_of(wheel), *_metadata(wheel).get_all("Requires-Dist", []))]
    told = "\n".join([platform.python, *platform.tags, *sorted(extras), *needs])
    command = _download(own, extras, platform)
    folder = _kept("libraries", told, command, f"Python {platform.python} on {platform.tags[-1]}", anew)
    mine = {distribution_of(wheel) for wheel in own}
    return [wheel for path in sorted(folder.glob("*.whl")) if distribution_of(wheel := wheel_at(path)) not in mine]


def _kept(kind: str, told: str, command: Sequence[str], about: str, anew: bool = False) -> Path:
    """Return a folder with wheels that `pip` has put there, now or before.

    Args:
        kind: the folder that is for this kind of wheels.
        told: what they follow from.
        command: the command that puts them into the folder that is named after it.
        about: what they are for, for people.
        anew: whether they are made again.
    """
    base = _cache() / kind
    folder = base / hashlib.sha256(f"{told}\n{sys.version_info[:2]}".encode()).hexdigest()[:16]
    if anew or not folder.exists():
        base.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=base, prefix=".new-") as made:
            _pip([*command, made], about)
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(made, folder)
        for old in sorted(base.glob("[0-9a-f]*"), key=lambda it: it.stat().st_mtime)[:-MOST_KEPT]:
            shutil.rmtree(old, ignore_errors=True)
    os.utime(folder)
    return folder


def _digest_of_tree(folder: Path) -> str:
    whole = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            whole.update(f"{path.relative_to(folder)}\n{path.stat().st_mode & stat.S_IXUSR}\n".encode())
            whole.update(hashlib.sha256(path.read_bytes()).digest())
    return whole.hexdigest()


def _download(own: Sequence[Wheel], extras: Sequence[str], platform: Platform) -> list[str]:
    """Return the command that fetches what some wheels need; the folder for it comes last."""
    major, minor = platform.python.split(".")
    options = ["--only-binary=:all:", "--python-version", platform.python]
    options += ["--implementation", "cp", "--abi", f"cp{major}{minor}", "--abi", "abi3", "--abi", "none"]
    for tag in platform.tags:
        options += ["--platform", tag]
    wanted = [
        f"{wheel.path}[{','.join(extras)}]" if extras and distribution_of(wheel) == CORE else str(wheel.path)
        for wheel in own
    ]
    return ["download", *options, PIP, *wanted, "--dest"]


def _cache() -> Path:
    return user_folder("XDG_CACHE_HOME", ".cache", "what pip brings") / "pancakes"


def build_of(own: Sequence[Wheel]) -> str:
    """Return a name for some wheels of Pancakes and plug-ins: the version, and a digest of all that is in them."""
    whole = hashlib.sha256()
    version = ""
    for wheel in sorted(own, key=lambda it: it.name):
        with zipfile.ZipFile(wheel.path) as archive:
            (record,) = [name for name in archive.namelist() if name.endswith(".dist-info/RECORD")]
            whole.update(b"\n".join(sorted(archive.read(record).splitlines())))
        if distribution_of(wheel) == CORE:
            version = wheel.name.split("-")[1]
    return f"{version}-{whole.hexdigest()[:12]}"


def digests(wheels: Iterable[Wheel]) -> dict[str, str]:
    """Return the digests of wheels, by file."""
    return {wheel.name: wheel.digest for wheel in wheels}


def name_of(prefix: str, *parts: str, wheels: Iterable[Wheel]) -> str:
    """Return a name for what is made of wheels: another one where one of them, or one of `parts`, is another."""
    told = [*parts, *(f"{name} {digest}" for name, digest in sorted(digests(wheels).items()))]
    return f"{prefix}-{hashlib.sha256(chr(10).join(told).encode()).hexdigest()[:12]}"


def distribution_of(wheel: Wheel) -> str:
    """Return the name of the distribution that a wheel is of."""
    return distribution_of_file(wheel.name)


def distribution_of_file(name: str) -> str:
    """Return the name of the distribution that a wheel is of, by its file."""
    return str(canonicalize_name(name.split("-")[0]))


def version_of_file(name: str) -> str:
    """Return the version of a wheel, by its file."""
    return name.split("-")[1]


def extras_of(wheel: Wheel) -> list[str]:
    """Return the extras that a wheel has."""
    return list(_metadata(wheel).get_all("Provides-Extra", []))


def _metadata(wheel: Wheel) -> Message:
    with zipfile.ZipFile(wheel.path) as archive:
        (name,) = [it for it in archive.namelist() if it.endswith(".dist-info/METADATA")]
        return Parser().parsestr(archive.read(name).decode())


def _own_distributions() -> list[Distribution]:
    """Return Pancakes, and what brings plug-ins for it, each once."""
    found: dict[str, Distribution] = {}
    for it in distributions():
        name = str(canonicalize_name(it.metadata["Name"] or ""))
        if name == CORE or any(entry.group in GROUPS for entry in it.entry_points):
            known = found.setdefault(name, it)
            if known.read_text(ORIGIN) is None and it.read_text(ORIGIN) is not None:
                found[name] = it  # the other is what lies in the working directory
    return list(found.values())


def _source_of(installed: Distribution) -> Path | None:
    """Return the folder, or the wheel, from which a distribution was installed; None: it came from an index."""
    told = installed.read_text(ORIGIN)
    if told is None:
        # It lies beside its sources then, as `setup.py develop` leaves it.
        is_source = installed.read_text("METADATA") is None
        return Path(str(installed.locate_file(""))) if is_source else None
    url = str(json.loads(told)["url"])
    return Path(unquote(urlsplit(url).path)) if url.startswith("file:") else None


def _is_built_with_what_is_here(source: Path) -> bool:
    """Return whether all is installed here that builds a source, so that nothing has to be fetched for that."""
    try:
        table = toml_values((source / "pyproject.toml").read_text())["build-system"]
        wanted = [Requirement(text) for text in table["requires"]]
        # An older one needs a further library to make wheels.
        wanted += [Requirement("setuptools>=70.1")] if any(it.name == "setuptools" for it in wanted) else []
        return all(it.specifier.contains(version_of(it.name), prereleases=True) for it in wanted)
    except (OSError, ValueError, KeyError, PackageNotFoundError):
        return False


def _tags(platform: str, libc: Sequence[str]) -> Iterator[str]:
    system, _, machine = platform.partition("-")
    if system != "linux":
        raise PancakesError(f"agents run only on Linux, not on {platform}")
    kind, version = libc[0], (libc[1] or "0.0").split(".")
    if kind == "glibc":
        for minor in range(int(version[1]), OLDEST_GLIBC - 1, -1):
            yield f"manylinux_2_{minor}_{machine}"
        for name in _OLD_NAMES:
            yield f"{name}_{machine}"
    else:
        yield from (f"musllinux_1_{minor}_{machine}" for minor in (2, 1))
    yield f"linux_{machine}"


def _pip(words: Sequence[str], about: str) -> None:
    command = [sys.executable, "-m", "pip", *words, "--quiet", "--disable-pip-version-check", "--no-input"]
    done = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    if done.returncode == 0:
        return
    if UNREACHED.search(done.stdout + done.stderr):
        advice = "connect this machine to it once; what was fetched before is kept"
        raise PancakesError(f"no wheels can be had for {about}: the package index cannot be reached: {advice}")
    lines = [line.strip() for line in (done.stderr or done.stdout).splitlines() if line.strip()]
    # Where pip fails by itself, as when a network goes, it ends with the error.
    said = [line for line in lines if line.startswith("ERROR:") and line != "ERROR: Exception:"]
    said = said or lines[-1:] or ["pip does not say why"]
    raise PancakesError(f"no wheels can be had for {about}: " + " ".join(said))
