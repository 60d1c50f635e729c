"""Network namespaces of a run are removed at any end of it; where a machine cannot make them, that is said.

What needs them is skipped where the machine cannot, with its reason.
"""

from __future__ import annotations

import json
import os
import random
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from benchmarks.agent_process import PYTHON_PATH
from click.testing import CliRunner
from torture import __main__ as command
from torture.namespaces import NAMED, PREFIX, Namespaces, NoNamespaces, check, remove_leftovers
from torture.wire import Link, Wire

RUN = """
import subprocess, sys, threading
from harness.ending import interruptible
from torture.namespaces import Namespaces
with interruptible(), Namespaces() as spaces:
    place = spaces.add()
    inside = subprocess.Popen([*place.command, "sleep", "600"], stdout=subprocess.DEVNULL)
    print(place.name, inside.pid, flush=True)
    threading.Event().wait()
"""


@pytest.fixture
def able() -> None:
    try:
        check()
    except NoNamespaces as error:
        pytest.skip(str(error))


def begin() -> tuple[subprocess.Popen[str], str, int]:
    """Starts a run that has made namespaces; returns it, the name of one, and a handle of a process in it."""
    run = subprocess.Popen(
        [sys.executable, "-c", RUN],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(PYTHON_PATH)},
        stdout=subprocess.PIPE,
        text=True,
        # Under `nohup` it would be ignored, and a run leaves that as it is.
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
    )
    assert run.stdout is not None
    name, pid = run.stdout.readline().split()
    return run, name, os.pidfd_open(int(pid))


def is_gone(process: int) -> bool:
    """Waits for the end of a process, and forgets it; returns whether it has ended."""
    ended = bool(select.select([process], [], [], 10.0)[0])
    os.close(process)
    return ended


@pytest.mark.usefixtures("able")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_is_interrupted_removes_its_namespaces(number: signal.Signals) -> None:
    run, name, inside = begin()
    assert (NAMED / name).exists()
    run.send_signal(number)
    run.communicate(timeout=20)
    stem = name.rpartition("-")[0]
    assert not list(NAMED.glob(f"{stem}-*")) and is_gone(inside)


@pytest.mark.usefixtures("able")
def test_what_a_killed_run_leaves_behind_is_removed_at_the_next_start() -> None:
    run, name, inside = begin()
    run.kill()
    run.communicate(timeout=20)
    with Namespaces():
        assert not (NAMED / name).exists() and is_gone(inside)


@pytest.mark.usefixtures("able")
def test_the_namespaces_of_a_run_that_lives_are_left_alone() -> None:
    run, name, inside = begin()
    assert name not in remove_leftovers() and (NAMED / name).exists()
    run.send_signal(signal.SIGTERM)
    run.communicate(timeout=20)
    assert is_gone(inside)


@pytest.mark.usefixtures("able")
def test_what_goes_from_one_namespace_to_another_is_cut_and_heals() -> None:
    with Namespaces() as spaces:
        inside = spaces.add()
        link = spaces.link(spaces.places[0], inside)
        echo = "import socket; s = socket.socket(type=socket.SOCK_DGRAM); s.bind(('', 9)); print(1, flush=True)\n"
        echo += "while True: s.sendto(*s.recvfrom(99))"
        with (
            subprocess.Popen([*inside.command, sys.executable, "-c", echo], stdout=subprocess.PIPE) as running,
            socket.socket(type=socket.SOCK_DGRAM) as ours,
        ):
            assert running.stdout is not None and running.stdout.readline()
            ours.settimeout(5.0)
            ours.connect((inside.host, 9))
            ours.send(b"before")
            assert ours.recv(99) == b"before"
            link.cut_at("word")
            ours.send(b"\xa4word")
            assert link.cut.wait(5.0)
            ours.send(b"lost")
            wait_until(lambda: link.lost == 2)
            link.heal()
            ours.send(b"after")
            assert ours.recv(99) == b"after"
            running.kill()


def wait_until(condition: Callable[[], bool]) -> None:
    """Waits for what nobody announces."""
    until_s = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < until_s


def test_a_wire_delays_and_loses_what_the_link_says() -> None:
    """Over socket pairs instead of devices: needs no root."""
    sender, here = socket.socketpair(type=socket.SOCK_DGRAM)
    there, receiver = socket.socketpair(type=socket.SOCK_DGRAM)
    for one in (here, there):
        one.setblocking(False)
    wire = Wire(seed=1)
    wire.attach("10.78.0.1", here.detach())
    wire.attach("10.78.0.2", there.detach())
    head = b"\x45" + bytes(11) + socket.inet_aton("10.78.0.1") + socket.inet_aton("10.78.0.2")
    link = wire.link("10.78.0.2", "10.78.0.1")
    link.delay_s, link.loss = 0.02, 1.0
    receiver.settimeout(10.0)
    sender.send(head + b"lost")
    wait_until(lambda: link.lost == 1)
    link.loss = 0.0
    began_s = time.monotonic()
    sender.send(head + b"late")
    assert receiver.recv(99).endswith(b"late") and time.monotonic() - began_s >= 0.02
    wire.close()
    for one in (sender, receiver):
        one.close()


def test_a_word_is_not_found_in_a_longer_one() -> None:
    link = Link()
    link.cut_at("migration.reserve")
    draw = random.Random(1)
    assert link.passes(b"...\xb2migration.reserved...", draw)
    assert not link.passes(b"...\xb1migration.reserve...", draw)
    assert link.cut.is_set() and not link.passes(b"anything", draw)
    link.heal()
    assert link.passes(b"...\xb1migration.reserve...", draw)


def cannot() -> None:
    raise NoNamespaces("network namespaces can be made by root alone: run it with sudo")


@pytest.mark.parametrize("verb", ["cuts", "gap"])
def test_whoever_asks_for_namespaces_where_there_are_none_is_told_why(
    monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    monkeypatch.setattr("torture.live_commands.check", cannot)
    result = CliRunner().invoke(command.torture, [verb, "--netns"])
    assert result.exit_code == 1
    assert result.output == "Error: network namespaces can be made by root alone: run it with sudo.\n"


def test_without_namespaces_the_rest_is_run_and_what_was_not_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("torture.live_commands.check", cannot)
    monkeypatch.setattr("torture.live_commands.STEPS", ())
    path = tmp_path / "figures.json"
    result = CliRunner().invoke(command.torture, ["cuts", "--json", str(path)])
    assert result.exit_code == 0
    assert json.loads(path.read_text())["not_run"][0].startswith("the same between network namespaces: ")
    assert "Not run: the same between network namespaces: network namespaces can be made by root alone" in result.output


@pytest.mark.usefixtures("able")
def test_nothing_of_this_process_is_left() -> None:
    with Namespaces() as spaces:
        assert spaces.add().name.startswith(f"{PREFIX}-{os.getpid()}-")
    assert not list(NAMED.glob(f"{PREFIX}-{os.getpid()}-*"))
