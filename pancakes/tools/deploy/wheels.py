"""Collect the wheels of a deployment: those of Pancakes and its plug-ins, and their dependencies for a host."""

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
"""The file of an installed distribution that names its source, if it did not come from an index."""
OLDEST_GLIBC: Final = 17
"""The minor version of the oldest glibc with wheels: 2.17."""
_OLD_NAMES: Final = ("manylinux2014", "manylinux2010", "manylinux1")
MOST_KEPT: Final = 40
"""How many of the last used builds and sets of libraries are kept on this machine."""
UNREACHED: Final = re.compile(
    r"connection broken by|NewConnectionError|ConnectTimeoutError|Failed to establish a new connection"
    r"|Name or service not known|Temporary failure in name resolution|ProxyError|Network is unreachable"
)
"""Pip's messages if it cannot reach an index; its other errors, such as that it found nothing, follow from that."""
_LEFT_OUT: Final = shutil.ignore_patterns(".*", "venv", "build", "dist", "runs", "*.egg-info", "__pycache__")


@dataclass(frozen=True, order=True)
class Wheel:
    """One wheel on this machine.

    Attributes:
        path: the file.
        digest: the digest of its content, without the time of the build: another build of the same sources has the
            same digest.
        unpacked_bytes: the size of its content.
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
    """The Python version and platform of a host.

    Attributes:
        python: the minor version, `3.11`.
        tags: the platform tags of wheels that run there, the best first.
    """

    python: str
    tags: tuple[str, ...]

    @classmethod
    def of(cls, python: Sequence[int], platform: str, libc: Sequence[str]) -> Platform:
        """Return the platform of a host.

        Args:
            python: its Python version.
            platform: from `sysconfig.get_platform`, such as `linux-aarch64`.
            libc: from `platform.libc_ver`, such as `("glibc", "2.36")`.

        Raises:
            PancakesError: the host does not run Linux.
        """
        return cls(f"{python[0]}.{python[1]}", tuple(_tags(platform, libc)))


def wheel_at(path: Path) -> Wheel:
    """Read a wheel.

    Raises:
        PancakesError: the file is not a wheel.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            files = sorted(archive.infolist(), key=lambda it: it.filename)
            whole = hashlib.sha256()
            for file in files:
                data = archive.read(file)
                if file.filename.endswith(".dist-info/RECORD"):
                    data = b"\n".join(sorted(data.splitlines()))  # the order of its lines depends on the build
                head = f"{file.filename}\n{file.external_attr >> 16 & stat.S_IXUSR}\n"
                whole.update(head.encode() + hashlib.sha256(data).digest())
    except (OSError, zipfile.BadZipFile, zlib.error) as error:
        raise PancakesError(f"{path} is not a wheel: {error}") from None
    return Wheel(path, whole.hexdigest()[:16], sum(file.file_size for file in files))


