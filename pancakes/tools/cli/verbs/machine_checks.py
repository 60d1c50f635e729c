"""Check this machine for `pancakes doctor`, whether agents run or not."""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import socket
import statistics
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from pancakes.errors import PancakesError
from pancakes.mesh.local import DIRECTORY
from pancakes.security.key_store import fleets_of_person, folder_of_person
from pancakes.tools.cli.verbs.checks import MACHINE_CHECKS, Finding, Level, machine_check
from pancakes.util.clock import wall_ns
from pancakes.util.files import NoHome
from pancakes.util.plugins import GROUPS, Plugins
from pancakes.util.runtime_dir import is_locked, look, runtime_dir, usable
from pancakes.util.text import printable

DISTRIBUTION: Final = "pancakes-agents"
FULL_MIB: Final = 50
NEARLY_FULL_MIB: Final = 500
FEW_FILES: Final = 256
"""An agent of a full mesh has 63 links; with files, pipes and devices it needs this many open files."""
LATE_S: Final = 0.002
"""A machine that wakes threads later than this, in the median of several tries, cannot keep rates well."""
SOON_S: Final = 14 * 86_400
"""How long before its end a person's key should be renewed."""
WAITS: Final = 21
WAIT_S: Final = 0.001


@machine_check
def check_python() -> Iterator[Finding]:
    """Check Python and the required libraries and their versions."""
    from importlib.metadata import PackageNotFoundError, requires, version

    from packaging.requirements import Requirement

    installed = []
    for text in requires(DISTRIBUTION) or ():
        wanted = Requirement(text)
        if wanted.marker is not None and not wanted.marker.evaluate():
            continue  # only an extra needs it
        try:
            found = version(wanted.name)
        except PackageNotFoundError:
            yield Finding("error", "libraries", f"{wanted.name} is not installed", f"pip install '{text}'")
            continue
        if not wanted.specifier.contains(found, prereleases=True):
            yield Finding("error", "libraries", f"{wanted.name} {found} is not {text}", f"pip install '{text}'")
        installed.append(f"{wanted.name} {found}")
    number = ".".join(map(str, sys.version_info[:3]))
    yield Finding("ok", "libraries", f"Python {number}, {DISTRIBUTION} {version(DISTRIBUTION)}, {', '.join(installed)}")


@machine_check
def check_plugins(plugins: Plugins | None = None) -> Iterator[Finding]:
    """Import all plug-ins."""
    from pancakes.tools.cli.verbs.plugin import rows_of

    plugins = plugins or Plugins()
    rows = [row for group in GROUPS for row in rows_of(plugins, group)]
    for problem in plugins.unreadable():
        yield Finding("error", "plug-ins", str(problem), "install that distribution again")
    for row in rows:
        if row["state"] == "broken":
            advice = f"fix or uninstall {row['distribution']}: this plug-in of it cannot run"
            yield Finding("error", "plug-ins", row["reason"], advice)
    usable_rows = [row for row in rows if row["state"] == "ok"]
    sources = sorted({row["distribution"] for row in usable_rows})
    yield Finding("ok", "plug-ins", f"{len(usable_rows)} usable, from {', '.join(sources)}")


@machine_check
def check_runtime_dir() -> Iterator[Finding]:
    """Check the directory in which the agents of this machine are found."""
    directory, about = runtime_dir(), "runtime directory"
    if not directory.exists():
        yield Finding("ok", about, f"{directory} does not exist: no agent has run yet")
        return
    try:
        found = look()
    except (PancakesError, OSError) as error:
        advice = f"make it yours only: chown {os.getuid()} {directory} && chmod 700 {directory}"
        yield Finding("error", about, str(error), advice)
        return
    for sentence in found.odd:
        yield Finding("warning", about, sentence, "find out which program put it there, and remove it")
    if found.cleared:
        text = f"{directory} had entries of agents that crashed or were killed: {', '.join(found.cleared)}"
        yield Finding("warning", about, text, "the entries were removed now; find out why those agents died")
    elif not found.odd:
        yield Finding("ok", about, f"only you can use {directory}")


