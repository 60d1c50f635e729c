"""The bidding for one task: asks the neighbours, compares what they say, and keeps the account. Pure.

Where one neighbour has bid, no other is waited for longer than half a second; where none has, a silent one is
waited for longer, because it may import the task's class first. The cheapest is chosen, ties by name; where its
hand-off comes to nothing, the next one is. The task runs on all through this.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

import msgspec
from msgspec.structs import replace

from pancakes.errors import NoCandidate
from pancakes.mesh.migration.cost import cost_text, fault_of
from pancakes.mesh.migration.ledger import Ledger, Line
from pancakes.mesh.migration.messages import Solicit
from pancakes.runtime.foundation.suggestion import hint_of

MOST_TERMS: Final = 64
"""A bid has no more terms, ..."""
MOST_LETTERS: Final = 1000
"""... and no reason more letters: the accounts of moves are kept on disk."""


class Awarded(msgspec.Struct, frozen=True):
    """`peer` is to get the task: begin the hand-off, then say `failed` or `moved`."""

    peer: str


class Exhausted(msgspec.Struct, frozen=True):
    """No neighbour can take the task, or the request was only to know which could.

    Attributes:
        error: what to tell the asker; its message has each neighbour's reason. None after a dry run that
            found a candidate.
    """

    error: NoCandidate | None


Outcome = Awarded | Exhausted


class Negotiation:
    """One asking for bids, until the task has moved or stays.

    Each method that may decide something returns an `Outcome`, or None where nothing is decided by it.

    Args:
        request: what is asked; sent to each of `asked` by the caller.
        source: as in `Ledger`.
        asked_by: the task or person that wants the move, for the ledger.
        neighbours: the neighbours in a role that hosts tasks.
        now_s: host time.
        to: the only neighbour to ask; empty: all.
        dry_run: compare, and move nothing.
        window_s: how long to wait for other answers where a bid has come, in host time.
        patience_s: how long to wait where none has.
        cause: as in `Ledger`.

    Attributes:
        asked: the neighbours that are asked.
        latest_s: when the window closes at the latest, in host time.
    """

    def __init__(
        self,
        request: Solicit,
        source: str,
        asked_by: str,
        neighbours: Iterable[str],
        now_s: float,
        to: str,
        dry_run: bool,
        window_s: float,
        patience_s: float,
        cause: str,
    ) -> None:
        self._known = known = sorted(dict.fromkeys(neighbours))
        self.request = request
        self.asked: tuple[str, ...] = tuple(peer for peer in known if not to or peer == to)
        self._source = source
        self._asked_by = asked_by
        self._to = to
        self.dry_run = dry_run
        self._window_s = window_s
        self._patience_s = patience_s
        self.latest_s = now_s + patience_s
        self._cause = cause
        self._began_s = now_s
        self._ended_s: float | None = None
        self._open = True
        self._chosen = ""
        self._lines: dict[str, Line] = {}

    @property
    def open(self) -> bool:
        """Whether answers are still waited for."""
        return self._open

    @property
    def chosen(self) -> str:
        """The neighbour that the hand-off is under way to, or that has the task; empty where none."""
        return self._chosen

    def begin(self, now_s: float) -> Outcome | None:
        """Begins. To be called before the answers come; decides at once where there is no neighbour to ask."""
        return None if self.asked else self._close(now_s)

    def bid(self, peer: str, cost: float, terms: Mapping[str, float], now_s: float) -> Outcome | None:
        """Takes a bid. One that cannot be compared counts as a refusal."""
        fault = fault_of(cost, terms)
        if len(terms) > MOST_TERMS or any(len(name) > MOST_LETTERS for name in terms):
            fault = f"it has more than {MOST_TERMS} terms, or too long a name"
        if fault:
            return self._answer(Line(peer, "refused", "refused", reason=f"its bid does not count: {fault}"), now_s)
        return self._answer(Line(peer, "bid", "lost", cost, dict(terms)), now_s)

    def refuse(self, peer: str, reason: str, now_s: float) -> Outcome | None:
        """Takes a refusal, or the news that the link to `peer` is gone."""
        return self._answer(Line(peer, "refused", "refused", reason=reason[:MOST_LETTERS]), now_s)

    def tick(self, now_s: float) -> Outcome | None:
        """Closes the window once it is time. To be called after `window_s`, and after `patience_s`."""
        return self._close(now_s) if self._open and self._late(now_s) else None

    def failed(self, peer: str, reason: str, now_s: float) -> Outcome | None:
        """Takes the news that the hand-off to the chosen neighbour came to nothing; the next one's turn."""
        if self._open or peer != self._chosen or self._ended_s is not None:
            return None
        self._lines[peer] = replace(self._lines[peer], fate="failed", reason=reason[:MOST_LETTERS])
        return self._choose(now_s)

    def moved(self, peer: str, now_s: float) -> None:
        """Takes the news that the chosen neighbour owns the task."""
        if not self._open and peer == self._chosen and self._ended_s is None:
            self._ended_s = now_s

    def ledger(self, now_s: float) -> Ledger:
        """Returns the account as it stands at `now_s` (host time)."""
        ended_s = now_s if self._ended_s is None else self._ended_s
        if self._ended_s is None:
            outcome = "undecided"
        elif not self._chosen:
            outcome = "stayed"
        else:
            outcome = "dry run" if self.dry_run else "moved"
        return Ledger(
            task_id=str(self.request.task_id),
            source=self._source,
            asked_by=self._asked_by,
            cost=cost_text(self.request.cost),
            outcome=outcome,  # type: ignore[arg-type]  # mypy does not narrow the literals above
            winner=self._chosen,
            lines=tuple(self._explained(self._lines[peer]) for peer in self.asked if peer in self._lines),
            duration_s=ended_s - self._began_s,
            to=self._to,
            cause=self._cause,
        )

    def _answer(self, line: Line, now_s: float) -> Outcome | None:
        if line.peer not in self.asked:
            return None
        if not self._open or self._late(now_s):
            outcome = self._close(now_s) if self._open else None
            known = self._lines[line.peer]
            if known.answer == "silent":
                late = f"answered later than {self._waited_s:g} s"
                self._lines[line.peer] = Line(line.peer, "refused", "refused", line.cost, line.terms, late)
            return outcome
        # The first answer counts: one that comes again may be an old one.
        self._lines.setdefault(line.peer, line)
        return self._close(now_s) if len(self._lines) == len(self.asked) or self._late(now_s) else None

    @property
    def _waited_s(self) -> float:
        """How long a silent neighbour is waited for, as things stand."""
        has_bid = any(line.answer == "bid" for line in self._lines.values())
        return self._window_s if has_bid else self._patience_s

    def _late(self, now_s: float) -> bool:
        return now_s >= self._began_s + self._waited_s

    def _close(self, now_s: float) -> Outcome:
        self._open = False
        for peer in self.asked:
            silence = f"did not answer within {self._waited_s:g} s"
            self._lines.setdefault(peer, Line(peer, "silent", "silent", reason=silence))
        return self._choose(now_s)

    def _choose(self, now_s: float) -> Outcome:
        bids = sorted((line.cost, peer) for peer, line in self._lines.items() if line.fate == "lost")
        if not bids:
            self._chosen = ""
            self._ended_s = now_s
            return Exhausted(NoCandidate(self._sentence()))
        self._chosen = bids[0][1]
        self._lines[self._chosen] = replace(self._lines[self._chosen], fate="won")
        if self.dry_run:
            self._ended_s = now_s
            return Exhausted(None)
        return Awarded(self._chosen)

    def _explained(self, line: Line) -> Line:
        if line.fate != "lost" or not self._chosen:
            return line
        best = self._lines[self._chosen].cost
        why = "has the same cost and a lower name" if best == line.cost else "is cheaper"
        return replace(line, reason=f"{self._chosen} {why}")

    def _sentence(self) -> str:
        name = self.request.task_id.name
        if self.asked:
            reasons = "; ".join(f"{peer}: {self._lines[peer].reason}" for peer in self.asked)
            return f"no neighbour can take {name}: {reasons}"
        if self._to == self._source:
            return f"{name} is on {self._to} already: name another agent"
        if self._to:
            hint = hint_of(self._to, self._known)
            return f"no neighbour can take {name}: {self._to} is no neighbour that hosts tasks{hint}"
        return f"no neighbour can take {name}: there is no neighbour that hosts tasks"
