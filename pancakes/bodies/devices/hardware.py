"""What a driver opens of its computer's hardware, so that a service may be let do that and nothing else."""

from __future__ import annotations

import errno
import os

import msgspec


class Hardware(msgspec.Struct, frozen=True):
    """A device of the operating system.

    Attributes:
        node: its file below `/dev`, such as `/dev/ttyUSB0`, or a class of them, such as `char-i2c`.
        group: the group of the machine whose members may open it, such as `dialout`; empty: no group is needed.
    """

    node: str
    group: str = ""


def why_not_opened(error: OSError) -> str:
    """Returns why a node could not be opened, with what to do where the computer forbids it."""
    if error.errno is None:
        return str(error)
    reason = os.strerror(error.errno)
    if error.errno == errno.EPERM:
        return f"{reason}: a service opens the nodes that its unit names, print the unit again and restart it"
    if error.errno == errno.EACCES:
        return f"{reason}: the agent's user has to be in the group of that node"
    return reason
