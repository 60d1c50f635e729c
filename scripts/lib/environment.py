"""Makes the project's own virtual environment, `.venv`, and keeps it up to date. Needs nothing but Python.

    python3 scripts/lib/environment.py EXTRA...

It installs the project with the extras that are named, and the plug-ins, all of them editable; what an earlier
call installed for the same metadata is not installed again. With the extra "test" it looks for a browser as well. The
last line that it prints is the environment's Python.
"""

# ruff: noqa: E402 - it goes before the other imports: a SIGINT while they are read ends it quietly
from __future__ import annotations

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
VENV = ROOT / ".venv"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
METADATA = ("setup.cfg", "pyproject.toml", "plugins/*/setup.cfg", "plugins/*/pyproject.toml")


def main() -> None:
    """Makes or updates the environment."""
    extras = sys.argv[1:]
    with open(ROOT / "setup.cfg") as lock:  # two scripts may be started at once
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not is_ours():
            say("making an environment in .venv")
            shutil.rmtree(VENV, ignore_errors=True)
            make_venv(VENV)
            (VENV / "made-for").write_text(maker())
        wanted = [extra for extra in extras if stamp(extra) != digest()]
        if wanted:
            say(f"installing Pancakes and what it needs to {' and '.join(wanted)}")
            install(VENV, ROOT, wanted)
            for extra in wanted:
                (VENV / f"installed-{extra}").write_text(digest())
    if "test" in extras:
        find_browser()
        find_ssh_server()
    print(VENV / "bin" / "python")


def make_venv(directory: Path) -> None:
    """Makes a virtual environment; where Debian left a part of Python out, says how to get it, or gets it."""
    command = [sys.executable, "-m", "venv", str(directory)]
    if has_venv():
        run(command, "no virtual environment could be made")
        return
    package = f"python{sys.version_info.major}.{sys.version_info.minor}-venv"
    if may_install():
        say(f"{sys.executable} cannot make virtual environments: installing {package}")
        run(["apt-get", "install", "-y", "-qq", package], f"{package} could not be installed")
        run(command, "no virtual environment could be made")
        return
    sys.exit(f"{sys.executable} cannot make virtual environments: install them with `apt install {package}`.")


def find_browser() -> None:
    """Gets the browser for the tests of the page, where a machine of its own runs them; elsewhere a person decides."""
    if not any(map(shutil.which, BROWSERS)):
        get("chromium", "the tests in a browser")


def find_ssh_server() -> None:
    """Gets the SSH server for the tests of fleets on several machines, likewise."""
    if shutil.which("sshd", path=f"{os.environ.get('PATH', '')}:/usr/sbin") is None:
        get("openssh-server", "the tests of fleets on several machines")


def get(package: str, tests: str) -> None:
    """Installs a package of the system that some tests need, where that may be done without a question."""
    if not may_install():
        return
    say(f"there is no {package} for {tests}: installing it")
    command = ["apt-get", "install", "-y", "-qq", "--no-install-recommends", package]
    if not succeeds(command):
        # Its lists of packages may be old, or not there yet.
        succeeds(["apt-get", "update", "-qq"])
        if not succeeds(command):
            say(f"{package} could not be installed, so {tests} will be skipped")


def may_install() -> bool:
    """Whether packages of the system may be installed without a question."""
    return os.geteuid() == 0 and bool(os.environ.get("CI")) and shutil.which("apt-get") is not None


def has_venv() -> bool:
    """Whether this Python can make a virtual environment with pip in it."""
    check = [sys.executable, "-c", "import venv, ensurepip"]
    return subprocess.run(check, stdin=subprocess.DEVNULL, capture_output=True).returncode == 0


def install(venv: Path, root: Path, extras: list[str]) -> None:
    """Installs the project in `root` with some extras, and its plug-ins, into an environment."""
    command = [str(venv / "bin" / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    command += ["--no-input", "--editable", f"{root}[{','.join(extras)}]"]
    for plugin in sorted((root / "plugins").glob("*/setup.cfg")):
        command += ["--editable", str(plugin.parent)]
    run(command, "the installation failed")


def run(command: list[str], fault: str) -> None:
    """Runs a command whose output goes to the terminal's error stream; ends the script where it fails."""
    code = code_of(command)
    if code:
        sys.exit(f"{fault}: `{' '.join(command)}` ended with {code}.")


def succeeds(command: list[str]) -> bool:
    """Runs a command in the same way, and returns whether it ended well."""
    return code_of(command) == 0


def code_of(command: list[str]) -> int:
    """Runs a command in the same way, and returns its exit code."""
    environment = {**os.environ, "PIP_ROOT_USER_ACTION": "ignore", "DEBIAN_FRONTEND": "noninteractive"}
    return subprocess.run(command, stdin=subprocess.DEVNULL, stdout=sys.stderr, env=environment).returncode


def is_ours() -> bool:
    """Whether the environment was made here by a Python like this one: a copied one leads back to its original."""
    made_for = VENV / "made-for"
    return made_for.is_file() and made_for.read_text() == maker() and os.access(VENV / "bin" / "python", os.X_OK)


def maker() -> str:
    """What an environment depends on besides the project's metadata."""
    return f"{ROOT} {sys.version_info.major}.{sys.version_info.minor} {sysconfig.get_platform()}"


def stamp(extra: str) -> str:
    """The digest of the metadata that an extra was last installed for."""
    path = VENV / f"installed-{extra}"
    return path.read_text() if path.is_file() else ""


def digest() -> str:
    """What the project's metadata and its plug-ins' come to."""
    whole = hashlib.sha256()
    for pattern in METADATA:
        for path in sorted(ROOT.glob(pattern)):
            whole.update(f"{path.relative_to(ROOT)}\n".encode() + path.read_bytes())
    return whole.hexdigest()


def say(text: str) -> None:
    """Tells the person what takes so long."""
    print(f"{text} ...", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
