"""The referee of robots that exist only as nodes of ROS 2 (`ros2.arena`): it starts them, and tells the truth."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import msgspec

from pancakes.errors import PancakesError
from pancakes.packet import SYSTEM
from pancakes.settings import FilePath, Positive, plain_settings
from pancakes.sim.arena import Incident
from pancakes.sim.bodies import ContentSettings
from pancakes.sim.world_state import WorldState
from pancakes.task import Task, Tick, every
from pancakes.util import codecs
from pancakes_ros2.arena_clock import Beginning
from pancakes_ros2.installation import check_installed
from pancakes_ros2.newest import Newest
from pancakes_ros2.robot_nodes import Contents, TruthLine

LINES: Final = 10_000
"""How many lines of the truth wait, at most."""
OF_THIS_ROS: Final = ("LD_LIBRARY_PATH", "AMENT_PREFIX_PATH", "PYTHONPATH", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")
"""What an environment with a ROS 2 puts into that of its processes, and another one must not get."""


class Arena(Task):
    """A world whose robots are nodes of ROS 2, in a process of their own. Nothing but ROS 2 leads to them.

    Publishes a `world_state` on `system` as `sim.world` does, and the events `collision` and `out_of_bounds`.
    """

    @dataclass
    class Settings(ContentSettings):
        """The contents of the world. They are read once, when the task starts.

        Attributes:
            state_hz: how often the truth is told.
            python: the Python of the environment that the robots run in, which may have another release of ROS 2;
                empty: this one.
        """

        state_hz: Positive = 20.0
        python: FilePath = ""

    settings: Settings
    _process: subprocess.Popen[bytes] | None = None

    def on_start(self) -> None:
        if self._actor.kernel.virtual is not None:
            raise PancakesError(f"{self.address} has robots of ROS 2, which do not live in virtual time: run it live")
        settings = self.settings
        if not settings.python:
            check_installed()
        self._begun = False
        self._closing = False
        self._lines: Newest[bytes] = Newest(LINES, lambda: self.call(self._take))
        python = settings.python or sys.executable
        try:
            self._process = process = subprocess.Popen(
                [python, "-m", "pancakes_ros2.robot_nodes"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=environment_for(os.environ, settings.python),
            )
        except OSError as error:
            raise PancakesError(f"{self.address} cannot start {python}: {error.strerror}") from None
        threading.Thread(target=self._read, args=(process,), name=f"arena-{self.agent}").start()
        world = plain_settings(settings)
        world = {key: value for key, value in world.items() if key not in ("state_hz", "python")}
        self._order(Contents(world, self.random.getrandbits(32), settings.state_hz))

    def _read(self, process: subprocess.Popen[bytes]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            self._lines.put(line)
        process.wait()
        self.call(self._ended)

    def _order(self, body: Any) -> None:
        process = self._process
        if process is None or process.stdin is None:
            return
        try:
            process.stdin.write(codecs.json_encoder()(body) + b"\n")
            process.stdin.flush()
        except OSError:
            pass  # that it has ended is heard from the thread that reads

    def _ended(self) -> None:
        if not self._closing and self._process is not None:
            code = self._process.returncode
            raise PancakesError(f"the process of the robots ended with exit code {code}; its last words are above")

    @every(hz=20)
    def begin(self, tick: Tick) -> None:
        """Tells the robots when the mission began; once."""
        if not self._begun:
            self._begun = True
            self._order(Beginning(self.now(), self._actor.kernel.host.now(), self._actor.kernel.mission.speed))

    def _take(self) -> None:
        lines, lost = self._lines.take()
        if lost:
            self.log("warning", f"{lost} lines of the truth are lost, as this task is too slow")
        for line in lines:
            try:
                told = codecs.json_decoder(TruthLine)(line)
            except msgspec.DecodeError:
                continue  # a library said something
            if told.ready:
                self.log("info", "the robots are nodes of ROS 2 now")
            if told.state is not None:
                self.publish(SYSTEM, codecs.convert(told.state, WorldState))
            if told.incident is not None:
                incident = codecs.convert(told.incident, Incident)
                where = {"x_m": incident.x_m, "y_m": incident.y_m}
                self.event(incident.kind, time_s=incident.time_s, names=list(incident.names), **where)

    def on_stop(self) -> None:
        process, self._process = self._process, None
        self._closing = True
        if process is not None and process.stdin is not None:
            process.stdin.close()  # it ends with its input

    def on_failure(self, *error: Any) -> None:
        self.on_stop()


def environment_for(present: Mapping[str, str], python: str) -> dict[str, str]:
    """Returns the environment of the robots' process: without what this one's ROS 2 put there, where theirs is another.

    Args:
        present: that of this process.
        python: their Python; empty: this one.
    """
    if not python:
        return dict(present)
    roots = tuple(root for root in present.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if root)
    kept = [path for path in present.get("PYTHONPATH", "").split(os.pathsep) if path and not path.startswith(roots)]
    wanted = {key: value for key, value in present.items() if key not in OF_THIS_ROS}
    return {**wanted, **({"PYTHONPATH": os.pathsep.join(kept)} if kept else {})}
