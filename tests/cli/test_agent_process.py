"""An agent as a process: its start, its end, and the faults that it survives."""

import os
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable

import pytest
from cli.processes import INSECURE, PATIENCE_S, READY, Rig, Running
from harness.programs import AGENT

from pancakes.tools.cli.agent_process import TWICE_S

STOPPED_WITHIN_S = 2.0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT], ids=lambda number: number.name)
def test_agent_stops_gracefully_on_a_signal(rig: Rig, number: signal.Signals):
    agent = rig.ready("a", '[device.load]\ndriver = "host.load"\nrate_hz = 50\n')

    code, took_s = agent.signalled(number)

    assert code == 0
    assert took_s < STOPPED_WITHIN_S
    assert "service_stopped service=device" in agent.everything()
    assert not [path for path in rig.runtime.rglob("*") if not path.is_dir()]


def test_agent_frees_a_simulated_world_before_exit(rig: Rig):
    world = '[task.World]\ntype = "sim.world"\n[task.World.settings]\nbus = "tcp://127.0.0.1:0"\n'
    agent = rig.ready("w", world + 'robots.r = { model = "khepera3", x_m = 0.0, y_m = 0.0, theta_rad = 0.0 }\n')

    code, _ = agent.signalled(signal.SIGTERM)

    assert (code, "extern" in agent.everything()) == (0, False)


def test_frozen_agent_handles_a_sigterm_when_continued(rig: Rig, freeze: Callable[[Running], None]):
    # The kernel then gives the signal to any thread, and Python wakes none for it.
    agent = rig.ready("a")

    freeze(agent)
    agent.process.send_signal(signal.SIGTERM)
    code, took_s = agent.signalled(signal.SIGCONT)

    assert code == 0
    assert took_s < STOPPED_WITHIN_S


SLOW = """
import sys, threading
from pancakes.task import Task

class Slow(Task):
    pass

class Library:
    def __del__(self, wait=threading.Event().wait):
        wait(10)

sys.modules["library"] = Library()  # which Python clears at its end
"""


def test_slow_python_exit_does_not_kill_a_stopped_agent(rig: Rig):
    rig.install("slow", "[pancakes.tasks]\nslow.Slow = plugin_slow:Slow\n", SLOW)
    agent = rig.agent(rig.config("a", '[task.Slow]\ntype = "slow.Slow"\n'), true_start=True)
    agent.hear(READY)
    assert agent.signalled(signal.SIGTERM)[0] == 0


STUCK = """
import threading
from pancakes.task import Task

class Stuck(Task):
    blocking = True

    def on_start(self):
        self.log("info", "stuck from now on")
        threading.Event().wait()
"""


@pytest.fixture
def stuck(rig: Rig) -> Running:
    """Return an agent with a task whose handler never returns."""
    rig.install("stuck", "[pancakes.tasks]\nstuck.Stuck = plugin_stuck:Stuck\n", STUCK)
    agent = rig.agent(rig.config("a", '[task.Stuck]\ntype = "stuck.Stuck"\n'))
    agent.hear("stuck from now on")
    rig.entry(agent.pid)
    return agent


def test_agent_ends_in_time_with_a_stuck_task(stuck: Running):
    code, took_s = stuck.signalled(signal.SIGTERM)

    assert took_s < STOPPED_WITHIN_S + 0.2
    assert code in (0, 1)


def test_agent_ends_at_once_on_a_second_signal(rig: Rig, stuck: Running):
    stuck.process.send_signal(signal.SIGTERM)
    rig.wait_until_gone(stuck.pid)  # the first step of its stop
    threading.Event().wait(2 * TWICE_S)  # an earlier one would count as the same signal
    code, took_s = stuck.signalled(signal.SIGTERM)

    assert code == 1
    assert took_s < 1.0


def test_agent_counts_two_simultaneous_signals_as_one(rig: Rig):
    """As `timeout` sends them: to the process, and to its group."""
    agent = rig.ready("a")
    agent.process.send_signal(signal.SIGTERM)
    code, _ = agent.signalled(signal.SIGTERM)

    assert code == 0


