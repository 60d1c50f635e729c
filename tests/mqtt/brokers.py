"""A real broker, mosquitto, and its clients, for tests."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from harness.debian_packages import need

PATIENCE_S = 10.0


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
        wait = subprocess.run(["sh", "-c", f"i=0; until {self._probe()} || [ $i -gt 200 ]; do i=$((i+1)); sleep 0.05; done"])
        assert wait.returncode == 0 and self._process.poll() is None, self.log()

    def _probe(self) -> str:
        return f"python3 -c 'import socket; socket.create_connection((\"127.0.0.1\", {self.port}), 1).close()' 2>/dev/null"

    def kill(self) -> None:
        """Kills it with SIGKILL."""
        self.end(signal.SIGKILL)

    def end(self, number: int = signal.SIGTERM) -> None:
        if self._process is not None:
            self._process.send_signal(number)
            self._process.wait(PATIENCE_S)
            self._process = None

    def signal(self, number: int) -> None:
        assert self._process is not None
        self._process.send_signal(number)

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
    def listening(self, topic: str, *more: str) -> Iterator[subprocess.Popen[str]]:
        """Runs mosquitto's own client; each message is a line of its output: topic, a space, payload."""
        command = [self._sub, "-p", str(self.port), "-t", topic, "-F", "%t %p", "-d", *more]
        command = [shutil.which("stdbuf") or "stdbuf", "-oL", *command]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        try:
            for line in process.stdout:
                if "SUBACK" in line:
                    break
            yield process
        finally:
            process.kill()
            process.stdout.close()
            process.wait()


def messages(process: subprocess.Popen[str]) -> Iterator[tuple[str, str]]:
    """Yields the topic and payload of each message that comes."""
    assert process.stdout is not None
    for line in process.stdout:
        if not line.startswith("Client "):
            topic, _, payload = line.rstrip("\n").partition(" ")
            if topic and topic != "Subscribed":
                yield topic, payload
