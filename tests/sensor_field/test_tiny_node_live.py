"""The program that stands for the hardware: on a pseudo-terminal and over UDP, and gone with whoever holds it."""

from __future__ import annotations

import os
import select
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from pancakes_sensor_field.frame import MOTION, PERIOD, SIREN, TEMPERATURE, Decoder, Frame, encode

PATIENCE_S = 10.0
FEELS = b"t 21.5\nm 1\n"
SAYS = [Frame(7, PERIOD, 0, 600), Frame(7, MOTION, 1, 1)]


class TinyNode:
    """The program with the number 7 and a long report period, and the other end of its line."""

    def __init__(self, *where: str) -> None:
        command = [sys.executable, "-m", "pancakes_sensor_field.tiny_node", "--node=7", "--period=60", *where]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self.process.stdout is not None
        self.says = self.process.stdout.readline().decode()
        self.decoder = Decoder()
        self.heard: list[Frame] = []

    def feels(self, data: bytes) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(data)
        self.process.stdin.flush()

    def hear(self, file: int, count: int) -> list[Frame]:
        """Waits for so many frames more."""
        while len(self.heard) < count:
            ready, _, _ = select.select([file], [], [], PATIENCE_S)
            assert ready, f"only {self.heard} came"
            self.heard += self.decoder.feed(os.read(file, 64))
        heard, self.heard = self.heard[:count], self.heard[count:]
        return heard

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.close()
        self.process.stdout.close()


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(type=socket.SOCK_DGRAM) as made:
        made.bind(("127.0.0.1", 0))
        made.settimeout(PATIENCE_S)
        yield made


@pytest.fixture
def over_udp(receiver: socket.socket) -> Iterator[TinyNode]:
    node = TinyNode(f"--udp=127.0.0.1:{receiver.getsockname()[1]}")
    yield node
    node.close()


def test_tiny_node_speaks_and_listens_over_udp(over_udp: TinyNode, receiver: socket.socket) -> None:
    over_udp.feels(FEELS)
    assert over_udp.hear(receiver.fileno(), 1) == SAYS[:1]
    data, sender = receiver.recvfrom(64)
    assert data == encode(SAYS[1])
    receiver.sendto(encode(Frame(7, PERIOD, 1, 1)), sender)
    heard = over_udp.hear(receiver.fileno(), 3)
    assert [(frame.kind, frame.value) for frame in heard] == [(PERIOD, 1), (TEMPERATURE, 2150), (MOTION, 1)]


def test_tiny_node_ends_with_its_standard_input(over_udp: TinyNode, receiver: socket.socket) -> None:
    over_udp.hear(receiver.fileno(), 1)
    assert over_udp.process.stdin is not None
    over_udp.process.stdin.close()
    assert over_udp.process.wait(PATIENCE_S) == 0


def test_tiny_node_speaks_on_a_pseudo_terminal(tmp_path: Path) -> None:
    link = tmp_path / "shed"
    node = TinyNode(f"--pty={link}")
    try:
        assert node.says == f"the tiny node 7 speaks at {link}\n"
        file = os.open(link, os.O_RDWR | os.O_NOCTTY)
        node.feels(b"t 20.0\n")
        node.feels(b"m 1\n")
        heard = node.hear(file, 1)
        while heard[-1].kind != MOTION:
            heard += node.hear(file, 1)
        os.write(file, encode(Frame(7, PERIOD, 1, 1)))
        assert node.hear(file, 2)[1].kind == TEMPERATURE
        os.close(file)
        node.process.terminate()
        assert node.process.wait(PATIENCE_S) == 0
        assert not link.is_symlink()
    finally:
        node.close()


def test_tiny_node_siren_falls_silent(over_udp: TinyNode, receiver: socket.socket) -> None:
    data, sender = receiver.recvfrom(64)
    assert data == encode(SAYS[0])
    receiver.sendto(encode(Frame(7, SIREN, 0, 3)), sender)
    heard = over_udp.hear(receiver.fileno(), 2)
    assert [(frame.kind, frame.value) for frame in heard] == [(SIREN, 3), (SIREN, 0)]
    assert over_udp.process.stdout is not None
    assert [over_udp.process.stdout.readline() for _ in range(2)] == [b"the siren sounds\n", b"the siren is silent\n"]


def test_tiny_node_names_a_missing_option() -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "pancakes_sensor_field.tiny_node", "--node=7"], capture_output=True, text=True
    )
    assert ended.returncode == 2 and "--pty" in ended.stderr


def test_tiny_node_does_not_need_pancakes() -> None:
    code = (
        "import sys, pancakes_sensor_field.tiny_node;"
        "sys.exit(any(name.split('.')[0] in ('pancakes', 'msgspec', 'serial') for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