def test_agent_whose_port_or_name_is_taken_ends_with_an_error(rig: Rig):
    first = rig.ready("a")
    taken = rig.address(first)
    second, third = rig.config("a", file="second.toml"), rig.config("b")
    own = ("--set", f"agent.state_dir={rig.directory}/second")
    state = rig.directory / "state" / "pancakes" / "test" / "a"
    runs = f"a already runs (process {first.pid}): end it with `pancakes down a`, or give this agent another name"
    for config, options, said in (
        (second, (), runs),
        (second, own, runs),
        (second, ("--set", "agent.role=environment"), runs),
        (third, ("--set", f"agent.state_dir={state}"), f"is in use by another agent (process {first.pid})"),
        (third, ("--set", f"agent.listen={taken}"), f"cannot listen at {taken}: address already in use"),
    ):
        other = rig.agent(config, *options)
        assert other.ended() == 1
        assert said in other.everything() and "Traceback" not in other.everything()
    assert first.process.poll() is None and rig.pancakes("agent", "list").returncode == 0


EXITS = """
import sys
from pancakes.service import Service

class Exits(Service):
    @classmethod
    def refuse_stop(cls, kernel, name, arguments, for_s):
        sys.exit(3)
"""


def test_agent_with_a_failed_root_answers_and_ends(rig: Rig):
    rig.install("exits", "[pancakes.services]\nexits.Exits = plugin_exits:Exits\n", EXITS)
    agent = rig.ready("a", '[service.own]\ntype = "exits.Exits"\n')

    asked = rig.pancakes("service", "stop", "a/own")

    why = "a/kernel, which starts and watches the services, has failed: SystemExit: 3 at plugin_exits.py:"
    assert asked.returncode == 1
    assert asked.stderr.startswith(f"a ends: {why}")
    assert agent.ended() == 1
    assert agent.said[-1].startswith(f"a cannot run: {why}")
    assert any("error" in line and why in line for line in agent.said[:-1])
    assert not [path for path in rig.runtime.rglob("*") if not path.is_dir()]


def test_agent_that_cannot_run_reports_why_before_it_ends(rig: Rig) -> None:
    stuck = (
        "import time; from pancakes.tools.cli.agent_process import Orders; orders = Orders(); orders.begin();"
        " orders.give_up('its port is in use'); orders.wait(60, print, print); time.sleep(60)"
    )
    running = rig.run("-c", stuck)
    assert running.ended() == 1
    assert running.said == [
        "the agent cannot run: its port is in use",
        "the agent did not stop within 1.9 s and was ended",
    ]


@pytest.mark.parametrize("network", [INSECURE, ""], ids=["insecure", "with keys"])
def test_broken_protocol_closes_only_that_link(rig: Rig, network: str):
    agent = rig.ready("a", network)
    for sent in (b"GET / HTTP/1.1\r\nHost: robot\r\n\r\n", struct.pack(">I", 10 * 1024 * 1024) + b"x" * 1000):
        with socket.create_connection(("127.0.0.1", rig.port(agent)), timeout=10.0) as stranger:
            stranger.sendall(sent)
            while stranger.recv(4096):  # its hello and its refusal, then it closes
                pass
    agent.hear("no link over a connection from tcp://127.0.0.1: ")  # once, for both
    assert rig.pancakes("task", "list", "a").returncode == 0


def test_agent_runs_without_a_plugin_that_cannot_be_imported(rig: Rig):
    rig.install("broken", "[pancakes.tasks]\nbroken.Task = plugin_broken:Task\n", "import there_is_no_such_module\n")
    load = '[device.load]\ndriver = "host.load"\nrate_hz = 1\n'
    agent = rig.agent(rig.config("a", f'[task.Broken]\ntype = "broken.Task"\n{load}'))
    agent.hear("task_started task=load")
    agent.hear(READY)
    line = agent.hear("the task Broken does not run")
    assert "of broken 1.0 (plugin_broken:Task) cannot be loaded: ModuleNotFoundError" in line

    checked = rig.agent(rig.config("b"), "--check")
    assert checked.ended() == 0, "the configuration does not name it"
    assert "warning: the task type 'broken.Task' of broken 1.0" in checked.everything()


LOGS = """
import logging
from pancakes.task import Task

class Chatty(Task):
    def on_start(self):
        try:
            {}["left"]
        except KeyError:
            logging.getLogger("wheels").exception("no wheel")
"""


def test_agent_log_has_library_logs_without_traceback(rig: Rig):
    rig.install("chatty", "[pancakes.tasks]\nchatty.Chatty = plugin_chatty:Chatty\n", LOGS)

    agent = rig.agent(rig.config("a", '[task.Chatty]\ntype = "chatty.Chatty"\n'))

    assert "wheels: no wheel: KeyError: 'left' at plugin_chatty.py:" in agent.hear("no wheel")
    assert agent.signalled(signal.SIGTERM)[0] == 0
    assert "Traceback" not in agent.everything()


