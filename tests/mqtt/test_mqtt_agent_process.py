"""An agent as a process: its last will, its last words, and the tutorial."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from harness.guide import ROOT, run_guide
from mqtt.brokers import Mosquitto

CONFIG = """
schema = 1

[agent]
name = "a"
state_dir = "{folder}/state"

[service.mqtt]
type = "mqtt"
settings = {{ broker = "{broker}" }}

[device.plug]
driver = "mqtt.switch"
settings = {{ broker = "{broker}", topic = "plug" }}
"""


@contextmanager
def agent_of(broker: Mosquitto, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Runs the agent, from when it has said that it is online."""
    path = folder / "a.toml"
    path.write_text(CONFIG.format(folder=folder, broker=broker.address))
    program = Path(sys.executable).with_name("pancakes-agent")
    with open(folder / "agent.log", "wb") as log, broker.listening("pancakes/a/status") as heard:
        process = subprocess.Popen([program, "--config", path], stderr=log, stdout=log)
        try:
            assert next(heard) == ("pancakes/a/status", "online")
            yield process
        finally:
            process.kill()
            process.wait()


def test_mqtt_status_is_offline_after_a_kill(broker: Mosquitto, tmp_path: Path) -> None:
    with agent_of(broker, tmp_path) as process, broker.listening("pancakes/a/status", "-R") as heard:
        process.send_signal(signal.SIGKILL)
        assert next(heard) == ("pancakes/a/status", "offline")
    assert broker.read("pancakes/a/status") == "offline", "and the broker keeps that"


def test_mqtt_agent_that_ends_sends_its_last_words(broker: Mosquitto, tmp_path: Path) -> None:
    with agent_of(broker, tmp_path) as process, broker.listening("#", "-R") as heard:
        process.send_signal(signal.SIGTERM)
        assert process.wait(10) == 0
        said = [next(heard), next(heard)]
        assert sorted(said) == [("pancakes/a/status", "offline"), ("plug", "OFF")]
    assert "did not stop" not in (tmp_path / "agent.log").read_text()


def test_mqtt_tutorial_works_as_written(broker: Mosquitto, tmp_path: Path) -> None:
    run_guide(ROOT / "plugins" / "pancakes-mqtt" / "README.md", tmp_path)
