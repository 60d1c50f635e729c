"""`pancakes drive`: a person drives a robot from a terminal, and the terminal is as before, whatever ends that."""

from __future__ import annotations

import json
import os
import pty
import select
import signal
import struct
import termios
import time
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any, cast

import pytest
from cli.processes import PATIENCE_S, Rig
from harness.programs import Program, pancakes

from pancakes.control import Drive, Reply
from pancakes.errors import NoAnswerError
from pancakes.tools.cli.hand_input import AGAIN_S, EVENT, FIRST_S, STILL, Gamepad, Keyboard, Share
from pancakes.tools.cli.verbs import drive

MOTORS = '[device.motors]\ndriver = "null.motors"\n[device.place]\ndriver = "null.pose"\nrate_hz = 1\n'
GO = """
from pancakes.devices import Twist
from pancakes.task import Task, every

class Go(Task):
    requires = ("motors",)

    @every(hz=10)
    def go(self, tick):
        self.publish("ctrl", Twist(0.1, 0.0))
"""
WITH_GO = f'{MOTORS}[task.Go]\ntype = "go.Go"\n'


class Terminal:
    """A command in a terminal, of which the test keeps both ends, to see how the terminal is afterwards."""

    def __init__(self, rig: Rig, *arguments: str) -> None:
        self._ours, self._theirs = pty.openpty()
        self.began = termios.tcgetattr(self._theirs)
        self.process = Program(
            pancakes(*arguments),
            stdin=self._theirs,
            stdout=self._theirs,
            stderr=self._theirs,
            env=rig.environment,
            cwd=rig.directory,
            start_new_session=True,
        )
        self.shown = ""

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *error: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait(PATIENCE_S)
        if self._ours >= 0:
            os.close(self._ours)
        os.close(self._theirs)

    def close(self) -> None:
        """Close our end, as a window that is closed does."""
        os.close(self._ours)
        self._ours = -1

    def press(self, keys: str) -> None:
        os.write(self._ours, keys.encode())

    def hear(self, text: str, pressing: str = "") -> None:
        """Wait until a text is shown, with a key held down."""
        until_s = time.monotonic() + PATIENCE_S
        while text not in self.shown:
            assert time.monotonic() < until_s and self.process.poll() is None, self.shown
            self.press(pressing)
            self._read(0.05)

    def hear_next(self, text: str) -> None:
        """Wait until a text is shown again."""
        self.shown = ""
        self.hear(text)

    def end(self) -> int:
        """Wait until it has ended; return its exit code."""
        until_s = time.monotonic() + PATIENCE_S
        while self.process.poll() is None:
            assert time.monotonic() < until_s, self.shown
            self._read(0.05)
        self._read(0.0)
        return self.process.wait()

    def _read(self, for_s: float) -> None:
        while select.select([self._ours], [], [], for_s)[0]:
            self.shown += os.read(self._ours, 65_536).decode()
            for_s = 0.0

    def keeps_to_itself(self) -> bool:
        """Whether keys go to the program at once and are not shown."""
        return not termios.tcgetattr(self._theirs)[3] & (termios.ICANON | termios.ECHO)

    def is_as_before(self) -> bool:
        return termios.tcgetattr(self._theirs) == self.began


@pytest.fixture
def robot(rig: Rig) -> Iterator[Rig]:
    rig.install("go", "[pancakes.tasks]\ngo.Go = plugin_go:Go\n", GO)
    rig.ready("a", WITH_GO)
    yield rig


def row_of(rig: Rig, task: str) -> dict[str, Any]:
    rows = json.loads(rig.pancakes("task", "list", "a", "--format", "json").stdout)
    found: dict[str, Any] = next(it for it in rows if it["task"] == task)
    return found


def state_of(rig: Rig, task: str = "Go") -> str:
    row = row_of(rig, task)
    return str(row["rest"] or row["state"])


