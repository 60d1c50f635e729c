"""An agent that a terminal looks for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Lead:
    """An agent that is known to be somewhere.

    Attributes:
        address: where; empty where it cannot be dialled.
        fleet: its fleet; empty while that is not known.
        name: its name, likewise.
        failed: why it cannot be asked; empty while it can.
        here: whether the runtime directory of this machine names it.
    """

    address: str
    fleet: str = ""
    name: str = ""
    failed: str = ""
    here: bool = False

    def __str__(self) -> str:
        return f"{self.name} ({self.address})" if self.name and self.address else self.name or self.address

    def silence(self, why: str) -> str:
        """Returns a sentence that it gave no answer, and why; empty: that is not known."""
        if why.startswith(f"{self.address} "):  # it names the address itself
            return f"{self}{why.removeprefix(self.address)}"
        return f"{self} did not answer" + (f": {why}" if why else "")
