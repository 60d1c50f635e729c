"""What a driver opens of its computer's hardware, so that a service may be let do that and nothing else."""

from __future__ import annotations

import msgspec


class Hardware(msgspec.Struct, frozen=True):
    """A device of the operating system.

    Attributes:
        node: its file below `/dev`, such as `/dev/ttyUSB0`, or a class of them, such as `char-i2c`.
        group: the group of the machine whose members may open it, such as `dialout`; empty: no group is needed.
    """

    node: str
    group: str = ""