def becomes(rig: Rig, state: str) -> bool:
    until_s = time.monotonic() + PATIENCE_S
    while (found := state_of(rig)) != state and time.monotonic() < until_s:
        pass
    return found == state


def test_person_drives_and_gives_the_robot_back(robot: Rig):
    assert state_of(robot) == "running"
    with Terminal(robot, "drive", "a", "--speed", "0.3", "--turn", "0.5") as terminal:
        terminal.hear("You drive motors of a. a/client/Go waits.")
        terminal.hear("+0.00 m/s  +0.00 rad/s")
        assert terminal.keeps_to_itself()
        assert state_of(robot) == "paused"
        terminal.hear("+0.30 m/s  +0.00 rad/s", pressing="w")
        terminal.hear("-0.30 m/s  +0.00 rad/s", pressing="\x1b[B")
        terminal.hear("+0.30 m/s  +0.50 rad/s", pressing="q")
        terminal.press("+")
        terminal.hear("+0.00 m/s  -0.62 rad/s", pressing="d")
        terminal.press("x")
        assert terminal.end() == 0
        assert "motors of a stopped. a/client/Go continues." in terminal.shown
        assert terminal.is_as_before()
    assert state_of(robot) == "running"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_ends_the_drive_and_leaves_the_terminal_as_before(robot: Rig, number: int):
    with Terminal(robot, "drive", "a") as terminal:
        terminal.hear("+0.00 m/s")
        terminal.process.send_signal(number)
        assert terminal.end() == 0
        assert " stopped." in terminal.shown and terminal.is_as_before()
    assert state_of(robot) == "running"


@pytest.mark.parametrize("key", ["\x1c", "\x1a", "\x13"], ids=["Ctrl-backslash", "Ctrl-Z", "Ctrl-S"])
def test_control_key_is_a_key_that_stops(robot: Rig, key: str):
    with Terminal(robot, "drive", "a") as terminal:
        terminal.hear("+0.20 m/s", pressing="w")
        terminal.press(key)
        terminal.hear_next("+0.00 m/s  +0.00 rad/s")
        terminal.press("x")
        assert terminal.end() == 0 and terminal.is_as_before()


def test_terminal_that_is_closed_ends_the_drive(robot: Rig):
    with Terminal(robot, "drive", "a") as terminal:
        terminal.hear("+0.00 m/s")
        terminal.close()
        terminal.process.wait(PATIENCE_S)
    rows = json.loads(robot.pancakes("log", "a", "--format", "json").stdout)
    assert [it["reason"] for it in rows if it["kind"] == "drive_ended"] == ["ended"], "and not because it was silent"


def test_terminal_that_is_killed_does_not_keep_the_robot(robot: Rig):
    with Terminal(robot, "drive", "a") as terminal:
        terminal.hear("+0.20 m/s", pressing="w")
        terminal.process.kill()
    assert becomes(robot, "running")


def test_second_terminal_is_refused_and_may_take_over(robot: Rig):
    with Terminal(robot, "drive", "a") as first:
        first.hear("+0.00 m/s")
        with Terminal(robot, "drive", "a") as second:
            assert second.end() == 1
            assert "drives motors by hand already" in second.shown and "--take" in second.shown
            assert second.is_as_before()
        with Terminal(robot, "drive", "a", "--take") as second:
            second.hear("You drive motors of a.")
            assert first.end() == 1
            assert "has taken over motors" in first.shown and first.is_as_before()
            assert state_of(robot) == "paused"
            second.press("x")
            assert second.end() == 0
    assert state_of(robot) == "running"


def test_agent_that_ends_ends_the_drive(robot: Rig):
    with Terminal(robot, "drive", "a") as terminal:
        terminal.hear("+0.00 m/s")
        assert robot.pancakes("down", "a").returncode == 0
        # While it ends it may refuse a command; after that it does not answer.
        assert terminal.end() in (1, 3)
        assert terminal.is_as_before() and "Traceback" not in terminal.shown


