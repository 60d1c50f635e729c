"""Runs what the README tells its readers to type, so that it stays true. Needs nothing but Python, git and bash.

Every fenced block whose info string is exactly `sh` is run, statement by statement, in one shell: what one block
does, the next one finds. A block `sh background` is what the reader types in a terminal of its own: it goes on while
the rest is run. A block `text output` says what the block before it prints: each of its lines must come, in this order,
with others in between; `...` in a line stands for anything, and how many spaces there are does not count. For a
background block it is waited for. A block with a file name behind its language (```python blink.py) is saved under
that name first. All others are only shown.

The shell stands in a fresh copy of the project (what git has, and what is new and not ignored), with a virtual
environment of its own that is active, an empty home, and nothing on its standard input.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from environment import ROOT, make_venv

_FENCE = re.compile(r"^( {0,3})(`{3,}|~{3,})\s*(.*?)\s*$")
COMMANDS = "sh"
BACKGROUND = "sh background"
OUTPUT = "text output"
AWAIT_S = 60.0
"""How long a background command may take until it has printed what it is to print."""
_DONE = "\x1e"
"""What the shell prints before the number and the exit code of a statement that has ended; no program prints it."""


@dataclass
class Block:
    """A fenced block: its info string, the line that its text begins at, and its text."""

    info: str
    line: int
    text: str


@dataclass
class Statement:
    """One command, with all of its lines, and where it stands in the README.

    Attributes:
        background: whether it goes on while the next ones run.
        last: whether it is the last of its block.
        output: what its block prints, if that is said and it is the last.
    """

    line: int
    text: str
    background: bool = False
    last: bool = False
    output: Block | None = None


def blocks(markdown: str) -> list[Block]:
    """Returns the fenced blocks of a text."""
    found: list[Block] = []
    fence, indent = "", 0
    for number, line in enumerate(markdown.splitlines(), 1):
        match = _FENCE.match(line)
        if not fence and match:
            indent, fence = len(match[1]), match[2]
            found.append(Block(match[3], number + 1, ""))
        elif fence and match and match[2].startswith(fence) and not match[3]:
            fence = ""
        elif fence:
            found[-1].text += (line[indent:] if not line[:indent].strip() else line) + "\n"
    return found


def statements(block: Block) -> Iterator[Statement]:
    """Cuts a block into statements: a here-document, a loop or a line that goes on stays in one piece."""
    gathered: list[str] = []
    start = block.line
    for number, line in enumerate(block.text.splitlines(), block.line):
        if not gathered and (not line.strip() or line.lstrip().startswith("#")):
            continue
        if not gathered:
            start = number
        gathered.append(line)
        if is_whole("\n".join(gathered)):
            yield Statement(start, "\n".join(gathered))
            gathered = []
    if gathered:
        yield Statement(start, "\n".join(gathered))


def commands(found: list[Block]) -> list[Statement]:
    """Returns all statements to be run, each last one of a block with the output that the block is to print."""
    wanted: list[Statement] = []
    for block, after in zip(found, [*found[1:], Block("", 0, "")], strict=True):
        if block.info not in (COMMANDS, BACKGROUND):
            continue
        cut = list(statements(block))
        if block.info == BACKGROUND:
            cut = [Statement(block.line, block.text.rstrip("\n"), background=True)]
        if cut:
            cut[-1].last = True
            cut[-1].output = after if after.info == OUTPUT else None
        wanted += cut
    return wanted


def missing(expected: str, printed: str) -> str:
    """Returns the first line that was expected and did not come in its order; empty where all did."""
    lines = iter([" ".join(line.split()) for line in printed.splitlines()])
    for line in expected.splitlines():
        words = " ".join(line.split())
        if words in ("", "..."):
            continue
        pattern = re.compile(".*".join(re.escape(part) for part in words.split("...")))
        if not any(pattern.fullmatch(other) for other in lines):
            return words
    return ""


def await_output(log: Path, expected: Path, limit_s: float) -> int:
    """Waits until a background command has printed what it is to print; returns the exit code for that."""
    until_s = time.monotonic() + limit_s
    while lacking := missing(expected.read_text(), log.read_text(errors="replace")):
        if time.monotonic() > until_s:
            print(log.read_text(errors="replace"))
            print(f"this line did not come within {limit_s:g} s: {lacking}")
            return 1
        time.sleep(0.05)
    return 0


def is_whole(text: str) -> bool:
    """Whether bash could run a text as it stands."""
    if text.endswith("\\"):
        return False
    checked = subprocess.run(["bash", "-n", "-c", text], stdin=subprocess.DEVNULL, capture_output=True)
    return checked.returncode == 0 and not checked.stderr


def copy_project(to: Path) -> None:
    """Copies what a clone would have, and what would be added to it."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file() or (ROOT / name).is_symlink():
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, to / name, follow_symlinks=False)


def script_of(all_statements: list[Statement], place: Path) -> str:
    """Returns a bash script that runs statements and says after each how it ended."""
    lines = []
    for number, statement in enumerate(all_statements):
        lines.append(_in_background(number, statement, place) if statement.background else statement.text)
        lines.append(f"printf '\\n{_DONE}%d %d\\n' {number} $?")
    return "\n".join(lines) + "\n"


