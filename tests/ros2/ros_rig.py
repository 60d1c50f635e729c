"""Processes of the two releases: an agent, and a node of the other that does what it is told."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ros2.environments import AGENTS, ROBOTS, environment, python_of

PEER = Path(__file__).with_name("ros_peer.py")
AT_MOST_S = 20.0


class Told:
    """What a process said in lines of JSON."""

    def __init__(self, stream: Any) -> None:
        self._lines: queue.Queue[dict[str, Any]] = queue.Queue()
        self.all: list[dict[str, Any]] = []
        threading.Thread(target=self._read, args=(stream,), daemon=True).start()

    def _read(self, stream: Any) -> None:
        for line in stream:
            try:
                self._lines.put(json.loads(line))
            except ValueError:
                pass  # a library of others said something
        stream.close()

    def wait(self, fits: Callable[[dict[str, Any]], Any], timeout_s: float = AT_MOST_S) -> dict[str, Any]:
        """Returns the next line that fits."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, deadline_s - time.monotonic()))
            except queue.Empty:
                raise AssertionError(
                    f"nothing that fits was said within {timeout_s} s; last: {self.all[-3:]}"
                ) from None
            self.all.append(line)
            if fits(line):
                return line

    def forget(self) -> None:
        """Forgets what was said and not waited for."""
        while not self._lines.empty():
            self.all.append(self._lines.get())


class RosPeer:
    """A node of the other release."""

    def __init__(self, domain: int, name: str = "peer") -> None:
        self._process = subprocess.Popen(
            [str(python_of(ROBOTS)), str(PEER), name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment(domain),
            text=True,
        )
        self.told = Told(self._process.stdout)
        self.told.wait(lambda line: "ready" in line)

    def order(self, do: str, **order: Any) -> None:
        """Gives an order."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": do, **order}) + "\n")
        self._process.stdin.flush()

    def listen(self, topic: str, kind: str, **order: Any) -> None:
        """Has it listen to a topic."""
        self.order("listen", topic=topic, type=kind, **order)
        self.told.wait(lambda line: line.get("listens") == topic)

    def heard(self, topic: str, fits: Callable[[Any], Any] = lambda message: True, timeout_s: float = AT_MOST_S) -> Any:
        """Returns the next message of a topic that fits."""
        return self.told.wait(lambda line: line.get("heard") == topic and fits(line["message"]), timeout_s=timeout_s)

    def ever_heard(self, topic: str, fits: Callable[[Any], Any]) -> Any:
        """Returns a message of a topic that fits: one that came before, or the next."""

        def is_it(line: dict[str, Any]) -> Any:
            return line.get("heard") == topic and fits(line["message"])

        return next(filter(is_it, self.told.all), None) or self.told.wait(is_it)

    def sees(self, node: str) -> None:
        """Waits until it sees a node: discovery takes a while, and may come after the first answer of a service."""
        deadline_s = time.monotonic() + AT_MOST_S
        nodes: list[str] = []
        while node not in nodes:
            assert time.monotonic() < deadline_s, f"no node {node} among {nodes}"
            self.order("graph")
            nodes = self.told.wait(lambda line: "nodes" in line)["nodes"]

    def heard_at_last(
        self, publish: Callable[[], Any], topic: str, fits: Callable[[Any], Any] = lambda message: True
    ) -> Any:
        """Publishes until a message that fits is heard; returns it.

        A reading is sent once and a rate bounds it: one may be lost, or left out right after another.
        """
        deadline_s = time.monotonic() + AT_MOST_S
        while True:
            publish()
            try:
                return self.heard(topic, fits, timeout_s=0.2)
            except AssertionError:
                if time.monotonic() > deadline_s:
                    raise

    def answer(self, name: str) -> Any:
        """Returns what a service, or a node, answered."""
        return self.told.wait(lambda line: line.get("answered") == name)["message"]

    def close(self) -> None:
        """Ends it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class RosAgent:
    """An agent in the other environment, as `pancakes-agent` runs it."""

    def __init__(self, folder: Path, domain: int, name: str, text: str) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.name = name
        self.log = folder / f"{name}.txt"
        config = folder / f"{name}.toml"
        config.write_text(f'schema = 1\n[agent]\nname = "{name}"\nstate_dir = "{folder / "state"}"\n{text}')
        ready, writes = os.pipe()
        command = [str(python_of(AGENTS)), "-m", "pancakes.tools.cli.agent_command", "--config", str(config)]
        with self.log.open("wb") as output:
            self.process = subprocess.Popen(
                [*command, f"--ready-fd={writes}"],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                env=environment(domain),
                pass_fds=(writes,),
            )
        os.close(writes)
        with os.fdopen(ready) as said:
            if not said.readline():
                raise AssertionError(f"{name} did not become ready: {self.lines()}")

    def lines(self) -> str:
        """Returns what it has said on its standard error."""
        return self.log.read_text(errors="replace")

    def wait_for_line(self, text: str, timeout_s: float = AT_MOST_S) -> None:
        """Waits until it has said something."""
        deadline_s = time.monotonic() + timeout_s
        while text not in self.lines():
            assert time.monotonic() < deadline_s, f"{self.name} did not say {text!r}:\n{self.lines()}"
            time.sleep(0.02)

    def kill(self) -> None:
        """Ends it at once."""
        self.process.kill()
        self.process.wait()

    def stop(self) -> int:
        """Ends it in good order; returns its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            self.process.wait(10.0)
        return int(self.process.returncode)
