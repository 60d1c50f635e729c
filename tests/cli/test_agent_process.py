"""An agent as a process: how it begins, how it ends, and what it survives."""

import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable

import pytest
from cli.processes import INSECURE, READY, Rig, Running

from pancakes.tools.cli.agent_process import TWICE_S

STOPPED_WITHIN_S = 2.0


def test_a_sigterm_stops_it_in_good_order_within_two_seconds(rig: Rig):
    agent = rig.ready("a", '[device.load]\ndriver = "host.load"\nrate_hz = 50\n')

    code, took_s = agent.signalled(signal.SIGTERM)

    assert code == 0
    assert took_s < STOPPED_WITHIN_S
    assert "service_stopped service=device" in agent.everything()
    assert not [path for path in rig.runtime.rglob("*") if not path.is_dir()]


def test_what_a_simulated_world_holds_is_freed_before_python_takes_its_modules_apart(rig: Rig):
    world = '[task.World]\ntype = "sim.world"\n[task.World.settings]\nbus = "tcp://127.0.0.1:0"\n'
    agent = rig.ready("w", world + 'robots.r = { model = "khepera3", x_m = 0.0, y_m = 0.0, theta_rad = 0.0 }\n')

    code, _ = agent.signalled(signal.SIGTERM)

    assert (code, "extern" in agent.everything()) == (0, False)


def test_a_sigint_does_the_same(rig: Rig):
    code, took_s = rig.ready("a").signalled(signal.SIGINT)

    assert code == 0
    assert took_s < STOPPED_WITHIN_S


def test_a_sigterm_is_heard_after_the_process_was_frozen(rig: Rig, freeze: Callable[[Running], None]):
    # The kernel then gives the signal to any thread, and Python wakes none for it.
    agent = rig.ready("a")

    freeze(agent)
    agent.process.send_signal(signal.SIGTERM)
    code, took_s = agent.signalled(signal.SIGCONT)

    assert code == 0
    assert took_s < STOPPED_WITHIN_S


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
    """An agent with a task that never gives its thread back."""
    rig.install("stuck", "[pancakes.tasks]\nstuck.Stuck = plugin_stuck:Stuck\n", STUCK)
    agent = rig.agent(rig.config("a", '[task.Stuck]\ntype = "stuck.Stuck"\n'))
    agent.hear("stuck from now on")
    rig.entry(agent.pid)
    return agent


def test_a_stuck_task_does_not_keep_it_from_ending_in_time(stuck: Running):
    code, took_s = stuck.signalled(signal.SIGTERM)

    assert took_s < STOPPED_WITHIN_S + 0.2
    assert code in (0, 1)


def test_the_same_signal_again_ends_it_at_once(rig: Rig, stuck: Running):
    stuck.process.send_signal(signal.SIGTERM)
    rig.wait_until_gone(stuck.pid)  # the first thing that it does when it is to stop
    threading.Event().wait(2 * TWICE_S)  # sooner, it would be the same wish
    code, took_s = stuck.signalled(signal.SIGTERM)

    assert code == 1
    assert took_s < 1.0


def test_who_says_the_same_twice_in_one_breath_says_it_once(rig: Rig):
    """As `timeout` does: to the process, and to its group."""
    agent = rig.ready("a")
    agent.process.send_signal(signal.SIGTERM)
    code, _ = agent.signalled(signal.SIGTERM)

    assert code == 0


def test_a_port_in_use(rig: Rig):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        agent = rig.agent(rig.config("a"), "--set", f"agent.listen={address}")

        assert agent.ended() == 1
    assert agent.everything() == f"cannot listen at {address}: address already in use"


def test_the_second_of_two_agents_of_one_name(rig: Rig):
    first = rig.ready("twin")
    state = f"agent.state_dir={rig.directory}/second"
    second = rig.agent(rig.config("twin", file="second.toml"), "--set", state)
    second.hear("cannot listen at local://test/twin: address already in use: another agent of this name runs here")
    assert second.process.wait(10.0) == 1
    assert first.process.poll() is None and rig.pancakes("agent", "list").returncode == 0


def test_of_two_agents_of_one_name_on_two_machines_the_newcomer_says_so_and_both_run_on(rig: Rig):
    first = rig.ready("twin")
    second = rig.agent(
        rig.config("twin", file="second.toml"),
        *("--set", f"agent.state_dir={rig.directory}/second"),
        *("--set", f'agent.peers=["{rig.address(first)}"]'),
        *("--set", 'agent.listen=["local://elsewhere"]'),
    )
    second.hear("the name twin is already borne by another agent")
    assert first.process.poll() is second.process.poll() is None, "a rival ends no agent"
    assert rig.pancakes("agent", "list").returncode == 0


EXITS = """
import sys
from pancakes.service import Service

class Exits(Service):
    @classmethod
    def refuse_stop(cls, kernel, name, arguments, for_s):
        sys.exit(3)
"""


def test_an_agent_whose_root_fails_ends_with_a_sentence_and_the_asker_gets_an_answer(rig: Rig):
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


def test_why_an_agent_cannot_run_is_said_also_where_something_keeps_it_from_ending() -> None:
    stuck = (
        "import time; from pancakes.tools.cli.agent_process import Orders; orders = Orders(); orders.begin();"
        " orders.give_up('its port is in use'); orders.wait(60, print); time.sleep(60)"
    )
    ended = subprocess.run([sys.executable, "-c", stuck], capture_output=True, text=True, timeout=30, check=False)
    assert ended.returncode == 1
    assert ended.stderr.splitlines() == [
        "the agent cannot run: its port is in use",
        "the agent did not stop within 1.9 s and was ended",
    ]