def _in_background(number: int, statement: Statement, place: Path) -> str:
    log = place / f"background-{number}.log"
    log.touch()
    expected = place / f"background-{number}.expected"
    expected.write_text(statement.output.text if statement.output is not None else "")
    waiting = [sys.executable, str(Path(__file__).resolve()), "--await", str(log), str(expected)]
    return f"{{\n{statement.text}\n}} > {shlex.quote(str(log))} 2>&1 &\n{shlex.join(waiting)}"


def run(all_statements: list[Statement], name: str, copy: Path, place: Path, limit_s: float) -> list[str]:
    """Runs statements, and returns a sentence for each one that failed."""
    script = place / "readme.sh"
    script.write_text(script_of(all_statements, place))
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("PANCAKES_", "PYTHON", "XDG_"))}
    venv = place / "venv"
    environment = {**kept, "HOME": str(place / "home"), "VIRTUAL_ENV": str(venv), "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    environment["PATH"] = f"{venv / 'bin'}{os.pathsep}{os.environ['PATH']}"
    environment["PIP_CACHE_DIR"] = os.environ.get("PIP_CACHE_DIR", str(Path.home() / ".cache" / "pip"))
    environment["XDG_RUNTIME_DIR"] = str(place / "run")
    shell = subprocess.Popen(
        ["bash", str(script)],
        cwd=copy,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    assert shell.stdout is not None
    failures: list[str] = []
    progress = _Progress(shell.pid, limit_s)
    current = 0
    printed = ""
    print(f"$ {all_statements[0].text}", flush=True)
    for line in shell.stdout:
        if not line.startswith(_DONE):
            print(line, end="", flush=True)
            printed += line
            continue
        current, status = int(line[1:].split()[0]), int(line.split()[1])
        progress.went_on()
        if status:
            failures.append(
                f"{name}:{all_statements[current].line}: ended with {status}: {all_statements[current].text}"
            )
        output = all_statements[current].output
        if output is not None and not all_statements[current].background:
            lacking = missing(output.text, printed)
            if lacking:
                failures.append(f"{name}:{output.line}: this line was not printed, or not in this order: {lacking}")
        if all_statements[current].last:
            printed = ""
        current += 1
        if current == len(all_statements):
            break
        print(f"$ {all_statements[current].text}", flush=True)
    progress.end()
    _end_session(shell.pid)
    shell.wait()
    shell.stdout.close()
    if current < len(all_statements):
        why = f"took longer than {limit_s:g} s" if progress.is_late else "ended the shell"
        failures.append(f"{name}:{all_statements[current].line}: {why}: {all_statements[current].text}")
    return failures


class _Progress:
    """Ends the shell's session where one statement takes too long."""

    def __init__(self, session: int, limit_s: float) -> None:
        self.is_late = False
        self._session = session
        self._limit_s = limit_s
        self._went_on = threading.Event()
        self._ended = False
        threading.Thread(target=self._watch, daemon=True).start()

    def went_on(self) -> None:
        """A statement has ended, and the next begins."""
        self._went_on.set()

    def end(self) -> None:
        """All statements have ended."""
        self._ended = True
        self._went_on.set()

    def _watch(self) -> None:
        while not self._ended:
            if not self._went_on.wait(self._limit_s):
                self.is_late = True
                _end_session(self._session)
                return
            self._went_on.clear()


def _end_session(session: int) -> None:
    """Ends the shell that we started, and what it left running in the background."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(session, number)
        except ProcessLookupError:
            return
        time.sleep(0.5)


def main() -> None:
    """Runs the commands of a README, and ends with 1 where one of them failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?", default="README.md", help="the text, in the project's root (README.md)")
    parser.add_argument("--done", action="append", default=[], help="a command that was run already, so not here")
    parser.add_argument("--limit", type=float, default=600.0, help="most seconds for one command (600)")
    parser.add_argument("--list", action="store_true", help="only show what would be run")
    parser.add_argument("--await", nargs=2, type=Path, dest="awaited", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.awaited:
        sys.exit(await_output(*options.awaited, AWAIT_S))
    found = blocks((ROOT / options.file).read_text())
    wanted = [statement for statement in commands(found) if statement.text.strip() not in options.done]
    files = [
        (block.info.split()[1], block)
        for block in found
        if len(block.info.split()) == 2 and block.info not in (BACKGROUND, OUTPUT)
    ]
    if options.list or not wanted:
        for file_name, block in files:
            print(f"{options.file}:{block.line}: saved as {file_name}")
        for statement in wanted:
            print(f"{options.file}:{statement.line}: {statement.text}")
        print(f"{options.file} has {len(wanted)} commands to run")
        return
    with tempfile.TemporaryDirectory(prefix="pancakes-readme-") as directory:
        place = Path(directory)
        copy = place / "pancakes"
        for made in (copy, place / "home"):
            made.mkdir()
        (place / "run").mkdir(mode=0o700)
        copy_project(copy)
        for file_name, block in files:
            (copy / file_name).parent.mkdir(parents=True, exist_ok=True)
            (copy / file_name).write_text(block.text)
        make_venv(place / "venv")
        failures = run(wanted, options.file, copy, place, options.limit)
    for failure in failures:
        print(failure, file=sys.stderr)
    print(f"{options.file}: {len(wanted) - len(failures)} commands passed, {len(failures)} failed")
    sys.exit(1 if failures else 0)


if __name__ == "__main__":
    main()
