"""Run an agent as a process: from its command line until it has ended.

Here is all that an agent with a process of its own asks of its surroundings: settings of the Python interpreter and the
system, the notifications of systemd (sd_notify), signals, and the entry by which `pancakes` finds it. A program that
runs agents in its own process must call `tune_interpreter` and `freeze_heap` itself, because both concern the whole
process.
Importing this module must stay cheap: configuration and agent are imported when it runs.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import resource
import select
import signal
import socket
import sys
from collections import deque
from collections.abc import Callable, MutableMapping, Sequence
from contextlib import suppress
from types import FrameType
from typing import TYPE_CHECKING, Any, Final, NoReturn

from pancakes.tools.cli.exit_codes import OK, REFUSED
from pancakes.tools.cli.output import show_text
from pancakes.util.clock import MonotonicClock

if TYPE_CHECKING:
    from pancakes.agent.agent import Agent
    from pancakes.config import Config
    from pancakes.util.plugins import Plugins
    from pancakes.util.runtime_dir import Registration


SWITCH_S: Final = 0.0002
"""A thread that computes gives the interpreter to another after this time, in seconds; Python's own time is 5 ms. A
tick waits for it twice: in the timer's thread and in the pool's. With a longer time, the ticks of other tasks are late
beside a task that computes without pause, and beside a task that sends without pause the network's thread hardly runs:
each system call releases the interpreter, for a moment that is too short to wake up in. Two threads that compute are a
little slower for it."""
COLLECT_EACH: Final = (10_000, 10, 10)
"""Python's garbage collector runs when this many more objects are alive than after its last run. An agent makes little
garbage that the collector must find, and a start makes many objects that stay."""
FILES: Final = 4096
"""How many files an agent may have open, if the system allows it. All agents, clients and new connections of a full
mesh need more than the limit that some systems begin with; without a free file no operator can connect."""


def tune_interpreter() -> None:
    """Set the switch interval, the garbage collector and the limit of open files of this process."""
    sys.setswitchinterval(SWITCH_S)
    gc.set_threshold(*COLLECT_EACH)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= soft < FILES:
        with contextlib.suppress(OSError, ValueError):  # it goes on with what it has; `pancakes doctor` says so
            resource.setrlimit(resource.RLIMIT_NOFILE, (FILES if hard < 0 else min(FILES, hard), hard))


def freeze_heap() -> None:
    """Take all present objects out of the garbage collector's sight. Call it when most modules are imported.

    A full collection stops all threads, and most objects of an idle agent are modules, classes and functions.
    """
    gc.freeze()


_SOCKET: Final = "NOTIFY_SOCKET"
_WATCHDOG: Final = "WATCHDOG_USEC"
_WATCHDOG_PID: Final = "WATCHDOG_PID"


class NotifySocket:
    """The socket of the service manager, such as systemd. From any thread.

    Args:
        address: where it is; a name in the abstract namespace begins with `@`.
        watchdog_s: the service manager takes the process for hung where it hears nothing for so long; None: it does
            not look.
    """

    def __init__(self, address: str, watchdog_s: float | None = None) -> None:
        self.watchdog_s = watchdog_s
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)  # the timer's thread waits for no manager

    @classmethod
    def from_environment(cls, variables: MutableMapping[str, str]) -> NotifySocket | None:
        """Return the socket that the environment names; None: no service manager has started this process.

        It takes the variables out, because a process that this one starts must not speak in its name.
        """
        address, watchdog, pid = (variables.pop(name, "") for name in (_SOCKET, _WATCHDOG, _WATCHDOG_PID))
        if not address.startswith(("/", "@")):
            return None
        watched = watchdog.isdecimal() and int(watchdog) > 0 and pid in ("", str(os.getpid()))
        return cls(address, int(watchdog) / 1e6 if watched else None)

    def say(self, **facts: str | int) -> None:
        """Say something, such as `READY=1`. A manager that does not listen any more need not know."""
        with suppress(OSError):
            self._socket.sendto("\n".join(f"{key}={value}" for key, value in facts.items()).encode(), self._address)


STOP_S: Final = 1.9
"""An agent that has not stopped in good order by then is ended all the same, in seconds."""
TWICE_S: Final = 0.05
"""The same signal so soon again, in seconds, is the same wish; later, it ends the agent at once."""
SHOW_TRACEBACKS: Final = "service.log.settings.traceback=true"
"""What `--traceback` changes of a configuration."""


def run(path: str, sets: Sequence[str], check: bool, parent_pid: int | None, ready_fd: int | None) -> None:
    """Run an agent until it is told to stop, or check its configuration. Ends the process if it has run.

    Args:
        path: the configuration file.
        sets: what is changed of it, each as `table.key=value`.
        check: whether the configuration is only checked.
        parent_pid: the process with which the agent ends, 0 for the one that launched it; None: it ends with none.
        ready_fd: the file descriptor that learns when the agent is ready; None: none.
    """
    orders = None if check else Orders()
    if orders is not None:
        tune_interpreter()
    if parent_pid is not None:
        from pancakes.tools.cli.parent_death import die_with_parent

        die_with_parent(parent_pid)
    from pancakes.config import load
    from pancakes.util.plugins import Plugins

    plugins = Plugins()
    config = load(path, sets, plugins, must_load=check)
    if orders is None:
        _check(config, plugins)
    else:
        orders.end(_run(config, plugins, orders, ready_fd))


class Orders:
    """Wait for a signal, or for a reason why the agent cannot go on. Made before the agent, so that none is missed.

    From then on it has `STOP_S` to end: one that a stuck task or driver delays is ended all the same. Before it has
    begun there is nothing to end in order, and the process ends at once.

    SIGHUP ends it if a terminal is its standard input: that one closes. Else another program has moved its files, and
    it goes on.
    """

    def __init__(self) -> None:
        # Registered first, so called last. What follows it in Python's own end gives SIGALRM its default effect again,
        # and on a slow machine an agent that had stopped in good order would die of it.
        atexit.register(self._leave)
        self._code: int | None = None
        self._begun = False
        self._reasons: deque[str] = deque()
        self._now = MonotonicClock().now
        self._seen: dict[int, float] = {}  # when each signal came first
        # The kernel may hand a signal to any thread, and Python handles it in this one, which has to be woken for that.
        self._wake_reader, self._wake_writer = os.pipe()
        os.set_blocking(self._wake_writer, False)
        signal.set_wakeup_fd(self._wake_writer, warn_on_full_buffer=False)
        signal.signal(signal.SIGALRM, self._too_late)
        self._hung_up = False
        at_hangup = self._heard if os.isatty(0) else self._hear_hangup
        for number, hear in ((signal.SIGINT, self._heard), (signal.SIGTERM, self._heard), (signal.SIGHUP, at_hangup)):
            if signal.getsignal(number) is not signal.SIG_IGN:  # as `nohup` asks for
                signal.signal(number, hear)

    def begin(self) -> None:
        """The agent begins: from here on it is ended in order."""
        self._begun = True

    def end(self, code: int) -> NoReturn:
        """End the process, which has stopped in good order."""
        self._code = code
        sys.exit(code)

    def give_up(self, reason: str) -> None:
        """End the wait with a reason, which is empty if the agent was asked to end. From any thread."""
        self._reasons.append(reason)
        os.write(self._wake_writer, b"\0")

    def wait(self, every_s: float, meanwhile: Callable[[], None], at_hangup: Callable[[], None]) -> str:
        """Wait until the agent is to stop; return why it cannot go on, empty if it was told to.

        Args:
            every_s: how often `meanwhile` is called.
            meanwhile: what this thread does besides.
            at_hangup: called after a SIGHUP that does not end the agent.
        """
        while not self._reasons:
            if select.select([self._wake_reader], [], [], every_s)[0]:
                os.read(self._wake_reader, 1)
            else:
                meanwhile()
            if self._hung_up:
                self._hung_up = False
                at_hangup()
        if not self._seen:
            signal.setitimer(signal.ITIMER_REAL, STOP_S)
        return self._reasons[0]

    def _leave(self) -> None:
        if self._code is not None:
            for stream in (sys.stdout, sys.stderr):
                with contextlib.suppress(OSError, ValueError):  # nobody reads it any more, or it is closed
                    stream.flush()
            os._exit(self._code)

    def _heard(self, number: int, frame: FrameType | None) -> None:
        if not self._begun:
            os._exit(OK)
        # A terminal and a launcher may both send a signal. Only a second signal of one kind means: do not wait.
        if number in self._seen:
            # `timeout` tells a process, and then its group, in which it is again: that is once.
            if self._now() - self._seen[number] >= TWICE_S:
                os._exit(REFUSED)
            return
        if not self._seen:
            signal.setitimer(signal.ITIMER_REAL, STOP_S)
        self._seen[number] = self._now()
        self._reasons.append("")

    def _hear_hangup(self, number: int, frame: FrameType | None) -> None:
        self._hung_up = True

    def _too_late(self, number: int, frame: FrameType | None) -> None:
        reason = self._reasons[0] if self._reasons else ""
        why = f"the agent cannot run: {reason}\n" if reason else ""
        os.write(2, f"{why}the agent did not stop within {STOP_S:g} s and was ended\n".encode())
        os._exit(REFUSED)


def _run(config: Config, plugins: Plugins, orders: Orders, ready_fd: int | None) -> int:
    from pancakes.agent.agent import Agent
    from pancakes.util.runtime_dir import LOOK_S

    _must_be_alone(config)
    manager = NotifySocket.from_environment(os.environ)
    running = Agent(config, plugins)
    deafen = _listen_to_libraries(running)
    freeze_heap()
    running.on_fatal(orders.give_up)
    running.on_shutdown(lambda: orders.give_up(""))
    orders.begin()
    running.start()
    registration = _register(running)
    if ready_fd is not None:
        _when_ready(running, lambda: _tell_launcher(running, ready_fd))
    if manager is not None:
        _when_ready(running, lambda: manager.say(READY=1, STATUS=f"{running.name} is ready"))
        _feed_watchdog(running, manager)
    reason = orders.wait(LOOK_S, lambda: _renew(registration, running), lambda: _tell_of_hangup(running))
    if manager is not None:
        manager.say(STOPPING=1, STATUS=reason or f"{running.name} ends")
    # From now on no command finds the agent, which is about to end.
    if registration is not None:
        registration.remove()
    running.stop()
    deafen()
    if reason:
        _warn(f"{running.name} cannot run: {reason}")
    return REFUSED if reason else OK


def _must_be_alone(config: Config) -> None:
    """See to it that no other agent of this name and fleet runs on this machine.

    Raises:
        PancakesError: one does.
    """
    from pancakes.errors import PancakesError
    from pancakes.util.runtime_dir import entries

    agent = config.agent
    try:
        there = [it.pid for it in entries() if (it.name, it.fleet) == (agent.name, agent.fleet)]
    except PancakesError:
        return  # without the runtime directory none is found, and that is told when this one cannot be entered there
    if there:
        raise PancakesError(
            f"{agent.name} already runs (process {there[0]}): end it with `pancakes down {agent.name}`, or give this"
            " agent another name"
        )


def _check(config: Config, plugins: Plugins) -> None:
    """Say that a configuration is sound, and which plug-ins of this environment are not."""
    from pancakes.errors import PluginError
    from pancakes.tools.cli.start_checks import machine_doubts
    from pancakes.util.plugins import GROUPS

    for group in GROUPS:
        for name in plugins.names(group):
            try:
                plugins.get(group, name)
            except PluginError:
                continue  # `problems` has it
    for problem in plugins.problems():
        _warn(f"warning: {problem}")
    for doubt in machine_doubts(config, plugins):
        _warn(f"warning: {doubt}")
    show_text(f"{config.path} is sound: the agent {config.agent.name} of the fleet {config.agent.fleet}")


def _register(running: Agent) -> Registration | None:
    """Let `pancakes` find the agent. One that cannot be found runs all the same."""
    from pancakes.errors import PancakesError
    from pancakes.mesh.peers import reachable
    from pancakes.util.runtime_dir import Registration, RunningAgent

    agent = running.config.agent
    listen = tuple(reachable(address, "tcp://127.0.0.1:0") for address in running.mesh.listen)
    try:
        return Registration(RunningAgent(agent.name, agent.fleet, agent.role, listen, os.getpid()), agent.local_group)
    except PancakesError as error:
        _warn(f"warning: `pancakes` will find {agent.name} only with --at: {error}")
        return None


def _renew(registration: Registration | None, running: Agent) -> None:
    """Let `pancakes` find the agent again where its entry is gone."""
    if registration is not None and registration.renew():
        running.kernel.log(
            "info", f"`pancakes` finds {running.name} again: its entry in the runtime directory was gone"
        )


def _tell_of_hangup(running: Agent) -> None:
    """Say that a SIGHUP came: the log file and the recording look with each line whether they were moved."""
    running.kernel.log("info", "SIGHUP: the log file and the recording begin again if another program has moved them")


def _when_ready(running: Agent, tell: Callable[[], None]) -> None:
    import threading

    def wait() -> None:
        running.ready.wait()
        tell()

    threading.Thread(target=wait, name=f"{running.name}-ready", daemon=True).start()


def _tell_launcher(running: Agent, ready_fd: int) -> None:
    """Let the launcher know that the agent is ready, and before that which of its tasks do not start.

    Each is a line: `rests SERVICE/TASK WHY`, and at the end `ready`. A launcher that has gone need not know.
    """
    import contextlib

    told = [*(f"rests {task} {why}" for task, why in running.resting.items()), "ready"]
    with contextlib.suppress(OSError), open(ready_fd, "w", encoding="utf-8") as pipe:
        pipe.writelines(f"{line}\n" for line in told)


def _feed_watchdog(running: Agent, manager: NotifySocket) -> None:
    """Have the timer's thread say that the agent lives, twice as often as it must: no tick comes where it hangs."""
    if manager.watchdog_s is None:
        return
    period_s = manager.watchdog_s / 2

    def feed() -> None:
        manager.say(WATCHDOG=1)
        running.kernel.timer.after_host(period_s, feed)

    feed()


