"""What is to be seen, as named values of which it is known when each changed last. Pure."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any


class Board:
    """Named plain values. A page that has seen one version gets all changes since, however long ago that was.

    So the board keeps nothing for its pages: a slow page gets the newest values only.

    Attributes:
        version: goes up with each change.
    """

    def __init__(self) -> None:
        self.version = 0
        self._entries: OrderedDict[str, tuple[int, Any]] = OrderedDict()

    def set(self, key: str, value: Any) -> None:
        """Writes a value; one that is there already is no change. None takes it away."""
        known = self._entries.get(key)
        if known[1] == value if known is not None else value is None:
            return
        self.version += 1
        self._entries[key] = (self.version, value)
        self._entries.move_to_end(key)

    def get(self, key: str) -> Any:
        """Returns a value, None where there is none."""
        entry = self._entries.get(key)
        return entry[1] if entry is not None else None

    def keys(self, prefix: str = "") -> list[str]:
        """Returns the names of the values that are there, of those that begin with `prefix`."""
        return [key for key, (_, value) in self._entries.items() if value is not None and key.startswith(prefix)]

    def since(self, version: int) -> dict[str, Any]:
        """Returns what changed after a version, the oldest change first; what was taken away since is None."""
        changed: list[tuple[str, Any]] = []
        for key, (when, value) in reversed(self._entries.items()):
            if when <= version:
                break
            changed.append((key, value))
        return dict(reversed(changed))

    def all(self) -> dict[str, Any]:
        """Returns all values."""
        return {key: value for key, (_, value) in self._entries.items() if value is not None}
