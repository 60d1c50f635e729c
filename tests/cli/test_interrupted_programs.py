"""SIGINT at any moment after our first line: a program ends quietly, and a shell sees that it was interrupted."""

import signal
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from cli.processes import PATIENCE_S, Rig

ENTRY = "pancakes.tools.cli.console_scripts"
PANCAKES = f"import sys; from {ENTRY} import pancakes; sys.exit(pancakes())"
AGENT = f"import sys; from {ENTRY} import agent; sys.exit(agent())"
IMPORTED = "import time:"
"""What `-X importtime` begins its lines with, one for each module that has been imported."""
BY_SIGNAL, INTERRUPTED = -signal.SIGINT, 130


def interrupted_after(rig: Rig, imports: int, program: str, *arguments: str) -> tuple[int, list[str]]:
    """Starts a program and interrupts it once it has imported so many modules after its first line of ours.

    Returns:
        Its exit code, and what it has printed on standard error.
    """
    process = subprocess.Popen(
        [sys.executable, "-X", "importtime", "-c", program, *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=rig.environment,
        cwd=rig.directory,
    )
    assert process.stderr is not None
    said: list[str] = []
    begun, seen = False, 0
    try:
        for line in process.stderr:
            if not line.startswith(IMPORTED):
                said.append(line.rstrip())
                continue
            seen += begun
            begun = begun or line.rstrip().endswith(ENTRY)
            if begun and seen == imports:
                process.send_signal(signal.SIGINT)
                seen += 1  # once
        return process.wait(PATIENCE_S), said
    finally:
        process.kill()
        process.wait()
        process.stderr.close()


def test_command_interrupted_at_start_ends_silently(rig: Rig):
    for imports in (0, 1, 40, 120, 250):
        code, said = interrupted_after(rig, imports, PANCAKES, "plugin", "list")
        assert said == []
        assert code == BY_SIGNAL or (code == 0 and imports > 100), "it has imported fewer"


def test_demo_interrupted_at_start_ends_silently(rig: Rig):
    mission = ("demo", "encirclement", "--virtual", "--headless", "--duration", "5", "--out", "out")
    configs = Path(__file__).parents[2] / "configs" / "encirclement"
    for imports in (40, 200, 400):
        code, said = interrupted_after(rig, imports, PANCAKES, *mission, "--configs", str(configs))
        assert [line for line in said if "no verdict" not in line] == []
        assert code in (BY_SIGNAL, INTERRUPTED), imports


def test_agent_interrupted_at_start_ends_silently(rig: Rig):
    config = str(rig.config("a"))
    for imports in (0, 40, 120):
        code, said = interrupted_after(rig, imports, AGENT, "--config", config)
        assert said == []
        assert code in (BY_SIGNAL, 0), "or it listens to signals already, and ends in good order"


def test_launch_interrupted_at_start_ends_quietly(rig: Rig):
    config = str(rig.config("a"))
    for imports in (0, 100, 200):
        code, said = interrupted_after(rig, imports, PANCAKES, "up", config)
        assert not any("Traceback" in line or "KeyboardInterrupt" in line for line in said)
        assert code in (BY_SIGNAL, 0), imports


def test_only_programs_change_the_interrupt_handler():
    """A SIGINT that a shell ignores, as with `&`, stays ignored."""
    ignored = f"import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\nimport {ENTRY}\n"
    ignored += "signal.raise_signal(signal.SIGINT)\nprint('goes on')"
    usual = "import signal, pancakes.tools.cli.main, pancakes.tools.cli.agent_command, pancakes.testing\n"
    usual += "print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
    for source, printed in ((ignored, "goes on\n"), (usual, "True\n")):
        found = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, timeout=PATIENCE_S)
        assert (found.returncode, found.stdout, found.stderr) == (0, printed, "")
    scripts = entry_points(group="console_scripts")
    assert {scripts[name].module for name in ("pancakes", "pancakes-agent")} == {ENTRY}


# A demo from its first line to its last -------------------------------------------------------------------------

