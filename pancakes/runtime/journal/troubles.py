"""Which entries a journal could not write of late: how long each is left alone, and what is to be said of it."""

from __future__ import annotations

from typing import Final, NamedTuple

import msgspec

FIRST_PAUSE_S: Final = 0.1
LONGEST_PAUSE_S: Final = 5.0
SAID_EVERY_S: Final = 5.0
"""That the journal cannot write is said at most so often, in seconds."""

Key = tuple[str, str]
"""Kind and key of an entry."""


class Saying(NamedTuple):
    """A line for `log`."""

    level: str
    text: str


class _Trouble(msgspec.Struct):
    reason: str
    pause_s: float
    due_s: float


class Troubles:
    """Counts what fails, and says when it may be tried again. Pure; all times are in seconds of one clock."""

    def __init__(self) -> None:
        self._troubles: dict[Key, _Trouble] = {}
        self._failures = 0  # since the journal could write last
        self._since_s = 0.0
        self._said = False  # that it cannot
        self._said_s = -SAID_EVERY_S

    def due_s(self, key: Key) -> float:
        """Returns when an entry may be written; 0 where it did not fail of late."""
        trouble = self._troubles.get(key)
        return trouble.due_s if trouble is not None else 0.0

    def reason(self, key: Key) -> str:
        """Returns why an entry could not be written when that was tried last; empty where it could."""
        trouble = self._troubles.get(key)
        return trouble.reason if trouble is not None else ""

    def newest(self) -> str:
        """Returns why an entry could not be written, of all that could not the newest; empty: all could."""
        return next((it.reason for it in reversed(list(self._troubles.values()))), "")

    def worked(self, key: Key) -> None:
        """An entry is on disk."""
        self._troubles.pop(key, None)

    def failed(self, key: Key, reason: str, now_s: float) -> None:
        """An entry could not be written: each pause until the next try is twice as long as the last."""
        trouble = self._troubles.get(key)
        pause_s = FIRST_PAUSE_S if trouble is None else min(2 * trouble.pause_s, LONGEST_PAUSE_S)
        self._troubles[key] = _Trouble(reason, pause_s, now_s + pause_s)
        if not self._failures:
            self._since_s = now_s
        self._failures += 1

    def saying(self, now_s: float) -> Saying | None:
        """Returns what is to be said after a round of writing; None: nothing, or nothing new."""
        # One that was not tried again when it might have been has been given up by the code that asked for it.
        for key in [key for key, trouble in self._troubles.items() if trouble.due_s + LONGEST_PAUSE_S < now_s]:
            del self._troubles[key]
        if self._troubles:
            return self._cannot(now_s)
        if not self._said:
            return None  # what failed too soon after the last line to be said counts for the next one
        text = f"the journal can write again ({_times(self._failures)} in {now_s - self._since_s:.1f} s failed)"
        self._failures, self._said = 0, False
        return Saying("info", text)

    def _cannot(self, now_s: float) -> Saying | None:
        if now_s < self._said_s + SAID_EVERY_S:
            return None
        first, self._said, self._said_s = not self._said, True, now_s
        reason = next(reversed(self._troubles.values())).reason
        if first and self._failures == 1:
            return Saying("error", f"{reason}: it is tried again, first soon, then every {LONGEST_PAUSE_S:g} s")
        return Saying("error", f"{reason}: {_times(self._failures)} in {now_s - self._since_s:.1f} s failed")


def _times(failures: int) -> str:
    return f"{failures} {'try' if failures == 1 else 'tries'}"
