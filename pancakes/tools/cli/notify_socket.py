"""What an agent tells the service manager that started it: it is ready, it lives, it ends (as sd_notify does)."""

from __future__ import annotations

import os
import socket
from collections.abc import MutableMapping
from contextlib import suppress
from typing import Final

_SOCKET: Final = "NOTIFY_SOCKET"
_WATCHDOG: Final = "WATCHDOG_USEC"
_WATCHDOG_PID: Final = "WATCHDOG_PID"


class NotifySocket:
    """The socket of the service manager, such as systemd. From any thread.

    Args:
        address: where it is; a name in the abstract namespace begins with `@`.
        watchdog_s: the service manager takes the process for hung where it hears nothing for so long; None: it does
            not look.
    """

    def __init__(self, address: str, watchdog_s: float | None = None) -> None:
        self.watchdog_s = watchdog_s
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)  # the timer's thread waits for no manager

    @classmethod
    def from_environment(cls, variables: MutableMapping[str, str]) -> NotifySocket | None:
        """Returns the socket that the environment names; None: no service manager has started this process.

        It takes the variables out, because a process that this one starts must not speak in its name.
        """
        address, watchdog, pid = (variables.pop(name, "") for name in (_SOCKET, _WATCHDOG, _WATCHDOG_PID))
        if not address.startswith(("/", "@")):
            return None
        watched = watchdog.isdecimal() and int(watchdog) > 0 and pid in ("", str(os.getpid()))
        return cls(address, int(watchdog) / 1e6 if watched else None)

    def say(self, **facts: str | int) -> None:
        """Says something, such as `READY=1`. A manager that does not listen any more need not know."""
        with suppress(OSError):
            self._socket.sendto("\n".join(f"{key}={value}" for key, value in facts.items()).encode(), self._address)