SLOW = """
import atexit
import sys
from pathlib import Path
from pancakes.tools.demo.demo import Comparison, Demo, Variant

def wait(what):
    print(what, flush=True)
    sys.stdin.readline()

def judge(*run):
    wait("judging")
    atexit.register(wait, "ending")
    return {"verdict": "PASS", "reasons": []}

def draw(*run):
    wait("drawing")

ONE = Demo("one", "A slow one", ("a",), Path("configs"), 2.0, judge, draw, records={}, virtual=True)
ALL = Comparison("all", "Two of them", ONE, (Variant("x", "x"), Variant("y", "y")), judge, draw, "all.png")
"""


class Slow:
    """A demo that waits for a line of standard input wherever it says what it does."""

    def __init__(self, rig: Rig, name: str) -> None:
        rig.install("slow", "[pancakes.demos]\none = plugin_slow:ONE\nall = plugin_slow:ALL\n", SLOW)
        configs = rig.directory / "configs"
        configs.mkdir()
        # In virtual time nothing listens at that port.
        (configs / "a.toml").write_text(
            'schema = 1\n[agent]\nname = "a"\nlisten = "tcp://127.0.0.1:7499"\n[clock]\nhold = true\n'
        )
        self.process = subprocess.Popen(
            [sys.executable, "-c", PANCAKES, "demo", name, "--configs", str(configs), "--out", "out"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=rig.environment,
            cwd=rig.directory,
        )
        self.said: list[str] = []

    def wait_for(self, text: str, times: int = 1) -> None:
        """Waits until it says a line that begins with `text`, and lets it go on wherever it waits before."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.said.append(line.rstrip())
            if line.startswith(text):
                times -= 1
                if not times:
                    return
            if line.rstrip() in ("judging", "drawing", "ending"):
                self.go_on()
        raise AssertionError(f"it never said {text!r}, but:\n" + "\n".join(self.said))

    def go_on(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()

    def interrupt(self) -> None:
        self.process.send_signal(signal.SIGINT)

    def ended(self) -> int:
        """Lets it go on to its end; returns the exit code."""
        rest, _ = self.process.communicate("\n\n\n\n\n", PATIENCE_S)
        self.said += rest.splitlines()
        return self.process.returncode

    def __enter__(self) -> "Slow":
        return self

    def __exit__(self, *error: object) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.mark.parametrize(
    ("name", "moment", "times"),
    [
        ("one", "A slow one", 1),
        ("one", "judging", 1),
        ("one", "drawing", 1),
        ("all", "A slow one, y", 1),
        ("all", "judging", 3),  # of the comparison itself
        ("all", "drawing", 1),
    ],
)
def test_interrupted_demo_exits_with_130(rig: Rig, name: str, moment: str, times: int):
    with Slow(rig, name) as demo:
        demo.wait_for(moment, times)
        demo.interrupt()
        assert demo.ended() == INTERRUPTED
    assert not any(line.startswith("verdict") for line in demo.said)
    assert any("no verdict" in line for line in demo.said)


@pytest.mark.parametrize("moment", ["verdict: PASS", "ending"])
def test_demo_interrupted_after_its_verdict_fails(rig: Rig, moment: str):
    with Slow(rig, "one") as demo:
        demo.wait_for("verdict: PASS")
        if moment == "ending":
            demo.wait_for("ending")
        demo.interrupt()
        assert demo.ended() in (BY_SIGNAL, INTERRUPTED)
    assert not any("Traceback" in line for line in demo.said)


def test_demo_interrupted_twice_ends_at_once(rig: Rig):
    with Slow(rig, "one") as demo:
        demo.wait_for("drawing")
        demo.interrupt()
        demo.process.send_signal(signal.SIGTERM)  # two of one kind may come as one
        assert demo.process.wait(PATIENCE_S) == INTERRUPTED


def test_uninterrupted_demo_ends_with_its_verdict(rig: Rig):
    with Slow(rig, "all") as demo:
        assert demo.ended() == 0
    assert "verdict: PASS" in demo.said
