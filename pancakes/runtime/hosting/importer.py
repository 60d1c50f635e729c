"""The importer: imports the class of a task that may come here, which takes seconds on a small computer."""

from __future__ import annotations

from typing import Any, Final

import msgspec

from pancakes.runtime.installed import Installed
from pancakes.runtime.kernel.component import Component
from pancakes.runtime.kernel.reference import Reference
from pancakes.runtime.kernel.tell import tell

IMPORTER: Final = "kernel/Importer"


class Import(msgspec.Struct, frozen=True):
    """Asks the importer for a task type.

    Attributes:
        asker: the actor that gets the answer, `Imported`.
        type: the task type.
        waiting: what waits for it; data.
    """

    asker: Reference
    type: str
    waiting: object


class Imported(msgspec.Struct, frozen=True):
    """A task type is imported, or cannot be: what is asked about it is answered at once from now on.

    Attributes:
        waiting: what has waited for it.
    """

    waiting: Any


class Importer(Component):
    """Imports task types in a thread of its own: the actors that answer other agents, and keep leases, wait for none.

    It belongs to no service. In virtual time there is none.

    Args:
        installed: what is installed.
    """

    blocking = True

    def __init__(self, *args: Any, installed: Installed, **others: Any) -> None:
        super().__init__(*args, **others)
        self._installed = installed

    def take_message(self, message: Any) -> Any:
        if not isinstance(message, Import):
            return super().take_message(message)
        self._installed.version_of(message.type)
        tell(message.asker, Imported(message.waiting))
        return None
