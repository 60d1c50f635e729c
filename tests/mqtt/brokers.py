"""A real broker, mosquitto, and its clients, for tests."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import chain, count
from pathlib import Path

from harness.debian_packages import need

PATIENCE_S = 10.0
_NUMBERS = count(1)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Mosquitto:
    """A mosquitto on a port of its own, with its memory on disk.

    Args:
        folder: where its files lie.
        lines: of its configuration, besides the port.

    Attributes:
        port: its port.
    """

    def __init__(self, folder: Path, *lines: str) -> None:
        self._program = need("mosquitto", "mosquitto")
        self._pub, self._sub = need("mosquitto_pub", "mosquitto-clients"), need("mosquitto_sub", "mosquitto-clients")
        self.port = free_port()
        self._folder = folder
        folder.mkdir(exist_ok=True)
        self._lines = lines
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def address(self) -> str:
        return f"mqtt://127.0.0.1:{self.port}"

    def start(self) -> None:
        """Starts it, and waits until it listens."""
        config = [
            f"listener {self.port} 127.0.0.1",
            "user root",
            "persistence true",
            f"persistence_location {self._folder}/",
            "autosave_on_changes true",
            "autosave_interval 1",
            "max_queued_messages 0",
            *(self._lines or ("allow_anonymous true",)),
        ]
        path = self._folder / "mosquitto.conf"
        path.write_text("\n".join(config) + "\n")
        with open(self._folder / "log.txt", "ab") as log:
            self._process = subprocess.Popen([self._program, "-v", "-c", str(path)], stdout=log, stderr=log)
        until_s = time.monotonic() + PATIENCE_S
        while not self._listens():
            assert time.monotonic() < until_s and self._process.poll() is None, self.log()
            time.sleep(0.02)

    def _listens(self) -> bool:
        try:
            socket.create_connection(("127.0.0.1", self.port), 1.0).close()
        except OSError:
            return False
        return True

    def settle(self) -> None:
        """Waits until all that it has heard is on its disk."""
        token = f"settled-{next(_NUMBERS)}"
        self.pub("settled", token, "-q", "1", "-r")
        until_s = time.monotonic() + PATIENCE_S
        while token.encode() not in self._on_disk():
            assert time.monotonic() < until_s, self.log()
            time.sleep(0.02)

    def _on_disk(self) -> bytes:
        path = self._folder / "mosquitto.db"
        return path.read_bytes() if path.exists() else b""

    def kill(self, settled: bool = True) -> None:
        """Kills it with SIGKILL; `settled`: once all that it has heard is on its disk."""
        if settled:
            self.settle()
        self.end(signal.SIGKILL)

    def end(self, number: int = signal.SIGTERM) -> None:
        if self._process is not None:
            self._process.send_signal(number)
            self._process.send_signal(signal.SIGCONT)  # a failed test may have left it stopped
            self._process.wait(PATIENCE_S)
            self._process = None

    def signal(self, number: int) -> None:
        """Sends it a signal; returns once a SIGSTOP has stopped it."""
        assert self._process is not None
        self._process.send_signal(number)
        if number == signal.SIGSTOP:
            os.waitpid(self._process.pid, os.WUNTRACED)

    def log(self) -> str:
        return (self._folder / "log.txt").read_text()

    def pub(self, topic: str, payload: str, *more: str) -> None:
        """Publishes by mosquitto's own client, which waits until the broker has it where that is promised."""
        command = [self._pub, "-p", str(self.port), "-t", topic, "-m", payload, *more]
        subprocess.run(command, check=True, timeout=PATIENCE_S)

    def pub_lines(self, topic: str, lines: list[str], *more: str) -> None:
        """Publishes each line as a message."""
        command = [self._pub, "-p", str(self.port), "-t", topic, "-l", *more]
        subprocess.run(command, input="\n".join(lines).encode() + b"\n", check=True, timeout=60)

    def read(self, topic: str, *more: str) -> str:
        """Returns the next message on a topic, which may be one that the broker keeps."""
        command = [self._sub, "-p", str(self.port), "-t", topic, "-C", "1", "-W", "10", *more]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.rstrip("\n")

    @contextmanager
    def listening(self, topic: str, *more: str) -> Iterator[Iterator[tuple[str, str]]]:
        """Runs mosquitto's own client once it has subscribed; yields the topic and payload of each message."""
        command = ["stdbuf", "-oL", self._sub, "-p", str(self.port), "-t", topic, "-F", "%t %p", "-d", *more]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        early: list[str] = []  # what came before the broker had confirmed the subscription
        try:
            for line in process.stdout:
                if "SUBACK" in line:
                    break
                early.append(line)
            yield messages(chain(early, process.stdout))
        finally:
            process.kill()
            process.stdout.close()
            process.wait()

    def remember(self, topic: str, client: str) -> None:
        """Has the broker keep from now on what comes on a topic (QoS 1) for a client that is not there."""
        with self.listening(topic, "-c", "-i", client, "-q", "1"):
            pass

    def remembered(self, topic: str, client: str) -> AbstractContextManager[Iterator[tuple[str, str]]]:
        """Lets the client that it keeps messages for have them; see `listening`."""
        return self.listening(topic, "-c", "-i", client, "-q", "1")


def messages(lines: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yields the topic and payload of each line that tells of a message."""
    for line in lines:
        topic, _, payload = line.rstrip("\n").partition(" ")
        if topic not in ("Client", "Subscribed", ""):
            yield topic, payload


def passwords(folder: Path, **users: str) -> Path:
    """Returns a file of users and passwords, as mosquitto reads it."""
    path = folder / "users"
    path.touch(mode=0o600)
    for user, password in users.items():
        subprocess.run([need("mosquitto_passwd", "mosquitto"), "-b", str(path), user, password], check=True)
    return path
