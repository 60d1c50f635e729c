"""Run a launched fleet in the background (`pancakes up --detach`).

The launcher forks: its child runs the fleet in a session of its own, and reports to the terminal until all agents are
ready. From then on it writes to a log file of bounded size, and the terminal gets its prompt back.

Each launcher, also one in the foreground, is entered in the runtime directory, so that `pancakes down` finds it by the
files of the fleet, or by its agents, and ends it too.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import logging.handlers
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Final

import msgspec

from pancakes.errors import PancakesError
from pancakes.tools.launch.fleet_file import FLEET_FILE
from pancakes.tools.launch.supervisor import LaunchReporter
from pancakes.util import codecs
from pancakes.util.files import user_folder
from pancakes.util.runtime_dir import LOOK_S, Registration, RunningAgent, entries

LOG_BYTES: Final = 10_000_000
"""When the log file is moved away; with the files before it, a fleet's log takes at most three times as much."""
_OLD_LOGS: Final = 2
_LAUNCHER: Final = "up-"
"""What the names of launchers in the runtime directory begin with."""
_AWAY: Final = "+hosts"
"""What they end with if some of their agents are on other hosts."""


class Ready(msgspec.Struct, frozen=True):
    """What the background process tells the terminal once the fleet runs.

    Attributes:
        process: its process number.
        log: its log file.
        ready: the agents that run.
        given_up: the agents that do not.
    """

    process: int
    log: str
    ready: list[str]
    given_up: list[str]


_DECODE: Final = codecs.json_decoder(Ready)


def name_of(paths: Sequence[Path], only: Sequence[str] = ()) -> str:
    """Return the name under which the fleet of these files runs, in whatever order and by whatever path they come.

    Args:
        paths: the files and folders.
        only: those of its agents that were chosen; empty: all.
    """
    files = sorted({str(it) for path in paths for it in _files_of(path.resolve())})
    first = Path(files[0])
    stem = first.parent.name if first.name == FLEET_FILE or len(files) > 1 else first.stem
    stem = re.sub(r"[^A-Za-z0-9_.-]", "_", stem)[:40]
    digest = hashlib.sha256("\n".join([*files, *sorted(only)]).encode(errors="surrogateescape")).hexdigest()
    return f"{_LAUNCHER}{stem}-{digest[:6]}"


def _files_of(path: Path) -> list[Path]:
    """Return the files that a file or folder of the command line stands for."""
    if not path.is_dir():
        return [path]
    fleet = path / FLEET_FILE
    return [fleet.resolve()] if fleet.is_file() else sorted(it.resolve() for it in path.glob("*.toml")) or [path]


def log_of(paths: Sequence[Path], only: Sequence[str]) -> Path:
    """Return the log file of a fleet in the background.

    Raises:
        NoHome: it is not known where it would be.
    """
    base = user_folder("XDG_STATE_HOME", ".local/state", "the log of a fleet in the background")
    return base / "pancakes" / "up" / f"{name_of(paths, only)}.log"


class DetachingReporter:
    """Report to the terminal until the fleet runs, and to the log always.

    Args:
        shown: reports to the terminal.
        log: where to write.
        names: the agents of the fleet.
        begins: whether a mission begins once all agents are ready.
        detach: is called once, with the agents that run and those that were given up.
    """

    def __init__(
        self,
        shown: LaunchReporter,
        log: logging.Logger,
        names: Sequence[str],
        begins: bool,
        detach: Callable[[list[str], list[str]], None],
    ) -> None:
        self._shown: LaunchReporter | None = shown
        self._log = log
        self._waiting = set(names)
        self._begins = begins
        self._detach = detach
        self._detached = False
        self._ready: list[str] = []
        self._given_up: list[str] = []

    def line(self, agent: str, text: str) -> None:
        """See `LaunchReporter`."""
        self._show(lambda shown: shown.line(agent, text))
        self._log.info("%s | %s", agent, text)

    def told(self, agent: str, event: str, text: str) -> None:
        """See `LaunchReporter`."""
        self._show(lambda shown: shown.told(agent, event, text))
        self._log.info("%s", f"{agent} {text}" if agent else text)
        if event == "ready" and agent in self._waiting:
            self._ready.append(agent)
        elif event == "given_up" and agent in self._waiting:
            self._given_up.append(agent)
        elif event in ("begun", "held"):
            self._begins = False
        self._waiting.discard(agent if event in ("ready", "given_up") else "")
        # If no agent runs, the launcher is about to end, and its exit code is the answer.
        if not self._detached and self._ready and not self._waiting and not self._begins:
            self._detached, self._shown = True, None
            self._detach(self._ready, self._given_up)

    def _show(self, show: Callable[[LaunchReporter], None]) -> None:
        """Show something, unless nobody reads the terminal's output any more (`| head`): the fleet needs no reader."""
        if self._shown is None:
            return
        try:
            show(self._shown)
        except OSError:
            self._shown = None


