"""The accounts of an agent's moves: the newest hundred, in memory and in the journal."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Final

import msgspec

from pancakes.mesh.migration.ledger import Ledger
from pancakes.runtime.foundation import codecs
from pancakes.runtime.journal import Disk, RecordTable

KIND: Final = "ledger"
KEPT: Final = 100
"""So many are kept for each agent; the newest takes the place of the oldest."""


class Kept(msgspec.Struct, frozen=True):
    """One account, and when it was written down.

    Attributes:
        number: its place in the order of all moves from this agent, from 1.
        boot: in which life of the agent: mission time begins anew with each.
        mission_s: the mission time at which the move was over.
        reason: why it came to nothing, or (moved all the same) what had come between; else empty.
        ledger: the account.
    """

    number: int
    boot: int
    mission_s: float
    reason: str
    ledger: Ledger


class Ledgers:
    """The newest accounts of one agent. Any thread adds to them, and asks for them.

    The journal deletes nothing, so its entries go round: account 101 is written in the place of account 1.

    Args:
        disk: what they are kept on.
        log: takes a level and a line about what could not be written.
    """

    def __init__(self, disk: Disk, log: Callable[[str, str], None]) -> None:
        def malformed(key: str, why: str) -> None:
            disk.unread.append(f"the journal's account {key} of a move is not used: {why}")

        self._log = log
        self._boot = disk.journal.boot
        self._lock = threading.Lock()  # guards the number of the last one
        self._accounts = RecordTable(disk, KIND, codecs.decoder(Kept), malformed)
        self._last = max((kept.number for kept in self._accounts.newest.values()), default=0)

    def add(self, ledger: Ledger, reason: str, mission_s: float) -> None:
        """Keeps an account, and begins to write it down; that of a hand-off is kept once. Never waits.

        Args:
            ledger: the account.
            reason: why the move came to nothing, or what had come between; else empty.
            mission_s: mission time.
        """

        def failed(why: str) -> None:
            self._log("warning", f"the account of the move of {ledger.task_id} is not in the journal: {why}")

        if ledger.offer and any(
            (kept.ledger.task_id, kept.ledger.offer) == (ledger.task_id, ledger.offer) for kept in self._newest()
        ):
            # The agent was killed after it was written and before the task's record said so.
            return
        with self._lock:
            self._last = number = self._last + 1
        kept = Kept(number, self._boot, mission_s, reason, ledger)
        self._accounts.write(f"{number % KEPT:02d}", kept, lambda: None, failed)

    def _newest(self) -> list[Kept]:
        return sorted(self._accounts.newest.values(), key=lambda kept: kept.number)

    def plain(self) -> list[dict[str, Any]]:
        """Returns the accounts, oldest first, as plain values: the fields of `Ledger` besides those of `Kept`."""
        return [
            {
                "number": kept.number,
                "boot": kept.boot,
                "mission_s": kept.mission_s,
                "reason": kept.reason,
                **_plain(kept.ledger),
            }
            for kept in self._newest()
        ]


def _plain(ledger: Ledger) -> dict[str, Any]:
    plain = msgspec.to_builtins(ledger)
    # As another agent gets it over the wire, which knows no tuples.
    return {**plain, "lines": list(plain["lines"])}
