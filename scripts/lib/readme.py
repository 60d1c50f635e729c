"""Run the commands of the README, so that it stays true. Needs only Python, git and bash.

Every fenced block with exactly the info string `sh` is run, statement by statement, in one shell, so that a block can
use the results of the block before. A block `sh background` is for a second terminal: it runs while the other blocks
run. A block `text output` has the output of the block before it: each of its lines must be printed, in this order,
possibly with others in between; `...` in a line matches anything, and the number of spaces does not matter. For a
background block, the script waits for this output. A block with a file name after its language (```python blink.py) is
first saved under that name. All other blocks are ignored.

The shell runs in a fresh copy of the project (the files in git, and new files that are not ignored), with an active
virtual environment of its own, an empty home, and an empty standard input.
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
"""How long a background command may take to print its expected output, in seconds."""
_DONE = "\x1e"
"""The mark that the shell prints before the number and exit code of each statement; no program prints it."""


@dataclass
class Block:
    """A fenced block: its info string, the line that its text begins at, and its text."""

    info: str
    line: int
    text: str


@dataclass
class Statement:
    """One command with all of its lines, and its line in the README.

    Attributes:
        background: whether it runs while the next ones run.
        last: whether it is the last of its block.
        output: the expected output of its block, if the README has it and this is the last statement.
    """

    line: int
    text: str
    background: bool = False
    last: bool = False
    output: Block | None = None


def blocks(markdown: str) -> list[Block]:
    """Return the fenced blocks of a text."""
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
    """Cut a block into statements; a here-document, a loop or a continued line stays in one piece."""
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
    """Return all statements to run; the last one of each block has the expected output of the block."""
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
    """Return the first expected line that was not printed, or not in order; empty if all were."""
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
    """Wait until a background command has printed its expected output; return the exit code of the wait."""
    until_s = time.monotonic() + limit_s
    while lacking := missing(expected.read_text(), log.read_text(errors="replace")):
        if time.monotonic() > until_s:
            print(log.read_text(errors="replace"))
            print(f"this line was not printed within {limit_s:g} s: {lacking}")
            return 1
        time.sleep(0.05)
    return 0


def is_whole(text: str) -> bool:
    """Return whether a text is a complete bash statement."""
    if text.endswith("\\"):
        return False
    checked = subprocess.run(["bash", "-n", "-c", text], stdin=subprocess.DEVNULL, capture_output=True)
    return checked.returncode == 0 and not checked.stderr


def copy_project(to: Path) -> None:
    """Copy the files that a clone would have, and new files that are not ignored."""
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
    """Return a bash script that runs statements, and prints the exit code of each."""
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
    """Run statements, and return a sentence for each one that failed."""
    script = place / "readme.sh"
    script.write_text(script_of(all_statements, place))
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("PANCAKES_", "PYTHON", "XDG_"))}
    venv = place / "venv"
    environment = {**kept, "HOME": str(place / "home"), "VIRTUAL_ENV": str(venv), "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    environment["PIP_COMPILE"] = "0"  # only what is imported is compiled: 6 s less of the processor for each text
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
    """Ends the shell's session if one statement takes too long."""

    def __init__(self, session: int, limit_s: float) -> None:
        self.is_late = False
        self._session = session
        self._limit_s = limit_s
        self._went_on = threading.Event()
        self._ended = False
        threading.Thread(target=self._watch, daemon=True).start()

    def went_on(self) -> None:
        """Restart the time limit for the next statement."""
        self._went_on.set()

    def end(self) -> None:
        """Stop the time limit, after all statements."""
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
    """End the shell, and everything that it left running in the background."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(session, number)
        except ProcessLookupError:
            return
        time.sleep(0.5)


def main() -> None:
    """Run the commands of a README, and end with 1 if one of them failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?", default="README.md", help="the text, in the project's root (README.md)")
    parser.add_argument("--done", action="append", default=[], help="a command to skip, because it was already run")
    parser.add_argument("--limit", type=float, default=600.0, help="most seconds for one command (600)")
    parser.add_argument("--list", action="store_true", help="only list the commands")
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
