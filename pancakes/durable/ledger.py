"""The account of one migration: who was asked, what each said, who won, and why the others did not. Pure.

`Sequel` is what the source must still do after the task has gone. It lies in the task's record, so a crash does not
lose it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

import msgspec
from msgspec.structs import replace

from pancakes.errors import MigrationError
from pancakes.packet import packet_type
from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED, why_malformed

Answer = Literal["bid", "refused", "silent"]
"""What a neighbour did; a bid that could not be compared, or came late, counts as `refused`."""

Fate = Literal["won", "lost", "failed", "refused", "silent"]
"""What became of it: `lost` to a cheaper bid; `failed` after it was chosen."""


class Line(msgspec.Struct, frozen=True):
    """What one neighbour said, and what became of that.

    Attributes:
        peer: the neighbour.
        answer: what it did.
        fate: what became of it.
        cost: what it asked for; None where it made no bid.
        terms: what that cost was made of.
        reason: why it did not get the task; empty where it did.
        code: of a refusal, the same for programs (`docs/refusals.md`); else empty.
        retry_after_s: of a refusal, after how long it may be worth asking again, in seconds.
    """

    peer: str
    answer: Answer
    fate: Fate
    cost: float | None = None
    terms: Mapping[str, float] = msgspec.field(default_factory=dict)
    reason: str = ""
    code: str = ""
    retry_after_s: float | None = None


@packet_type("migration.ledger")
class Ledger(msgspec.Struct, frozen=True):
    """The whole account.

    Attributes:
        task_id: the task, as `birthplace/name`.
        source: the agent that it was to move from, or was taken over from.
        asked_by: what asked for the move: an address, `rule`, or `guardians`.
        cost: the cost function that was used, or several with their weights (`1 tasks + 2 battery`).
        outcome: `moved`, `stayed`, `undecided` (still under way) or `dry run`; `fenced` where it did not move, and a
            person set the fence of an actuator of the source to the epoch that it has; `created` and `removed` where it
            began on the source, and where it ended there for good.
        winner: the agent that has it, or (dry run) would get it; empty where none.
        lines: one for each neighbour that was asked, by name.
        duration_s: host time from the first asking to the outcome.
        offer: the hand-off that ended it, such as `3@agent1`; empty where none did.
        to: the only neighbour that was to be asked; empty: all.
        cause: of a task that was taken over: from which agent and from which checkpoint, as a sentence; else empty.
    """

    task_id: str
    source: str
    asked_by: str
    cost: str
    outcome: Literal["moved", "stayed", "undecided", "dry run", "fenced", "created", "removed"]
    winner: str
    lines: tuple[Line, ...]
    duration_s: float
    offer: str = ""
    to: str = ""
    cause: str = ""

    def moved(self, offer: str) -> Ledger:
        """Returns the account of a move that was undecided: the hand-over has happened."""
        return replace(self, outcome="moved", offer=offer)

    def stayed(self, offer: str, reason: str) -> Ledger:
        """Returns the account of a move that was undecided: the hand-over has come to nothing."""
        lines = tuple(
            replace(line, fate="failed", reason=reason) if line.peer == self.winner else line for line in self.lines
        )
        return replace(self, outcome="stayed", winner="", lines=lines, offer=offer)


class Sequel(msgspec.Struct, frozen=True):
    """What follows a hand-over, for the service that the task has left. The core carries it, and does not look in.

    Attributes:
        then: a task to start; empty: none.
        ledger: the account of the move as it stood when the task was stopped for it; None where there is none.
    """

    then: str = ""
    ledger: Ledger | None = None

    def encode(self) -> bytes:
        """Returns it as msgpack bytes, for the record."""
        return codecs.encode(self)

    @classmethod
    def decode(cls, data: bytes) -> Sequel:
        """Reads what `encode` wrote; nothing at all is a sequel in which nothing follows.

        Raises:
            MigrationError: the bytes are no sequel.
        """
        if not data:
            return cls()
        try:
            return _DECODE(data)
        except MALFORMED as error:
            raise MigrationError(
                f"these {len(data)} bytes do not say what follows a hand-over: {why_malformed(error)}"
            ) from None


_DECODE: Callable[[bytes], Sequel] = codecs.decoder(Sequel)
