"""Make the project's virtual environment, `.venv`, and keep it up to date. Needs only Python.

    python3 scripts/lib/environment.py EXTRA...

It installs the project with the named extras, and the plug-ins, all editable. If the metadata has not changed, nothing
is installed again. With the extra "test" it also looks for a browser and an SSH server. The last line that it prints is
the environment's Python.
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
    """Make or update the environment."""
    extras = sys.argv[1:]
    with open(ROOT / "setup.cfg") as lock:  # two scripts may be started at once
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not is_ours():
            if Path(sys.prefix).resolve() == VENV:  # made by hand, and active: it would remove the Python that runs it
                base = Path(sys.base_prefix) / "bin" / f"python{sys.version_info.major}.{sys.version_info.minor}"
                os.execv(base, [str(base), __file__, *extras])
            say("making an environment in .venv")
            shutil.rmtree(VENV, ignore_errors=True)
            make_venv(VENV)
            (VENV / "made-for").write_text(maker())
        wanted = [extra for extra in extras if stamp(extra) != digest()]
        if wanted:
            say(f"installing Pancakes with the extras {' and '.join(wanted)}")
            install(VENV, ROOT, wanted)
            for extra in wanted:
                (VENV / f"installed-{extra}").write_text(digest())
    if "test" in extras:
        find_browser()
        find_ssh_server()
    print(VENV / "bin" / "python")


def make_venv(directory: Path) -> None:
    """Make a virtual environment. If Debian's Python lacks a part for that, install it, or say how to."""
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
    """Install a browser for the tests of the page, if this may be done without asking."""
    if not any(map(shutil.which, BROWSERS)):
        get("chromium", "the tests in a browser")


def find_ssh_server() -> None:
    """Install an SSH server for the tests of fleets on several machines, if this may be done without asking."""
    if shutil.which("sshd", path=f"{os.environ.get('PATH', '')}:/usr/sbin") is None:
        get("openssh-server", "the tests of fleets on several machines")


def get(package: str, tests: str) -> None:
    """Install a system package that some tests need, if this may be done without asking."""
    if not may_install():
        return
    say(f"installing {package} for {tests}")
    command = ["apt-get", "install", "-y", "-qq", "--no-install-recommends", package]
    if not succeeds(command):
        # The lists of packages may be old or missing.
        succeeds(["apt-get", "update", "-qq"])
        if not succeeds(command):
            say(f"{package} could not be installed, so {tests} will be skipped")


def may_install() -> bool:
    """Return whether system packages may be installed without asking: as root, on a CI machine."""
    return os.geteuid() == 0 and bool(os.environ.get("CI")) and shutil.which("apt-get") is not None


def has_venv() -> bool:
    """Return whether this Python can make a virtual environment with pip."""
    check = [sys.executable, "-c", "import venv, ensurepip"]
    return subprocess.run(check, stdin=subprocess.DEVNULL, capture_output=True).returncode == 0


def install(venv: Path, root: Path, extras: list[str]) -> None:
    """Install the project in `root` with some extras, and its plug-ins, into an environment."""
    command = [str(venv / "bin" / "python"), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    command += ["--no-input", "--editable", f"{root}[{','.join(extras)}]"]
    for plugin in sorted((root / "plugins").glob("*/setup.cfg")):
        command += ["--editable", str(plugin.parent)]
    run(command, "the installation failed")


def run(command: list[str], fault: str) -> None:
    """Run a command with its output on standard error; end the script if it fails."""
    code = code_of(command)
    if code:
        sys.exit(f"{fault}: `{' '.join(command)}` ended with {code}.")


def succeeds(command: list[str]) -> bool:
    """Run a command in the same way; return whether it succeeded."""
    return code_of(command) == 0


def code_of(command: list[str]) -> int:
    """Run a command in the same way, and return its exit code."""
    environment = {**os.environ, "PIP_ROOT_USER_ACTION": "ignore", "DEBIAN_FRONTEND": "noninteractive"}
    return subprocess.run(command, stdin=subprocess.DEVNULL, stdout=sys.stderr, env=environment).returncode


def is_ours() -> bool:
    """Return whether the environment was made here by a Python like this one; a copy would refer to its original."""
    made_for = VENV / "made-for"
    if not made_for.is_file() and is_made_by_hand():
        made_for.write_text(maker())
    return made_for.is_file() and made_for.read_text() == maker() and os.access(VENV / "bin" / "python", os.X_OK)


def is_made_by_hand() -> bool:
    """Return whether a person made the environment here, with a Python like this one (`python3 -m venv .venv`)."""
    try:
        lines = (VENV / "pyvenv.cfg").read_text().splitlines()
    except OSError:
        return False
    facts = {name.strip(): value.strip() for name, _, value in (line.partition("=") for line in lines)}
    version = f"{sys.version_info.major}.{sys.version_info.minor}."
    return facts.get("version", "").startswith(version) and facts.get("command", "").endswith(f" {VENV}")


def maker() -> str:
    """Return what an environment depends on besides the project's metadata."""
    return f"{ROOT} {sys.version_info.major}.{sys.version_info.minor} {sysconfig.get_platform()}"


def stamp(extra: str) -> str:
    """Return the digest of the metadata that an extra was last installed for."""
    path = VENV / f"installed-{extra}"
    return path.read_text() if path.is_file() else ""


def digest() -> str:
    """Return the digest of the metadata of the project and its plug-ins."""
    whole = hashlib.sha256()
    for pattern in METADATA:
        for path in sorted(ROOT.glob(pattern)):
            whole.update(f"{path.relative_to(ROOT)}\n".encode() + path.read_bytes())
    return whole.hexdigest()


def say(text: str) -> None:
    """Print what is being done."""
    print(f"{text} ...", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