def run_detached(
    paths: Sequence[Path],
    only: Sequence[str],
    names: Sequence[str],
    begins: bool,
    shown: LaunchReporter,
    run: Callable[[LaunchReporter], int],
) -> Ready | int:
    """Run a fleet in a child process; return once its agents are ready.

    Args:
        paths: the files of the fleet.
        only: those of its agents that were chosen; empty: all.
        names: its agents.
        begins: whether a mission begins once all agents are ready.
        shown: reports to the terminal.
        run: runs the fleet until it ends, in the child, and returns the exit code.

    Returns:
        What runs now; or the exit code of a fleet that has ended already.

    Raises:
        PancakesError: the log file cannot be written, or the fleet of these files runs in the background already.
    """
    if (pid := process_of(paths, only)) is not None:
        raise PancakesError(f"pancakes up runs this fleet already (process {pid}): end it with pancakes down")
    path = log_of(paths, only)
    try:
        to_file = LogFile(path)
    except OSError as error:
        raise PancakesError(f"the log {path} cannot be written: {error.strerror}") from None
    reader, writer = os.pipe()
    child = os.fork()
    if child:
        os.close(writer)
        to_file.close()
        return _wait(child, reader)
    os.close(reader)
    os.setsid()
    screen = _Screen(path)
    to_file.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    log = logging.Logger("up")
    log.addHandler(to_file)

    def detach(ready: list[str], given_up: list[str]) -> None:
        os.write(writer, codecs.encode_json(Ready(os.getpid(), str(path), ready, given_up)))
        os.close(writer)
        screen.leave()

    try:
        return run(DetachingReporter(shown, log, names, begins, detach))
    finally:
        to_file.close()


class LogFile(logging.handlers.RotatingFileHandler):
    """The log of a fleet in the background, of bounded size. Lines that cannot be written, as on a full disk, are lost.

    Args:
        path: the file.

    Raises:
        OSError: it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._told = False
        super().__init__(path, "a", LOG_BYTES, _OLD_LOGS, "utf-8", errors="replace")

    def _open(self) -> Any:
        Path(self.baseFilename).parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        return super()._open()

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line, into a new file if somebody has removed or moved the old one."""
        if self.stream is not None and not os.path.exists(self.baseFilename):
            self.stream.close()
            self.stream = None
        super().emit(record)

    def handleError(self, record: logging.LogRecord) -> None:
        """Say once what is wrong, as long as there is a terminal."""
        error = sys.exc_info()[1]
        if not self._told and isinstance(error, OSError):
            self._told = True
            with contextlib.suppress(OSError):
                print(f"the log {self.baseFilename} cannot be written: {error.strerror}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def registered(paths: Sequence[Path], only: Sequence[str], away: bool) -> Iterator[None]:
    """Enter this launcher in the runtime directory, so that `pancakes down` ends it with its agents.

    Args:
        paths: the files of its fleet.
        only: those of its agents that were chosen; empty: all.
        away: whether some of its agents are on other hosts.

    Raises:
        PancakesError: the runtime directory cannot be used.
    """
    name = name_of(paths, only) + (_AWAY if away else "")
    entry = Registration(RunningAgent(name, "", "client", (), os.getpid()))
    over = threading.Event()

    def renew() -> None:
        while not over.wait(LOOK_S):
            entry.renew()  # the directory of a session ends with the session

    renewing = threading.Thread(target=renew, name="renew", daemon=True)
    renewing.start()
    try:
        yield
    finally:
        over.set()
        renewing.join()
        entry.remove()


class _Screen:
    """The terminal of a process that will leave it.

    Its children never get it: a reader of the terminal's output (`| tail`) would wait for them.

    Args:
        log: a file that is standard output and error of the children, and later of this process.
    """

    def __init__(self, log: Path) -> None:
        # Python's own streams keep copies of the terminal, which no child inherits.
        sys.stdout, sys.stderr = (os.fdopen(os.dup(standard), "w", errors="replace") for standard in (1, 2))
        nothing, at_log = os.open(os.devnull, os.O_RDONLY), os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        for standard, now in enumerate((nothing, at_log, at_log)):
            os.dup2(now, standard)

    def leave(self) -> None:
        """Close the terminal, and write to the log from now on."""
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):
                stream.close()
        sys.stdout, sys.stderr = (os.fdopen(os.dup(standard), "w", 1, errors="replace") for standard in (1, 2))


def _wait(child: int, reader: int) -> Ready | int:
    """Wait until the child says that the fleet runs, or ends. A signal to end is passed on to the child."""
    heard: list[int] = []

    def pass_on(number: int, frame: FrameType | None) -> None:
        heard.append(number)
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, number)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:  # `nohup` ignores SIGHUP, and so does the child
            signal.signal(number, pass_on)
    told = b""
    while chunk := os.read(reader, 65_536):
        told += chunk
    os.close(reader)
    if told and not heard:
        return _DECODE(told)
    _, status = os.waitpid(child, 0)
    if heard:
        return 128 + heard[0]
    code = os.waitstatus_to_exitcode(status)
    return code if code >= 0 else 128 - code


def process_of(paths: Sequence[Path], only: Sequence[str] = ()) -> int | None:
    """Return the process that runs the fleet of these files; None if there is none.

    Raises:
        PancakesError: the runtime directory cannot be used.
    """
    name = name_of(paths, only)
    return next((it.pid for it in _launchers() if it.name.removesuffix(_AWAY) == name), None)


def launchers_of(agents: Collection[int], here_only: bool) -> list[int]:
    """Return the processes that run only these agents, as far as agents of this machine are concerned.

    Args:
        agents: the processes of agents.
        here_only: leave out launchers that run agents on other hosts as well.

    Raises:
        PancakesError: the runtime directory cannot be used.
    """
    import psutil

    children: dict[int, set[int]] = {}
    for entry in entries():
        if entry.role != "client":
            with contextlib.suppress(psutil.NoSuchProcess):
                children.setdefault(psutil.Process(entry.pid).ppid(), set()).add(entry.pid)
    found = [it for it in _launchers() if not (here_only and it.name.endswith(_AWAY))]
    return [it.pid for it in found if it.pid in children and children[it.pid] <= set(agents)]


def _launchers() -> list[RunningAgent]:
    return [it for it in entries() if it.role == "client" and it.name.startswith(_LAUNCHER)]
