"""An agent gets a new key while packets flow: acknowledged packets arrive once and in order."""

from __future__ import annotations

import time
from pathlib import Path

from cli.processes import PATIENCE_S, Rig

SOURCE = """
from dataclasses import dataclass
from pancakes.packet import packet_type
from pancakes.task import Task, every, on, reliable

@packet_type("renewing.number")
@dataclass(frozen=True)
class Number:
    number: int

class Telling(Task):
    @dataclass
    class Settings:
        file: str

    def on_start(self):
        self.out = open(self.settings.file, "a", buffering=1)

    def on_stop(self):
        self.out.close()

class Source(Telling):
    number = 0

    @every(hz=200)
    def tick(self, tick):
        self.number += 1
        self.publish("system", Number(self.number), to="task:b/Sink")
        print(self.number, file=self.out)

class Sink(Telling):
    durability = "each"

    @on("system", Number, queue=reliable(1024))
    def take(self, packet):
        print(packet.body.number, file=self.out)
"""


def task(name: str, file: Path) -> str:
    return f'[task.{name}]\ntype = "renewing.{name}"\nsettings = {{ file = "{file}" }}\n'


def lines(path: Path) -> list[int]:
    return [int(line) for line in path.read_text().split("\n")[:-1]] if path.exists() else []


def wait_for(path: Path, count: int) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while len(lines(path)) < count:
        assert time.monotonic() < until_s, f"{path} has {len(lines(path))} lines"
        time.sleep(0.01)


def test_reload_keys_loses_no_acknowledged_packet(rig: Rig):
    names = ("Source", "Sink")
    points = "".join(f"renewing.{name} = plugin_renewing:{name}\n" for name in names)
    rig.install("renewing", f"[pancakes.tasks]\n{points}", SOURCE)
    sent, came = rig.directory / "sent", rig.directory / "came"
    sink = rig.ready("b", task("Sink", came))
    source = rig.ready("a", task("Source", sent), agent=f'peers = ["{rig.address(sink)}"]')
    wait_for(came, 100)
    for name, other in (("a", sink), ("b", source), ("a", sink)):
        rig.keys.authority("test").enrol_with_key("agent", name).write(rig.keys.of_agent("test", name))
        reloaded = rig.pancakes("agent", "reload-keys", name)
        assert reloaded.returncode == 0, reloaded.stderr
        other.hear(f"the link to {name} has ended")
        other.hear(f"{name} (agent, tcp://")
        wait_for(came, len(lines(came)) + 100)
    assert rig.pancakes("task", "stop", "a/Source").returncode == 0
    wait_for(came, len(lines(sent)))
    assert lines(came) == lines(sent) == list(range(1, len(lines(sent)) + 1))