@machine_check
def check_sockets() -> Iterator[Finding]:
    """Check the directories in which the agents of this machine listen at `local://NAME`."""
    base, about = runtime_dir() / DIRECTORY, "local sockets"
    found: list[Finding] = []
    try:
        directories = [base, *sorted(it for it in base.iterdir() if it.is_dir())]
    except OSError:
        return  # it does not exist, or `check_runtime_dir` reports why it cannot be used
    for directory in directories:
        try:
            usable(directory)
            odd = [it for it in sorted(directory.iterdir()) if not (it.is_socket() or it.is_dir())]
        except (PancakesError, OSError) as error:
            advice = f"make it yours only: chown {os.getuid()} {directory} && chmod 700 {directory}"
            found.append(Finding("error", about, str(error), advice))
            continue
        for path in odd:
            text = f"{printable(str(path))} is not a socket, so no agent can listen there"
            found.append(Finding("warning", about, text, "find out which program put it there, and remove it"))
    yield from found or [Finding("ok", about, f"only you, or one group, can use {base}")]


def state_base() -> Path:
    """Return the directory below which agents keep their state by default.

    Raises:
        NoHome: the environment does not name it.
    """
    from pancakes.config.state_dir import default_state_dir

    return default_state_dir("fleet", "agent").parents[1]


def check_state_dirs(base: Path) -> Iterator[Finding]:
    """Check the state directories of agents, `BASE/FLEET/AGENT`."""
    about = "state"
    if not base.exists():
        yield Finding("ok", about, f"{base} does not exist: no agent has saved state yet")
        return
    free_mib = shutil.disk_usage(base).free // 2**20
    if not os.access(base, os.W_OK | os.X_OK):
        yield Finding("error", about, f"{base} cannot be written", f"make it yours: chown -R {os.getuid()} {base}")
    if free_mib < NEARLY_FULL_MIB:
        level: Level = "error" if free_mib < FULL_MIB else "warning"
        yield Finding(
            level, about, f"only {free_mib} MiB are free in {base}", "make room: tasks cannot migrate without it"
        )
    else:
        yield Finding("ok", about, f"{free_mib} MiB are free in {base}")
    for directory in sorted(path for path in base.glob("*/*") if path.is_dir()):
        yield _check_journal(directory)


def _check_journal(directory: Path) -> Finding:
    """Check an agent's journal without opening it: that would count a boot and lock the agent out."""
    from pancakes.journal.file_journal import WRITE_AHEAD, fault_of, read_ahead
    from pancakes.journal.journal import BAD, SUFFIX, DamagedEntryError, name_of, unseal

    about = f"state of {directory.parent.name}/{directory.name}"
    torn = []
    try:
        aside = sorted(path.name for path in directory.glob(f"*{BAD}"))
        present = {path.name for path in directory.glob(f"*{SUFFIX}")}
        for path in sorted(directory.glob(f"*{SUFFIX}")):
            try:
                unseal("", path.read_bytes())
            except FileNotFoundError:
                continue  # a running agent replaces its entries
            except DamagedEntryError as error:
                torn.append(f"{path.name} {error}")
        ahead = read_ahead((directory / WRITE_AHEAD).read_bytes() if (directory / WRITE_AHEAD).exists() else b"")
        present |= {name_of(entry.kind, entry.key) for batch in ahead.batches for entry in batch.entries}
        if ahead.damaged:
            torn.append(f"{WRITE_AHEAD} is damaged, so the agent cannot trust any record of its tasks")
    except OSError as error:
        text = f"{directory} cannot be read: {(error.strerror or str(error)).lower()}"
        return Finding("error", about, text, f"make it yours: chown -R {os.getuid()} {directory}")
    fault = fault_of(directory, directory.stat())
    if fault:
        return Finding("error", about, fault, "fix that: its agent cannot start before")
    if torn:
        advice = "the agent sets it aside at its next start; then check for missing tasks"
        return Finding("error", about, f"in {directory}, {'; '.join(torn)}", advice)
    undecided = [
        name for name in aside if name.startswith("record.") and f"{name.partition(SUFFIX)[0]}{SUFFIX}" not in present
    ]
    if undecided:
        text = f"{directory} has lost records of tasks: {', '.join(undecided)}"
        advice = "decide what becomes of them: pancakes task recover AGENT/TASK"
        return Finding("warning", about, text, advice)
    if aside:
        advice = "remove them: none is needed any more"
        return Finding("warning", about, f"{directory} has entries that were set aside: {', '.join(aside)}", advice)
    holder = _holder(directory)
    return Finding(
        "ok", about, f"{directory} is in use by process {holder}" if holder else f"{directory} is not in use"
    )


