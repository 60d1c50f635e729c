"""The accounts of an agent's moves: the newest hundred, in memory and in the journal."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Final

import msgspec

from pancakes import codecs
from pancakes.journal import Journal, JournalEntry, RecordStore
from pancakes.malformed import MALFORMED, why_malformed
from pancakes.migration.ledger import Ledger

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


_DECODE: Final = codecs.decoder(Kept)


class Ledgers:
    """The newest accounts of one agent. Any thread.

    The journal deletes nothing, so its entries go round: account 101 is written in the place of account 1.

    Args:
        journal: read once, here.
        store: what writes to that journal.
        log: takes a level and a line about what could not be written.

    Attributes:
        unread: what the journal has and could not be read, each a sentence.
    """

    def __init__(self, journal: Journal, store: RecordStore, log: Callable[[str, str], None]) -> None:
        self._store = store
        self._log = log
        self._boot = journal.boot
        self._lock = threading.Lock()
        self.unread: list[str] = []
        found: list[Kept] = []
        for entry in journal.entries(KIND):
            try:
                found.append(_DECODE(entry.data))
            except MALFORMED as error:
                self.unread.append(f"the journal's account {entry.key} of a move is not used: {why_malformed(error)}")
        found.sort(key=lambda kept: kept.number)
        self._kept = deque(found, maxlen=KEPT)

    def add(self, ledger: Ledger, reason: str, mission_s: float) -> None:
        """Keeps an account, and begins to write it down; that of a hand-off is kept once. Never waits.

        Args:
            ledger: the account.
            reason: why the move came to nothing, or what had come between; else empty.
            mission_s: mission time.
        """
        with self._lock:
            if ledger.offer and any(
                (kept.ledger.task_id, kept.ledger.offer) == (ledger.task_id, ledger.offer) for kept in self._kept
            ):
                # The agent was killed after it was written and before the task's record said so.
                return
            number = self._kept[-1].number + 1 if self._kept else 1
            kept = Kept(number, self._boot, mission_s, reason, ledger)
            self._kept.append(kept)
        key = f"{number % KEPT:02d}"

        def failed(why: str) -> None:
            self._log("warning", f"the account of the move of {ledger.task_id} is not in the journal: {why}")

        self._store.persist(JournalEntry(KIND, key, codecs.encode(kept)), lambda: None, failed)

    def plain(self) -> list[dict[str, Any]]:
        """Returns the accounts, oldest first, as plain values: the fields of `Ledger` besides those of `Kept`."""
        with self._lock:
            newest = list(self._kept)
        return [
            {
                "number": kept.number,
                "boot": kept.boot,
                "mission_s": kept.mission_s,
                "reason": kept.reason,
                **_plain(kept.ledger),
            }
            for kept in newest
        ]


def _plain(ledger: Ledger) -> dict[str, Any]:
    plain = msgspec.to_builtins(ledger)
    # As another agent gets it over the wire, which knows no tuples.
    return {**plain, "lines": list(plain["lines"])}
