"""What a deployment brings to one host."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from pancakes.tools.deploy.wheels import Wheel
from pancakes.tools.launch.hosts import Host

MARGIN: Final = 1.1
"""What a disk loses beside the bytes of files."""


@dataclass(frozen=True)
class Supply:
    """What is brought to one host.

    Attributes:
        host: the host.
        build: the build of Pancakes and its plug-ins.
        environment: the environment that is made of it there.
        own: the wheels of Pancakes and its plug-ins, and that of pip.
        libraries: the folder with what they need.
        others: the wheels that are unpacked there, and that of pip.
        missing: those of the wheels that are to be sent.
        damaged: files of the environment there that were changed by hand, so that another one is made.
    """

    host: Host
    build: str
    environment: str
    own: Sequence[Wheel]
    libraries: str
    others: Sequence[Wheel]
    missing: Sequence[Wheel]
    damaged: Sequence[str] = ()

    @property
    def brought_bytes(self) -> int:
        """How much is sent."""
        return sum(wheel.path.stat().st_size for wheel in self.missing)

    def shortage(self) -> str:
        """Returns a sentence if the disk over there has too little room; empty: it has enough."""
        unpacked = 0
        if self.environment not in self.host.is_["environments"]:
            unpacked += sum(wheel.unpacked_bytes for wheel in self.own)
        if self.libraries not in self.host.is_["libraries"]:
            unpacked += sum(wheel.unpacked_bytes for wheel in self.others)
        needed, free = MARGIN * (self.brought_bytes + unpacked), self.host.is_["free_bytes"]
        if free >= needed:
            return ""
        left, wanted = (f"{value / 1e6:.0f} MB" for value in (free, needed))
        disk = f"its disk ({self.host.is_['data']})"
        return f"{self.host.name} has {left} left on {disk} and needs {wanted}: make room there"