def _holder(directory: Path) -> str:
    """Return the process that has locked a state directory; empty if none has."""
    with contextlib.suppress(OSError), (directory / "lock").open("rb") as lock:
        if is_locked(lock):
            return lock.read(32).decode("ascii", "replace").strip() or "?"
    return ""


@machine_check
def check_own_state() -> Iterator[Finding]:
    """Check the state of this user's agents in the default directory."""
    try:
        base = state_base()
    except NoHome as error:
        yield Finding("ok", "state", f"agents of this user must set state_dir: {error}")
    else:
        yield from check_state_dirs(base)


@machine_check
def check_own_keys() -> Iterator[Finding]:
    """Check this person's keys for fleets: whether they are valid, and for how long."""
    for fleet in fleets_of_person():
        folder = folder_of_person(fleet)
        renew = "ask the operator of that fleet to renew it: pancakes keys renew"
        try:
            from pancakes.security.keys import Keys

            keys = Keys(folder)
        except PancakesError as error:
            yield Finding("error", f"keys for {fleet}", str(error), renew)
            continue
        fault, left_s = keys.fault_of(keys.own), keys.own.ends_s - wall_ns() / 1e9
        who = f"{keys.own.role} {keys.own.name}"
        if fault:
            yield Finding(
                "error", f"keys for {fleet}", f"agents do not accept {who}: {fault}", f"{renew} {keys.own.name}"
            )
        elif left_s < SOON_S:
            text = f"the keys of {who} end in {left_s / 86_400:.0f} days"
            yield Finding("warning", f"keys for {fleet}", text, f"{renew} {keys.own.name}")
        else:
            yield Finding("ok", f"keys for {fleet}", f"you are {who} for another {left_s / 86_400:.0f} days")


@machine_check
def check_files(limits: tuple[int, int] | None = None) -> Iterator[Finding]:
    """Check how many files a process may have open."""
    soft, hard = limits or resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < FEW_FILES:
        text = f"a process may have only {soft} open: too few for an agent with many peers or devices"
        yield Finding("warning", "open files", text, f"raise it: ulimit -n {min(hard, 1024) if hard > 0 else 1024}")
    else:
        yield Finding("ok", "open files", f"a process may have {'any number' if soft < 0 else soft} open")


@machine_check
def check_clock() -> Iterator[Finding]:
    """Measure how late this machine wakes a thread that waits for a point in time."""
    from pancakes.kernel.timer import wake_on_time

    late: list[float] = []

    def wait() -> None:
        wake_on_time()
        for _ in range(WAITS):
            began_s = time.monotonic()
            time.sleep(WAIT_S)
            late.append(time.monotonic() - began_s - WAIT_S)

    thread = threading.Thread(target=wait, name="clock check")
    thread.start()
    thread.join()
    median_s = statistics.median(late)
    step_s = time.get_clock_info("monotonic").resolution
    text = (
        f"threads wake {median_s * 1e6:.0f} µs late (median), at most {max(late) * 1e6:.0f} µs;"
        f" the clock's resolution is {step_s:g} s"
    )
    if median_s > LATE_S:
        yield Finding("warning", "clock", text, "run less on this machine, or expect missed ticks at high rates")
    else:
        yield Finding("ok", "clock", text)


@machine_check
def check_loopback() -> Iterator[Finding]:
    """Check that this machine can connect to itself."""
    try:
        with (
            socket.create_server(("127.0.0.1", 0)) as server,
            socket.create_connection(server.getsockname(), timeout=2.0) as client,
        ):
            server.settimeout(2.0)
            connection, _ = server.accept()
            with connection:
                client.sendall(b"?")
                connection.settimeout(2.0)
                connection.recv(1)
    except OSError as error:
        text = f"no program can listen at 127.0.0.1: {(error.strerror or str(error)).lower()}"
        yield Finding("error", "loopback", text, "check the network of this machine or container: ip link set lo up")
    else:
        yield Finding("ok", "loopback", "programs can listen at 127.0.0.1")


def check_machine() -> Iterator[Finding]:
    """Run all checks of this machine."""
    for check in MACHINE_CHECKS:
        yield from check()