def test_a_state_directory_in_use(rig: Rig):
    first = rig.ready("a")

    second = rig.agent(rig.config("a"))

    assert second.ended() == 1
    said = second.everything()
    assert f"is in use by another agent (process {first.pid})" in said
    assert "Traceback" not in said


@pytest.mark.parametrize(
    "sent",
    [b"GET / HTTP/1.1\r\nHost: robot\r\n\r\n", struct.pack(">I", 10 * 1024 * 1024) + b"x" * 1000],
    ids=["garbage", "an over-long frame"],
)
@pytest.mark.parametrize(
    ("network", "reason"),
    [
        (INSECURE, "no link over a connection from tcp://127.0.0.1: the other side broke the protocol"),
        ("", "no link over a connection from tcp://127.0.0.1: "),
    ],
    ids=["insecure", "with keys"],
)
def test_what_is_no_protocol_costs_that_link_alone(rig: Rig, sent: bytes, network: str, reason: str):
    agent = rig.ready("a", network)

    with socket.create_connection(("127.0.0.1", rig.port(agent)), timeout=10.0) as stranger:
        stranger.sendall(sent)
        while stranger.recv(4096):  # its hello and its refusal, then it closes
            pass

    agent.hear(reason)
    assert rig.pancakes("task", "list", "a").returncode == 0


def test_a_peer_that_never_answers_is_named(rig: Rig):
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        agent = rig.ready("a", "", agent=f'peers = ["{address}"]')

        assert "no handshake within 5 s" in agent.hear(f"no link over {address}")
        assert rig.pancakes("agent", "list").returncode == 0


def test_a_plugin_that_cannot_be_imported_is_named_and_the_rest_runs(rig: Rig):
    rig.install("broken", "[pancakes.tasks]\nbroken.Task = plugin_broken:Task\n", "import there_is_no_such_module\n")

    agent = rig.agent(
        rig.config("a", '[task.Broken]\ntype = "broken.Task"\n[device.load]\ndriver = "host.load"\nrate_hz = 1\n')
    )

    agent.hear("task_started task=load")
    agent.hear(READY)
    line = agent.hear("the task Broken does not run")
    assert "of broken 1.0 (plugin_broken:Task) cannot be loaded: ModuleNotFoundError" in line


def test_check_names_a_plugin_that_cannot_be_imported(rig: Rig):
    rig.install("broken", "[pancakes.drivers]\nbroken.arm = plugin_broken:Arm\n", "raise RuntimeError('no arm')\n")

    checked = rig.agent(rig.config("a"), "--check")

    assert checked.ended() == 0  # the configuration does not name it
    assert "warning: the driver 'broken.arm' of broken 1.0 (plugin_broken:Arm) cannot be loaded" in checked.everything()


RAISES = """
from pancakes.task import Task, every

class Boom(Task):
    @every(hz=100)
    def tick(self, tick):
        raise ValueError("the wheel came off")
"""


def test_a_task_that_raises_is_restarted_then_given_up(rig: Rig):
    rig.install("boom", "[pancakes.tasks]\nboom.Boom = plugin_boom:Boom\n", RAISES)

    agent = rig.agent(
        rig.config(
            "a", '[task.Boom]\ntype = "boom.Boom"\nrestart = { policy = "permanent", at_most = 2, within_s = 60 }\n'
        )
    )

    for _ in range(2):
        assert "s: ValueError: the wheel came off" in agent.hear("a/client/Boom is started again in 0.")
    agent.hear("a/client/Boom is given up: ValueError: the wheel came off")
    assert "Traceback" not in "\n".join(agent.said)
    listed = rig.pancakes("task", "list", "a")
    assert "failed" in next(line for line in listed.stdout.splitlines() if "Boom" in line)


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


def test_what_libraries_log_goes_to_the_log_without_a_traceback(rig: Rig):
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


def test_it_ends_with_the_process_that_launched_it(rig: Rig):
    parent = rig.run("-c", PARENT, str(rig.config("a")))
    parent.hear(READY)

    parent.process.kill()

    assert "service_stopped service=device" in parent.everything()  # which the agent had open as well, and closed


def test_it_does_not_begin_where_the_process_that_launched_it_has_ended(rig: Rig):
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
    *("pancakes.tools.recording.recording", "pancakes.runtime.services.traces"),
    # parts of Python, each of which takes milliseconds, and up to 4 MiB
    *("asyncio", "concurrent.futures", "configparser", "ctypes", "difflib", "encodings.idna"),
    *("http", "multiprocessing", "ssl", "subprocess", "unittest", "xml"),
)
IMPORTED = """
import sys
from pancakes.task import Task

class Imported(Task):
    def on_start(self):
        self.log("info", "heavy: " + ",".join(name for name in %r if name in sys.modules))
"""


def test_an_idle_agent_imports_nothing_heavy(rig: Rig):
    rig.install("imported", "[pancakes.tasks]\nimported.Imported = plugin_imported:Imported\n", IMPORTED % (HEAVY,))

    agent = rig.agent(rig.config("a", f'{INSECURE}[task.Imported]\ntype = "imported.Imported"\n'))

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


def test_the_example_for_everybody_runs(rig: Rig, request: pytest.FixtureRequest):
    agent = rig.agent(request.config.rootpath / "configs" / "single.toml")
    agent.hear(READY)
    rig.entry(agent.pid)

    listed = rig.pancakes("task", "list", "single")

    assert "host.memory" in listed.stdout
    assert agent.signalled(signal.SIGTERM)[0] == 0
