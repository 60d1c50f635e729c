"""Stops the services of an agent whose root has failed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from pancakes.runtime.kernel.component import Component
from pancakes.runtime.kernel.tell import tell
from pancakes.runtime.supervision.service_messages import Close

LOOK_S: Final = 0.01
"""How often, in host time, it looks whether the service that it stops has ended."""


class Closer(Component):
    """Stops services, the last first, each once the one before has ended, and then ends itself.

    Args:
        services: the addresses of the services, in the order in which they started.
    """

    def __init__(self, *args: Any, services: Sequence[str], **others: Any) -> None:
        super().__init__(*args, **others)
        self._left = list(services)

    def on_start(self) -> None:
        self._close_next()

    def _close_next(self) -> None:
        while self._left:
            service = self.kernel.registry.get(self._left.pop())
            if service is not None and tell(service, Close()):
                self._wait_for(service.address)
                return
        self.stop()

    def _wait_for(self, address: str) -> None:
        if self.kernel.registry.get(address) is None:
            self._close_next()
        else:
            self.after_host(LOOK_S, lambda: self._wait_for(address))