def test_gamepad_drives_until_it_is_gone(robot: Rig, tmp_path: Path):
    pad = tmp_path / "js0"
    os.mkfifo(pad)
    feed = os.open(pad, os.O_RDWR)
    with Terminal(robot, "drive", "a", "--gamepad", str(pad), "--speed", "0.4") as terminal:
        terminal.hear("+0.00 m/s")
        os.write(feed, EVENT.pack(1, -32767, 2, 1))
        terminal.hear("+0.40 m/s  +0.00 rad/s")
        terminal.press(" ")
        terminal.hear_next("+0.00 m/s  +0.00 rad/s")
        os.write(feed, EVENT.pack(2, 0, 2, 1) + EVENT.pack(3, -32767, 2, 0))
        terminal.hear("+0.00 m/s  +1.00 rad/s")
        os.close(feed)
        assert terminal.end() == 1
        assert f"the gamepad {pad} is gone" in terminal.shown and terminal.is_as_before()
    assert state_of(robot) == "running"


def test_what_cannot_be_driven_is_a_sentence(robot: Rig):
    for arguments, code, text in (
        (["a"], 2, "standard input is no terminal"),
        (["a", "--dry-run"], 0, "motors of a can be driven"),
        (["a", "--dry-run", "--device", "place"], 1, "cannot be driven by hand, but motors can (--device)"),
        (["a", "--dry-run", "--device", "wings"], 1, "a has no task or service 'wings'"),
        (["b", "--dry-run"], 3, "b"),
        (["a", "--gamepad", "/dev/nothing"], 1, "the gamepad /dev/nothing cannot be read: No such file or directory"),
        (["a", "--speed", "0"], 2, "--speed"),
    ):
        result = robot.pancakes("drive", *arguments)
        assert (result.returncode, text in result.stdout + result.stderr) == (code, True), (arguments, result)
    assert state_of(robot) == "running"


# What hands say -------------------------------------------------------------------------------------------------


def test_key_counts_for_a_moment_and_longer_while_it_is_held():
    keyboard = Keyboard()
    keyboard.take(b"w", 0.0)
    assert keyboard.share(FIRST_S - 0.01) == Share(1.0, 0.0)
    assert keyboard.share(FIRST_S + 0.01) == STILL
    for at_s in (1.0, 1.5, 1.53, 1.56):
        keyboard.take(b"w", at_s)
    assert keyboard.share(1.56 + AGAIN_S - 0.01) == Share(1.0, 0.0)
    assert keyboard.share(1.56 + AGAIN_S + 0.01) == STILL


@pytest.mark.parametrize("stops", [b" ", b"p", b"\xff ", b"\n"])
def test_any_other_key_stops_at_once(stops: bytes):
    keyboard = Keyboard()
    keyboard.take(b"q", 0.0)
    assert keyboard.share(0.1) == Share(1.0, 1.0)
    keyboard.take(stops, 0.1)
    assert keyboard.share(0.1) == STILL and not keyboard.quits


def test_arrow_key_that_comes_in_pieces_is_one_key():
    keyboard = Keyboard()
    for piece in (b"\x1b", b"[", b"D"):
        keyboard.take(piece, 0.0)
    assert keyboard.share(0.0) == Share(0.0, 1.0)
    keyboard.take(b"\x1bOA\x1b[5", 0.0)
    assert keyboard.share(0.0) == Share(1.0, 0.0)


@pytest.mark.parametrize(
    "key", [b"\x1b[1;5A", b"\x1b[1;2D", b"\x1bOP", b"\x1b[15~", b"\x1b", b"\x1b ", b"\x1b\x1b", b"\x1b[Z"], ids=repr
)
def test_key_that_is_no_character_and_no_arrow_stops_as_well(key: bytes):
    keyboard = Keyboard()
    keyboard.take(b"q", 0.0)
    keyboard.take(key, 0.1)
    arrow = {b"\x1b[1;5A": Share(1.0, 0.0), b"\x1b[1;2D": Share(0.0, 1.0)}
    assert keyboard.share(0.1) == arrow.get(key, STILL), "an arrow with Ctrl or Shift is that arrow"
    assert not keyboard.quits
    keyboard.take(b" wx", 0.2)
    assert keyboard.share(0.2) == Share(1.0, 0.0) and keyboard.quits, "what comes next is read as always"