PARENT = """
import subprocess, sys, time
command = [sys.executable, "-m", "pancakes.tools.cli.agent_command", "--config", sys.argv[1], "--die-with-parent"]
agent = subprocess.Popen(command)
agent.wait()
"""


def test_agent_ends_with_its_launcher(rig: Rig):
    parent = rig.run("-c", PARENT, str(rig.config("a")))
    parent.hear(READY)

    parent.process.kill()

    assert "service_stopped service=device" in parent.everything()  # which the agent had open as well, and closed


def test_agent_does_not_start_without_its_launcher(rig: Rig):
    agent = rig.agent(rig.config("a"), "--die-with-parent=1")  # our process is its parent, not that of number 1

    assert agent.ended() == 1
    assert agent.everything() == "the process 1, which launched this agent, has ended"


HEAVY = (
    # others' packages that something else in the project uses
    *(
        "docstring_parser",
        "matplotlib",
        "mcap",
        "numpy",
        "prometheus_client",
        "psutil",
        "pymunk",
        "rich",
        "tomlkit",
    ),
    "websockets",
    # what only a recording, or a question about it, needs
    *("pancakes.recording.recording", "pancakes.services.traces"),
    # parts of Python, each of which takes milliseconds, and up to 4 MiB
    *("asyncio", "concurrent.futures", "configparser", "ctypes", "difflib", "email", "encodings.idna", "hashlib"),
    *("http", "importlib.metadata", "multiprocessing", "ssl", "subprocess", "tempfile", "unittest", "xml", "zipfile"),
)
IMPORTED = """
import sys
from pancakes.task import Task

class Imported(Task):
    def on_start(self):
        self.log("info", "heavy: " + ",".join(name for name in %r if name in sys.modules))
"""


def test_idle_agent_imports_nothing_heavy(rig: Rig):
    rig.install("imported", "[pancakes.tasks]\nimported.Imported = plugin_imported:Imported\n", IMPORTED % (HEAVY,))

    config = f'{INSECURE}[task.Imported]\ntype = "imported.Imported"\n'
    agent = rig.agent(rig.config("a", config), true_start=True)

    assert agent.hear("heavy: ").endswith("heavy: ")


def test_help_imports_no_part_of_the_agent(rig: Rig):
    source = (
        "import sys\nfrom pancakes.tools.cli import agent_command, main\n"
        "for command in (agent_command.agent, main.pancakes):\n"
        "    try: command(['--help'])\n"
        "    except SystemExit: pass\n"
        "print([name for name in sys.modules if name in ('pykka', 'msgpack', 'msgspec', 'rich')], file=sys.stderr)\n"
    )
    asked = rig.run("-c", source)

    assert asked.ended() == 0
    assert asked.everything() == "[]"


def test_example_agent_for_everybody_runs(rig: Rig, request: pytest.FixtureRequest):
    agent = rig.agent(request.config.rootpath / "configs" / "single.toml")
    agent.hear(READY)
    rig.entry(agent.pid)
    assert "host.memory" in rig.pancakes("task", "list", "single").stdout
    assert agent.signalled(signal.SIGTERM)[0] == 0


def test_hangup_reopens_a_moved_log_file(rig: Rig):
    """As `postrotate` of logrotate sends it; no other line comes meanwhile."""
    agent = rig.agent(rig.config("a", '[service.log]\nsettings = { file = "a.jsonl" }'))
    agent.hear(READY)
    path = rig.directory / "a.jsonl"
    agent.wait_for_file(path)
    for number in (1, 2):  # twice: SIGHUP must not count as a second stop signal
        path.rename(rig.directory / f"moved.{number}.jsonl")
        agent.process.send_signal(signal.SIGHUP)
        agent.wait_for_file(path)
    assert agent.signalled(signal.SIGTERM)[0] == 0
    said = agent.everything()
    assert said.count("SIGHUP: ") == said.count("a.jsonl was moved or removed by another program") == 2


def test_hangup_of_its_terminal_ends_an_agent(rig: Rig):
    config = rig.config("a")
    ours, its = os.openpty()
    agent = subprocess.Popen(
        [sys.executable, "-m", AGENT, "--config", str(config)],
        stdin=its,
        stderr=subprocess.PIPE,
        text=True,
        env=rig.environment,
        cwd=rig.directory,
    )
    with agent:
        try:
            assert agent.stderr is not None and any(READY in line for line in agent.stderr)
            agent.send_signal(signal.SIGHUP)
            assert agent.wait(PATIENCE_S) == 0
        finally:
            agent.kill()
            os.close(its)
            os.close(ours)
