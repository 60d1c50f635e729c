"""A distribution in a folder, as pip installs it, whose files a test may change while an agent runs."""

from pathlib import Path
from typing import NamedTuple

PACKETS = """
from msgspec import Struct
from pancakes import packet_type

@packet_type("walk_in_test.step")
class Step(Struct, frozen=True):
    number: int

    def is_odd(self):
        return self.number % 2 == 1
"""
HELPERS = """
WORD = "first"
"""
WALK = """
from dataclasses import dataclass, field
from pancakes import SYSTEM, Packet, Task, Tick, every, on
from walk_in_test import helpers
from walk_in_test.packets import Step

class Walk(Task):
    @dataclass
    class Settings:
        stride_m: float = 0.5
        name: str = "anna"

    @dataclass
    class State:
        steps: int = 0

    settings: Settings
    state: State

    @every(hz=10)
    def step(self, tick: Tick) -> None:
        self.state.steps += 1
        self.publish(SYSTEM, Step(self.state.steps))
        if self.state.steps % 10 == 0:
            self.event("walked", word=helpers.WORD, steps=self.state.steps, stride_m=self.settings.stride_m)
"""
COUNT = """
from dataclasses import dataclass
from pancakes import SYSTEM, Packet, Task, on
from walk_in_test.packets import Step

class Count(Task):
    @dataclass
    class State:
        heard: int = 0

    state: State

    @on(SYSTEM, Step)
    def on_step(self, packet: Packet) -> None:
        match packet.body:
            case Step():
                self.state.heard += 1
"""
DRIVER = """
from pancakes import Sensor
from pancakes.devices import Load

class Gauge(Sensor):
    type = "load"

    def read(self) -> Load:
        return Load(0.5)
"""
POINTS = """
[pancakes.tasks]
walk_in_test.Walk = walk_in_test.walk:Walk
walk_in_test.Count = walk_in_test.count:Count
[pancakes.packets]
walk_in_test = walk_in_test.packets
[pancakes.drivers]
walk_in_test.Gauge = walk_in_test.gauge:Gauge
"""


class PluginOnDisk(NamedTuple):
    """The distribution `walk-in-test`.

    Attributes:
        folder: where it is installed.
    """

    folder: Path

    def write(self, module: str, text: str) -> Path:
        """Write a module of it; return its file."""
        path = self.folder / "walk_in_test" / f"{module}.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        return path

    def edit(self, module: str, old: str, new: str) -> None:
        """Replace a text in a module of it."""
        path = self.folder / "walk_in_test" / f"{module}.py"
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    def install(self, version: str, points: str = POINTS) -> None:
        """Write its metadata, in the place of those of another version, as pip does."""
        for other in self.folder.glob("walk_in_test-*.dist-info"):
            for file in other.iterdir():
                file.unlink()
            other.rmdir()
        information = self.folder / f"walk_in_test-{version}.dist-info"
        information.mkdir()
        (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: walk-in-test\nVersion: {version}\n")
        (information / "entry_points.txt").write_text(points)


def written(folder: Path) -> PluginOnDisk:
    """Write the distribution into a folder, in the version 0.1.0."""
    plugin = PluginOnDisk(folder)
    modules = {"packets": PACKETS, "helpers": HELPERS, "walk": WALK, "count": COUNT, "gauge": DRIVER, "__init__": ""}
    for module, text in modules.items():
        plugin.write(module, text)
    plugin.install("0.1.0")
    return plugin