@pytest.mark.parametrize("quits", [b"x", b"X", b"\x03", b"\x04"])
def test_keys_that_end_it(quits: bytes):
    keyboard = Keyboard()
    keyboard.take(b"w" + quits, 0.0)
    assert keyboard.quits


def test_factor_stays_within_its_bounds():
    keyboard = Keyboard()
    keyboard.take(b"+" * 50, 0.0)
    assert keyboard.factor == 4.0
    keyboard.take(b"-" * 100, 0.0)
    assert keyboard.factor == 0.1


def test_stick_near_its_centre_is_at_its_centre():
    pad = Gamepad()
    pad.take(EVENT.pack(0, 3000, 0x82, 0) + EVENT.pack(0, -3000, 0x82, 1))
    assert pad.share() == STILL
    events = EVENT.pack(0, -32768, 2, 0) + EVENT.pack(0, 32767, 2, 1) + EVENT.pack(0, 1, 1, 1) + EVENT.pack(0, 9, 2, 7)
    for at in range(0, len(events), 5):
        pad.take(events[at : at + 5])
    assert pad.share() == Share(-1.0, 1.0)


def test_stick_says_nothing_after_a_stop_until_it_was_at_its_centre():
    pad = Gamepad()
    pad.take(EVENT.pack(0, -32767, 2, 1))
    assert pad.share() == Share(1.0, 0.0)
    pad.stop()
    assert pad.share() == STILL
    pad.take(EVENT.pack(0, -20000, 2, 1))
    assert pad.share() == STILL
    pad.take(EVENT.pack(0, 0, 2, 1))
    assert pad.share() == STILL
    pad.take(EVENT.pack(0, -32767, 2, 1))
    assert pad.share() == Share(1.0, 0.0)


def test_events_are_those_of_the_kernel():
    assert EVENT.size == struct.calcsize("=IhBB") == 8


def test_terminal_only_asks_to_stand_while_an_answer_is_missing():
    """The link may deliver all that it sent meanwhile at once, and the robot obeys the second of them."""
    sent: list[float] = []
    ticks = count()

    class Away:
        now = staticmethod(lambda: next(ticks) * 0.1)

        def request(self, agent: str, velocity: Drive, timeout_s: float) -> Reply:
            sent.append(velocity.v_mps)
            if len(sent) in (2, 3, 4):
                raise NoAnswerError(f"{agent} does not answer")
            return Reply(result={"filters": []})

    class Holding:
        quits = False
        read = staticmethod(lambda for_s, now: (Share(1.0, 0.0), 1.0))
        wait = staticmethod(lambda for_s: None)

    first = Drive("motors", "one", begin=True)
    most, over = (0.2, 1.0), lambda: len(sent) == 6
    drive.send_commands(cast("Any", Away()), "a", first, {"stop_after_s": 0.5}, cast("Any", Holding()), most, over)
    assert sent == [0.2, 0.2, 0.0, 0.0, 0.0, 0.2]


def test_recording_tells_who_drove(rig: Rig, tmp_path: Path):
    path = tmp_path / "drive.mcap"
    rig.ready("a", MOTORS, "--record", str(path))
    with Terminal(rig, "drive", "a") as terminal:
        terminal.hear("+0.20 m/s", pressing="w")
        terminal.press("x")
        terminal.end()
    assert rig.pancakes("down", "a").returncode == 0
    (row,) = json.loads(rig.pancakes("why", str(path), "--time", "1000000", "--format", "json").stdout)
    first, last = row["chain"]
    assert (first["type"], last["source"]) == ("drive", "a/device/drive-motors")
    assert first["source"].startswith("alice.")
