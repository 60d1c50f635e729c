"""Write a driver for a sensor, here one whose reading stands in a file, as Linux shows sensors under /sys.

A reading that fails is missed, and the device goes on; after five misses in a row it fails, and is restarted.

$ python examples/sensor_driver.py
21.5
22.0
chip: a reading is missed: FileNotFoundError: [Errno 2] No such file or directory
23.0
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

from pancakes import SYSTEM, FilePath, Sensor, Simulation, Task, on
from pancakes.devices import Temperature


class FileThermometer(Sensor):
    type = "temperature"

    @dataclass
    class Settings:
        path: FilePath

    settings: Settings

    def read(self) -> Temperature:
        return Temperature(int(Path(self.settings.path).read_text()) / 1000)


class Show(Task):
    requires = ("temperature",)

    @on(SYSTEM)
    def measured(self, reading: Temperature) -> None:
        print(reading.celsius)


with tempfile.TemporaryDirectory() as folder, Simulation() as simulation:
    file = Path(folder, "temp1_input")
    file.write_text("21500\n")
    chip = {"type": FileThermometer, "rate_hz": 1, "settings": {"path": str(file)}}
    simulation.add("robot1", tasks={"Show": Show}, devices={"chip": chip})
    simulation.reset(seed=1)
    simulation.step(1.0)
    file.write_text("22000\n")
    simulation.step(1.0)
    file.unlink()
    simulation.step(1.0)
    (line,) = simulation.agents["robot1"].lines("warning")
    print(line.partition(": '")[0])
    file.write_text("23000\n")
    simulation.step(1.0)
