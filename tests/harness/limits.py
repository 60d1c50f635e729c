"""Ends a test that takes too long, with the stacks of all threads: a pytest plug-in.

A conftest loads it by `pytest_plugins = ["harness.limits"]`. There are three limits:

- **CPU time**, `@pytest.mark.cpu_limit(seconds)`: what a test takes of the processor in its own process, set-up and
  tear-down included, on all threads. A machine with other work does not use it up. The CPU time of child processes is
  not counted, so a test that starts agents needs the wall limit as well.
- **Wall time**, the `timeout` of pytest-timeout (option, ini key or marker) with its method `signal`. This plug-in
  raises in its place: pytest-timeout raises once only, prints the stacks elsewhere, and hypothesis takes its exception
  for a failing example, which it then runs again, without a limit.
- **The net**, `NET_S` after the wall limit: the process ends with the stacks of its threads on stderr, whatever it
  does. Only that ends C code that does not return to Python. xdist says which test it was, and starts a new worker.

The first two raise `OverLimit` in the main thread, again and again until the test gives in. A test that swallows the
exception fails all the same. Signals: SIGPROF (`ITIMER_PROF`) and SIGALRM (`ITIMER_REAL`). A main thread that waits for
a lock while another thread uses up the CPU time hears of it only when it runs again, or at the wall limit.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Final

import pytest
from _pytest.outcomes import OutcomeException

MARKER: Final = "cpu_limit"
AGAIN_S: Final = 10.0
"""A test that goes on after its limit is ended again so much later: time for its fixtures to clear up."""
NET_S: Final = 60.0

_RUNNERS: Final = ("/_pytest/", "/pluggy/", "/xdist/", "/execnet/")
_PHASE: Final[pytest.StashKey[bool]] = pytest.StashKey()
_SAID: Final[pytest.StashKey[str]] = pytest.StashKey()
_WALL_S: Final[pytest.StashKey[float]] = pytest.StashKey()
_STDERR: Final[pytest.StashKey[int]] = pytest.StashKey()


class OverLimit(OutcomeException):
    """A test has taken too long. It is no `pytest.fail.Exception`, which hypothesis would try again."""


def cpu_limit_s(item: pytest.Item) -> float:
    """Return the CPU seconds that a test may take, as the marker nearest to it says; 0: any number."""
    mark = item.get_closest_marker(MARKER)
    return float(mark.args[0]) if mark is not None else 0.0


def stacks(here: FrameType | None) -> str:
    """Return the stacks of all threads without the frames of pytest; of the calling thread, which is last, `here`."""
    frames = sys._current_frames()  # noqa: SLF001 - there is no other way
    own = frames.pop(threading.get_ident())
    names = {thread.ident: thread.name for thread in threading.enumerate()}
    texts = []
    for number, frame in [*frames.items(), (threading.get_ident(), here or own)]:
        stack = [it for it in traceback.extract_stack(frame) if not any(part in it.filename for part in _RUNNERS)]
        if stack:  # else it is a thread of xdist's own
            name = names.get(number, "a thread without a name")
            texts += [f"Stack of {name}:\n", *traceback.format_list(stack)]
    return "".join(texts).rstrip()


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", f"{MARKER}(seconds): the CPU time that the test may take in its own process")
    config.stash[_STDERR] = os.dup(2)  # not yet caught by pytest, and a test may close what it finds at 2


def pytest_unconfigure(config: pytest.Config) -> None:
    faulthandler.cancel_dump_traceback_later()
    os.close(config.stash[_STDERR])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[Any]:
    """Limit the CPU time of a test and of its fixtures."""
    limit_s = cpu_limit_s(item)

    def over(number: int, frame: FrameType | None) -> None:
        __tracebackhide__ = True
        if not _debugged(item):
            _end(item, f"it took more than {limit_s:g} s of CPU time", frame)

    before = signal.getsignal(signal.SIGPROF)
    if limit_s > 0.0:
        signal.signal(signal.SIGPROF, over)
        signal.setitimer(signal.ITIMER_PROF, limit_s, AGAIN_S)
    try:
        return (yield)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        faulthandler.cancel_dump_traceback_later()
        # A signal that is on its way must find a handler, or it ends the process.
        signal.signal(signal.SIGPROF, signal.SIG_IGN if before is signal.SIG_DFL else before)


@pytest.hookimpl(tryfirst=True)
def pytest_timeout_set_timer(item: pytest.Item, settings: Any) -> bool | None:
    """Limit the wall time in place of pytest-timeout, and spread the net."""
    item.stash[_WALL_S] = settings.timeout
    _spread_net(item)
    if settings.method != "signal" or threading.current_thread() is not threading.main_thread():
        return None

    def over(number: int, frame: FrameType | None) -> None:
        __tracebackhide__ = True
        if settings.disable_debugger_detection or not _debugged(item):
            _end(item, f"Timeout: it took more than {settings.timeout:g} s", frame)

    def cancel() -> None:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)

    item.cancel_timeout = cancel  # where pytest-timeout looks for it
    signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, settings.timeout, AGAIN_S)
    return True


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[Any]:
    with _phase(item):
        return (yield)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[Any]:
    with _phase(item):
        return (yield)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> Iterator[Any]:
    _spread_net(item)  # again: pytest takes it away when a test fails
    with _phase(item):
        return (yield)


@contextmanager
def _phase(item: pytest.Item) -> Iterator[None]:
    """Let the test be ended while it runs: what is raised outside of its phases would end pytest itself."""
    item.stash[_PHASE] = True
    try:
        yield
    finally:
        item.stash[_PHASE] = False


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[Any]:
    """Let a test fail that went on although its time was up, and say so of one that failed by something else."""
    report: pytest.TestReport = yield
    said = item.stash.get(_SAID, "")
    if not said or (call.excinfo is not None and isinstance(call.excinfo.value, OverLimit)):
        item.stash[_SAID] = ""
        return report
    if not report.failed:
        report.outcome, report.longrepr = "failed", f"{said}\nThe test went on after that."
    else:
        report.sections.append(("the test went on after its time was up", said))
    item.stash[_SAID] = ""
    return report


def _debugged(item: pytest.Item) -> bool:
    """Return whether somebody looks at the test with a debugger, and needs time for that."""
    debugged: bool = item.config.pluginmanager.getplugin("timeout").is_debugging()
    return debugged


def _spread_net(item: pytest.Item) -> None:
    after_s = item.stash.get(_WALL_S, 0.0)
    if after_s > 0.0 and not _debugged(item):
        faulthandler.dump_traceback_later(after_s + NET_S, file=item.config.stash[_STDERR], exit=True)


def _end(item: pytest.Item, why: str, frame: FrameType | None) -> None:
    __tracebackhide__ = True
    if not item.stash.get(_PHASE, False):
        return
    said = f"{why}\n{stacks(frame)}"
    item.stash[_SAID] = said
    raise OverLimit(said)