def given_wheels(paths: Iterable[Path]) -> list[Wheel]:
    """Return the wheels at the given paths, which are files or folders.

    Raises:
        PancakesError: a folder has no wheels, Pancakes' wheel is missing, or two wheels are of one distribution.
    """
    files: list[Path] = []
    for path in paths:
        found = sorted(path.glob("*.whl")) if path.is_dir() else [path]
        if not found:
            raise PancakesError(f"{path} contains no wheels: scripts/release puts them into dist")
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
    """Make wheels of the installed Pancakes and its plug-ins.

    A distribution that was installed from a folder is built from its present files; one from an index is downloaded.
    Earlier builds and downloads are reused.

    Args:
        folder: the folder for the wheels.

    Raises:
        PancakesError: a wheel cannot be made.
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
        shutil.copytree(source, copy, symlinks=True, ignore=_LEFT_OUT)  # without files of an older build
        isolation = ["--no-build-isolation"] if _has_build_requirements(source) else []
        command = ["wheel", *isolation, "--no-deps", str(copy), "--wheel-dir"]
        shutil.copytree(_kept("wheels", _digest_of_tree(copy), command, name), folder, dirs_exist_ok=True)
        shutil.rmtree(copy)
    return [wheel_at(path) for path in sorted(folder.glob("*.whl"))]


def libraries_for(
    own: Sequence[Wheel], extras: Sequence[str], platform: Platform, upgrade: bool = False
) -> list[Wheel]:
    """Return the wheels of the dependencies for a platform, and pip's wheel, which installs them there.

    They are downloaded once and kept, so that a fleet keeps its libraries as long as its requirements do not change.

    Args:
        own: the wheels of Pancakes and its plug-ins.
        extras: the extras of Pancakes to install.
        platform: the platform.
        upgrade: whether to look for newer versions.

    Raises:
        PancakesError: a dependency has no wheel for the platform.
    """
    needs = [line for wheel in own for line in (distribution_of(wheel), *_metadata(wheel).get_all("Requires-Dist", []))]
    key = "\n".join([platform.python, *platform.tags, *sorted(extras), *needs])
    command = _download(own, extras, platform)
    folder = _kept("libraries", key, command, f"Python {platform.python} on {platform.tags[-1]}", upgrade)
    mine = {distribution_of(wheel) for wheel in own}
    return [wheel for path in sorted(folder.glob("*.whl")) if distribution_of(wheel := wheel_at(path)) not in mine]


def _kept(kind: str, key: str, command: Sequence[str], about: str, renew: bool = False) -> Path:
    """Return a cached folder with wheels; run `pip` to fill it if it does not exist.

    Args:
        kind: the name of the cache for this kind of wheels.
        key: identifies the folder in the cache.
        command: the arguments of `pip`, without the folder.
        about: what the wheels are for, for people.
        renew: whether to fill it again.
    """
    base = _cache() / kind
    folder = base / hashlib.sha256(f"{key}\n{sys.version_info[:2]}".encode()).hexdigest()[:16]
    if renew or not folder.exists():
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
    """Return the arguments of `pip` that download dependencies; the folder for them comes last."""
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
    return user_folder("XDG_CACHE_HOME", ".cache", "wheels from pip") / "pancakes"


def build_of(own: Sequence[Wheel]) -> str:
    """Return the name of a build of Pancakes and plug-ins: the version, and a digest of the wheels' content."""
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
    """Return a name that depends on all wheels and all `parts`, and begins with `prefix`."""
    lines = [*parts, *(f"{name} {digest}" for name, digest in sorted(digests(wheels).items()))]
    return f"{prefix}-{hashlib.sha256(chr(10).join(lines).encode()).hexdigest()[:12]}"


def distribution_of(wheel: Wheel) -> str:
    """Return the name of a wheel's distribution."""
    return distribution_of_file(wheel.name)


def distribution_of_file(name: str) -> str:
    """Return the name of a wheel's distribution, by its file name."""
    return str(canonicalize_name(name.split("-")[0]))


def version_of_file(name: str) -> str:
    """Return the version of a wheel, by its file name."""
    return name.split("-")[1]


def extras_of(wheel: Wheel) -> list[str]:
    """Return the extras of a wheel."""
    return list(_metadata(wheel).get_all("Provides-Extra", []))


def _metadata(wheel: Wheel) -> Message:
    with zipfile.ZipFile(wheel.path) as archive:
        (name,) = [it for it in archive.namelist() if it.endswith(".dist-info/METADATA")]
        return Parser().parsestr(archive.read(name).decode())


def _own_distributions() -> list[Distribution]:
    """Return the distributions of Pancakes and of its plug-ins, each once."""
    found: dict[str, Distribution] = {}
    for it in distributions():
        name = str(canonicalize_name(it.metadata["Name"] or ""))
        if name == CORE or any(entry.group in GROUPS for entry in it.entry_points):
            known = found.setdefault(name, it)
            if known.read_text(ORIGIN) is None and it.read_text(ORIGIN) is not None:
                found[name] = it  # the other one is only a folder in the working directory
    return list(found.values())


def _source_of(installed: Distribution) -> Path | None:
    """Return the folder or wheel that a distribution was installed from; None: it came from an index."""
    origin = installed.read_text(ORIGIN)
    if origin is None:
        # Without METADATA, it lies beside its sources, as `setup.py develop` leaves it.
        is_source = installed.read_text("METADATA") is None
        return Path(str(installed.locate_file(""))) if is_source else None
    url = str(json.loads(origin)["url"])
    return Path(unquote(urlsplit(url).path)) if url.startswith("file:") else None


def _has_build_requirements(source: Path) -> bool:
    """Return whether the build requirements of a source are installed here, so that none must be downloaded."""
    try:
        table = toml_values((source / "pyproject.toml").read_text())["build-system"]
        wanted = [Requirement(text) for text in table["requires"]]
        # An older setuptools needs another library to make wheels.
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
        advice = "connect this machine to it once; downloaded wheels are kept"
        raise PancakesError(f"no wheels for {about}: the package index cannot be reached: {advice}")
    lines = [line.strip() for line in (done.stderr or done.stdout).splitlines() if line.strip()]
    # If pip itself crashes, as when the network fails, its last line is the error.
    errors = [line for line in lines if line.startswith("ERROR:") and line != "ERROR: Exception:"]
    errors = errors or lines[-1:] or ["pip gives no reason"]
    raise PancakesError(f"no wheels for {about}: " + " ".join(errors))
