"""A Khepera III on a pseudo-terminal: it answers as the manual of K-Team says, and can be unplugged."""

from __future__ import annotations

import os
import select
import threading
import tty
from pathlib import Path


class KheperaBench:
    """The robot's end of a serial cable.

    Args:
        link: where the port is to be found.

    Attributes:
        heard: the commands that came, in order.
        speeds: what the wheels were told last.
        mute: whether it answers nothing.
        noise: what it says before each answer.
        infrared: what its eleven infrared sensors say.
        echoes: the distances that each of its sonars hears, in centimetres.
    """

    def __init__(self, link: Path) -> None:
        self.link = link
        self.heard: list[str] = []
        self.speeds = (0, 0)
        self.mute = False
        self.noise = b""
        self.infrared = [3945, 22, 100, 0, 1, 2, 3, 4, 5, 6, 7]
        self.echoes = {1: [50], 2: [120, 30], 3: [], 4: [400], 5: [0]}
        self._thread: threading.Thread | None = None
        self.plug()

    def plug(self) -> None:
        """Puts the cable in."""
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        self._ended = threading.Event()
        self.link.symlink_to(os.ttyname(self._far))
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def unplug(self) -> None:
        """Pulls the cable out."""
        if self._thread is None:
            return
        self.link.unlink()
        self._ended.set()
        self._thread.join()
        self._thread = None
        os.close(self._near)
        os.close(self._far)

    def _run(self) -> None:
        waiting = b""
        while not self._ended.is_set():
            if not select.select([self._near], [], [], 0.02)[0]:
                continue
            waiting += os.read(self._near, 4096)
            *commands, waiting = waiting.split(b"\r")
            for command in filter(None, commands):
                self.heard.append(command.decode())
                if not self.mute:
                    os.write(self._near, self.noise + self._answer(command.decode()).encode() + b"\r\n")

    def _answer(self, command: str) -> str:
        kind, *parameters = command.split(",")
        match kind:
            case "B":
                return "b,3,1"
            case "D":
                assert all(it.startswith("l") for it in parameters), "speeds have 32 bits"
                left, right = (int(it[1:]) for it in parameters)
                self.speeds = (left, right)
                return "d"
            case "N":
                return ",".join(["n", *map(str, self.infrared), "123456"])
            case "G":
                found = self.echoes[int(parameters[0])]
                told = [value for distance in found for value in (distance, 1000, 99)] + [0, 0, 0] * (5 - len(found))
                return ",".join(["g", str(len(found)), *map(str, told), "7"])
            case "V":
                return {"0": "v,7,8125", "5": "v,64"}[parameters[0]]
        return "z"
