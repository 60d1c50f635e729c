"""The wheels of a deployment, and the names of builds."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest
from deploy.plugin_wheels import plugin_wheel

from pancakes.errors import PancakesError
from pancakes.tools.deploy.wheels import (
    Platform,
    build_of,
    distribution_of,
    extras_of,
    given_wheels,
    libraries_for,
    name_of,
    wheel_at,
)


def core(folder: Path, text: str = "", requires: str = "") -> Path:
    """Write a wheel that bears the name of Pancakes."""
    folder.mkdir(exist_ok=True)
    path = folder / "pancakes_agents-9.0-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("pancakes/__init__.py", text)
        metadata = f"Metadata-Version: 2.1\nName: pancakes-agents\nVersion: 9.0\nProvides-Extra: record\n{requires}"
        archive.writestr("pancakes_agents-9.0.dist-info/METADATA", metadata)
        kind = "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        archive.writestr("pancakes_agents-9.0.dist-info/WHEEL", kind)
        archive.writestr("pancakes_agents-9.0.dist-info/RECORD", f"pancakes/__init__.py,{text},1\n")
    return path


def test_wheels_are_given_as_files_or_folder(tmp_path: Path):
    plugin_wheel(tmp_path / "dist", "1.0")
    core(tmp_path / "dist")
    wheels = given_wheels([tmp_path / "dist"])
    assert [distribution_of(wheel) for wheel in wheels] == ["pancakes-agents", "yard"]
    assert extras_of(wheels[0]) == ["record"]
    assert wheels[1].unpacked_bytes > 500


@pytest.mark.parametrize(
    ("names", "fault"),
    [
        (["empty"], "empty contains no wheels: scripts/release puts them into dist"),
        (["one/yard-1.0-py3-none-any.whl"], "no wheel of pancakes-agents is among "),
        (["core", "one", "two"], "are both of yard: name one of them"),
        (["core", "text.whl"], "text.whl is not a wheel: "),
    ],
)
def test_faulty_wheels_are_refused(tmp_path: Path, names: list[str], fault: str):
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.whl").write_text("no archive")
    plugin_wheel(tmp_path / "one", "1.0")
    plugin_wheel(tmp_path / "two", "2.0")
    core(tmp_path / "core")
    with pytest.raises(PancakesError) as raised:
        given_wheels([tmp_path / name for name in names])
    assert fault in str(raised.value)


def test_build_depends_on_files_and_not_on_times(tmp_path: Path):
    builds = [build_of([wheel_at(core(tmp_path / name, text))]) for name, text in (("1", "a"), ("2", "a"), ("3", "b"))]
    assert builds[0] == builds[1] != builds[2] and builds[0].startswith("9.0-")
    one, other = (wheel_at(core(tmp_path / name)) for name in ("1", "3"))
    assert name_of("py3.11", wheels=[one]) == name_of("py3.11", wheels=[one])
    assert name_of("py3.11", wheels=[one]) != name_of("py3.11", "x", wheels=[one])
    assert len({wheel_at(core(tmp_path / "4", text)).digest for text in "ab"}) == 2 and other.name == one.name


def test_rebuilt_wheel_has_the_same_digest(tmp_path: Path):
    first = wheel_at(core(tmp_path / "1"))
    with zipfile.ZipFile(first.path) as archive:
        files = {info.filename: archive.read(info) for info in archive.infolist()}
    later = tmp_path / first.name
    with zipfile.ZipFile(later, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in reversed(files.items()):
            archive.writestr(zipfile.ZipInfo(name, (2031, 5, 4, 3, 2, 2)), data)
    assert later.read_bytes() != first.path.read_bytes()
    assert wheel_at(later).digest == first.digest


def test_unreachable_index_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:1/simple")
    monkeypatch.setenv("PIP_RETRIES", "1")
    wheel = wheel_at(core(tmp_path / "core", requires="Requires-Dist: no-such-library-of-pancakes==1.0\n"))
    with pytest.raises(PancakesError, match=r"the package index cannot be reached: connect this machine"):
        libraries_for([wheel], [], Platform("3.11", ("linux_x86_64",)))


def test_platform_gives_the_wheel_tags():
    arm = Platform.of([3, 13, 1], "linux-aarch64", ["glibc", "2.19"])
    assert arm.python == "3.13"
    assert arm.tags[:4] == (
        "manylinux_2_19_aarch64",
        "manylinux_2_18_aarch64",
        "manylinux_2_17_aarch64",
        "manylinux2014_aarch64",
    )
    assert arm.tags[-1] == "linux_aarch64"
    assert Platform.of([3, 11], "linux-x86_64", ["", ""]).tags == (
        "musllinux_1_2_x86_64",
        "musllinux_1_1_x86_64",
        "linux_x86_64",
    )
    with pytest.raises(PancakesError, match="agents run only on Linux, not on macosx"):
        Platform.of([3, 12], "macosx-14.0-arm64", ["", ""])


def test_missing_library_for_a_platform_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    wheel = wheel_at(core(tmp_path / "core", requires="Requires-Dist: no-such-library-of-pancakes==1.0\n"))
    with pytest.raises(PancakesError) as raised:
        libraries_for([wheel], [], Platform("3.11", ("linux_sparc64",)))
    text = str(raised.value)
    assert text.startswith("no wheels for Python 3.11 on linux_sparc64: ERROR: ")
    assert "no-such-library-of-pancakes" in text
    assert not list((tmp_path / "cache" / "pancakes" / "libraries").iterdir())
