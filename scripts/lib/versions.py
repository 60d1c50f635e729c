"""Run the fast tests on each Python of this machine with the newest versions of Pancakes' requirements, and on the
oldest Python with the lowest versions that setup.cfg allows. Needs only Python.

    scripts/test-versions                          # all of them
    scripts/test-versions lowest-3.11 newest-3.13  # only these
    scripts/test-versions newest-3.12 -- tests/kernel -x

Arguments after `--` go to pytest, in place of `--sets fast`. Each environment is kept in `.venvs/` and made again when
the metadata of the project changes. uv makes them: an installed uv, or else one that pip installs into `.venvs/uv`. No
Python is ever downloaded: missing versions are named at the end.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from environment import ROOT, digest

VENVS = ROOT / ".venvs"
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
WORKERS = 2
LIMIT_S = 1800.0
MOST_REASONS = 3
IGNORED = ("-W", "ignore::DeprecationWarning")
"""Old versions of one library may use functions that are deprecated in new versions of another."""


class Row(NamedTuple):
    """The result of one environment."""

    name: str
    python: str
    result: str
    good: bool
    remarks: tuple[str, ...] = ()


def main() -> int:
    """Make the environments, run the tests in each, and print a table."""
    names, options = chosen()
    pythons = {version: python_of(version) for version in PYTHONS}
    found = [version for version, path in pythons.items() if path]
    if not found:
        sys.exit("This machine has none of the Pythons " + ", ".join(PYTHONS) + ".")
    wanted = names or [f"lowest-{found[0]}", *(f"newest-{version}" for version in found)]
    rows = []
    for name in wanted:
        resolution, _, version = name.partition("-")
        if resolution not in ("lowest", "newest") or version not in PYTHONS:
            sys.exit(f"{name} is not an environment: `lowest-` or `newest-`, and one of {', '.join(PYTHONS)}")
        if not pythons[version]:
            rows.append(Row(name, "-", "left out", False, (f"Python {version} is not on this machine",)))
            continue
        rows.append(row_of(name, pythons[version], options))
    missing = [version for version in PYTHONS if not pythons[version] and not names]
    rows += [Row(f"newest-{it}", "-", "left out", True, (f"Python {it} is not on this machine",)) for it in missing]
    show(rows)
    return 0 if all(row.good for row in rows) else 1


def chosen() -> tuple[list[str], list[str]]:
    """Return the requested environments, and the arguments of pytest."""
    arguments = sys.argv[1:]
    options: list[str] = []
    if "--" in arguments:
        at = arguments.index("--")
        arguments, options = arguments[:at], arguments[at + 1 :]
    parser = argparse.ArgumentParser(
        prog="scripts/test-versions", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("environments", nargs="*", metavar="ENVIRONMENT", help="such as lowest-3.11 or newest-3.13")
    return parser.parse_args(arguments).environments, options or ["--sets", "fast", "-q"]


def row_of(name: str, python: str, options: list[str]) -> Row:
    """Make an environment, and run the tests in it."""
    venv = VENVS / name
    version = output_of([python, "-c", "import platform; print(platform.python_version())"])
    why_not = make(venv, python, name.startswith("lowest"))
    if why_not:
        return Row(name, version, "could not be made", False, (why_not,))
    print(f"== {name}: Python {version}", flush=True)
    with tempfile.TemporaryDirectory(prefix="pancakes-versions-") as directory:
        place = Path(directory)
        report = place / "report.xml"
        began_s = time.monotonic()
        command = [str(venv / "bin" / "python"), "-m", "pytest", "-n", str(WORKERS), "--dist", "worksteal"]
        command += [
            f"--basetemp={place / 'tests'}",
            "-p",
            "no:cacheprovider",
            *(IGNORED if name.startswith("lowest") else ()),
        ]
        try:
            code = subprocess.run(
                [*command, f"--junitxml={report}", *options],
                cwd=ROOT,
                env=environment(place),
                stdin=subprocess.DEVNULL,
                timeout=LIMIT_S,
            ).returncode
        except subprocess.TimeoutExpired:
            return Row(name, version, f"not over after {LIMIT_S:g} s", False)
        if not report.is_file():
            return Row(name, version, f"pytest ended with {code}", False)
        result, remarks = summary_of(report)
    return Row(name, version, f"{result} in {time.monotonic() - began_s:.0f} s", code == 0, remarks)


def environment(place: Path) -> dict[str, str]:
    """Return the environment of the tests, in which they do not see the running agents of this machine."""
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("PANCAKES_", "PYTHON", "VIRTUAL_"))}
    made = {}
    for variable, folder in (("XDG_RUNTIME_DIR", "run"), ("XDG_STATE_HOME", "state"), ("PANCAKES_RUNTIME_DIR", "run")):
        (place / folder).mkdir(mode=0o700, exist_ok=True)
        made[variable] = str(place / folder)
    return {**kept, **made}


def summary_of(report: Path) -> tuple[str, tuple[str, ...]]:
    """Return how many tests passed, failed and were skipped; and the first failures and most frequent reasons."""
    passed, failed, reasons = 0, [], Counter[str]()
    for case in xml.etree.ElementTree.parse(report).iter("testcase"):
        if case.find("failure") is not None or case.find("error") is not None:
            failed.append(f"{case.get('classname')}::{case.get('name')}")
        elif (skipped := case.find("skipped")) is not None:
            reasons[skipped.get("message") or ""] += 1
        else:
            passed += 1
    result = f"{passed} passed, {len(failed)} failed, {reasons.total()} left out"
    remarks = [f"failed: {name}" for name in failed[:20]]
    remarks += [f"{count} left out: {reason}" for reason, count in reasons.most_common(MOST_REASONS)]
    return result, tuple(remarks)


# Environments ----------------------------------------------------------------------------------------------------


def make(venv: Path, python: str, lowest: bool) -> str:
    """Make an environment unless it is up to date; return why it could not be made, or an empty string."""
    stamp = venv / "installed-for"
    wanted = f"{python} {digest()}"
    if stamp.is_file() and stamp.read_text() == wanted:
        return ""
    uv = find_uv()
    print(f"making {venv.relative_to(ROOT)} ...", file=sys.stderr, flush=True)
    shutil.rmtree(venv, ignore_errors=True)
    install = [uv, "pip", "install", "--quiet", "--python", str(venv / "bin" / "python")]
    if lowest:
        install.append("--resolution=lowest-direct")
    install += ["--editable", f"{ROOT}[test]"]
    for plugin in sorted((ROOT / "plugins").glob("*/setup.cfg")):
        install += ["--editable", str(plugin.parent)]
    create = [uv, "venv", "--quiet", "--no-python-downloads", "--python", python, str(venv)]
    for command in (create, install):
        ended = subprocess.run(command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        if ended.returncode:
            print(ended.stderr, file=sys.stderr)
            return last_line(ended.stderr)
    stamp.write_text(wanted)
    return ""


def find_uv() -> str:
    """Return the path of an installed uv, or else of one that pip installs for this script."""
    found = shutil.which("uv")
    own = VENVS / "uv" / "bin" / "uv"
    if found or own.is_file():
        return found or str(own)
    print("installing uv in .venvs/uv ...", file=sys.stderr, flush=True)
    subprocess.run([sys.executable, "-m", "venv", str(VENVS / "uv")], check=True)
    subprocess.run([str(own.with_name("python")), "-m", "pip", "install", "--quiet", "uv"], check=True)
    return str(own)


def python_of(version: str) -> str:
    """Return a Python of a version, such as 3.12; empty: this machine has none."""
    for path in candidates(version):
        if output_of([path, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]) == version:
            return path
    return ""


def candidates(version: str) -> Iterator[str]:
    """Yield the possible paths of a Python of a version: of pyenv, of uv, and on the PATH."""
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    of_uv = Path(os.environ.get("UV_PYTHON_INSTALL_DIR") or Path.home() / ".local" / "share" / "uv" / "python")
    for path in sorted([*pyenv.glob(f"{version}.*"), *of_uv.glob(f"cpython-{version}.*")], key=number_of, reverse=True):
        yield str(path / "bin" / "python")
    found = shutil.which(f"python{version}")
    if found:
        yield found


def number_of(path: Path) -> list[int]:
    return [int(number) for number in re.findall(r"\d+", path.name)[:3]]


def output_of(command: list[str]) -> str:
    """Return the output of a command; empty if it fails."""
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=30.0, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return ended.stdout.strip() if ended.returncode == 0 else ""


def last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "uv printed nothing"


def show(rows: list[Row]) -> None:
    """Print the table."""
    print()
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    for row in rows:
        print("  ".join(row[column].ljust(widths[column]) for column in range(3)).rstrip())
        for remark in row.remarks:
            print(f"    {remark}")


if __name__ == "__main__":
    sys.exit(main())