def _listen_to_libraries(running: Agent) -> Callable[[], None]:
    """Send what libraries log, and how threads die, to the agent's `log`: as sentences, each with its traceback
    where the settings ask for it.

    Returns:
        What ends that, for when the agent has stopped. The agent would else live until Python takes its modules apart,
        and some things, like a space of pymunk's, cannot be freed that late: they end the process with a fault.
    """
    import logging
    import threading

    from pancakes.errors import describe, traceback_of

    levels = {"DEBUG": "debug", "INFO": "info", "WARNING": "warning"}

    class ToLog(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            error = record.exc_info[1] if record.exc_info else None
            text, traceback = f"{record.name}: {record.getMessage()}", ""
            if error is not None:
                text, traceback = f"{text}: {describe(error)}", traceback_of(error)
            running.kernel.log(levels.get(record.levelname, "error"), text, traceback)

    def died(args: Any) -> None:
        if args.exc_value is not None:
            name = args.thread.name if args.thread is not None else "a thread"
            text = f"the thread {name} died: {describe(args.exc_value)}"
            running.kernel.log("error", text, traceback_of(args.exc_value))

    def deafen() -> None:
        logging.getLogger().removeHandler(handler)
        threading.excepthook = threading.__excepthook__

    handler = ToLog(logging.WARNING)
    logging.getLogger().addHandler(handler)
    threading.excepthook = died
    return deafen


def _warn(text: str) -> None:
    show_text(text, err=True)
