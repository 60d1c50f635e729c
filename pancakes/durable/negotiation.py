"""Bidding without its actors: whether an agent can take a task, and which bid wins. Pure.

`Capability` compares what a task needs with what an agent has. `Negotiation` collects the answers of the neighbours
and keeps the account. Once one neighbour has bid, the others have half a second; before that, silence is tolerated
longer, because a neighbour may have to import the task's class first. The cheapest bid wins, ties by name. If the
migration to it fails, the next bid wins. The task runs on meanwhile.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final

import msgspec
from msgspec.structs import replace

from pancakes.control import Refusal
from pancakes.durable.messages import Solicit
from pancakes.durable.record import TaskId
from pancakes.errors import NoCandidateError, RefusalCode
from pancakes.migration import Line, MigrationReport, cost_text, fault_of, fault_of_choice, names_of
from pancakes.util.text import hint_of

HOST_ROLE: Final = "agent"
"""The one role whose agents are asked to take a task: no simulated world, no terminal."""

BATTERY_MARGIN: Final = 0.10
"""A candidate's battery must lie at least this much above the level where the task would move on: no ping-pong."""

RESERVE_FACTOR: Final = 2.0
"""A candidate's reserve must be at least this many times the one at which the task would move on: likewise."""


class Capability(msgspec.Struct, frozen=True):
    """What an agent has to offer to one task, at the moment of asking.

    Attributes:
        role: its role on the mesh.
        devices: the types of its devices.
        version: the version of the distribution that the task's type comes from here; None: it is not known here.
        fault: why that type cannot be loaded, if it is installed; empty: it can, or is not.
        services: the services that run here and take tasks in.
        recorded: the service that has a record of the task here; empty: none has.
        holder: the task here that has the task's name, which runs, is stopped, or is about to arrive; None: none.
        costs: the cost functions that it knows.
        battery_level: what is left of its battery, 0 to 1; None: it has none.
        reserve_s: the seconds of its newest `reserve`; None: there has been none.
    """

    role: str = HOST_ROLE
    devices: tuple[str, ...] = ()
    version: str | None = None
    fault: str = ""
    services: tuple[str, ...] = ("client",)
    recorded: str = ""
    holder: TaskId | None = None
    costs: tuple[str, ...] = ("tasks",)
    battery_level: float | None = None
    reserve_s: float | None = None

    def refusal_of(self, request: Solicit) -> Refusal | None:
        """Returns why this agent cannot take the task, with all reasons in its text; None if it can.

        The code is that of the first reason: those that only another configuration changes come first.
        """
        reasons = [(code, text) for code, text in self._reasons(request) if text]
        return Refusal(reasons[0][0], "; ".join(text for _, text in reasons)) if reasons else None

    def _reasons(self, request: Solicit) -> tuple[tuple[RefusalCode, str], ...]:
        return (
            ("unsupported", "" if self.role == HOST_ROLE else f"is no host of tasks but in the role {self.role!r}"),
            ("unsupported", self._service(request)),
            ("unsupported", self._devices(request)),
            ("unsupported", self._type(request)),
            ("conflict", self._name(request)),
            ("unsupported", self._cost(request)),
            ("unable", self._battery(request)),
            ("unable", self._reserve(request)),
        )

    def _service(self, request: Solicit) -> str:
        if request.service not in self.services:
            there = f"only {', '.join(self.services)}" if self.services else "nor any other"
            return f"runs no service {request.service!r} that takes tasks in, {there}"
        if self.recorded not in ("", request.service):
            return f"has a record of {request.task_id} in its service {self.recorded!r}, not in {request.service!r}"
        return ""

    def _devices(self, request: Solicit) -> str:
        lacking = [device for device in request.requires if device not in self.devices]
        if not lacking:
            return ""
        kind = "device type" if len(lacking) == 1 else "device types"
        return f"lacks the {kind} {', '.join(lacking)}"

    def _type(self, request: Solicit) -> str:
        if self.version is None:
            return self.fault or f"knows no task type {request.type!r}"
        if not compatible(request.version, self.version):
            return f"has {request.type} in version {self.version}, not {request.version}"
        return ""

    def _name(self, request: Solicit) -> str:
        if self.holder in (None, request.task_id):
            return ""
        return f"has a task named {request.task_id.name} already ({self.holder})"

    def _cost(self, request: Solicit) -> str:
        unknown = [name for name in names_of(request.cost) if name not in self.costs]
        if unknown:
            kind = "cost function" if len(unknown) == 1 else "cost functions"
            return f"knows no {kind} {', '.join(repr(name) for name in unknown)}"
        return fault_of_choice(request.cost)

    def _battery(self, request: Solicit) -> str:
        level, below = self.battery_level, request.moves_on_below
        if level is None or below is None or level >= below + BATTERY_MARGIN:
            return ""
        return f"has {level:.0%} of its battery, too near to the {below:.0%} at which the task would move on"

    def _reserve(self, request: Solicit) -> str:
        least_s = request.least_reserve_s
        if least_s is None or "battery" not in self.devices:
            return ""  # what has no battery needs no dock
        if self.reserve_s is None:
            return "its reserve is not known: a task of the type energy.reserve tells it"
        if not self.reserve_s > 0.0:
            return f"must go to a dock itself: its reserve is {self.reserve_s:.0f} s"
        if self.reserve_s >= RESERVE_FACTOR * least_s:
            return ""
        return f"has a reserve of {self.reserve_s:.0f} s, too near to the {least_s:g} s at which the task would move on"


def compatible(offered: str, here: str) -> bool:
    """Returns whether a task of the version `offered` may be built from the version `here`.

    It may where both have the same number up to the first that is not 0, as semantic versioning promises.
    """
    return _line_of(offered) == _line_of(here)


def _line_of(version: str) -> tuple[str, ...]:
    line: list[str] = []
    for part in version.split("."):
        line.append(part)
        if part != "0":
            break
    return tuple(line)


MOST_TERMS: Final = 64
"""A bid has no more terms, ..."""
MOST_LETTERS: Final = 1000
"""... and no reason more letters: the accounts of moves are kept on disk."""


class Awarded(msgspec.Struct, frozen=True):
    """`peer` is to get the task: begin the migration, then say `failed` or `moved`."""

    peer: str


class Exhausted(msgspec.Struct, frozen=True):
    """No neighbour can take the task, or the request was only to know which could.

    Attributes:
        error: what to tell the asker; its message has each neighbour's reason. None after a dry run that
            found a candidate.
    """

    error: NoCandidateError | None


Outcome = Awarded | Exhausted


class Negotiation:
    """One asking for bids, until the task has moved or stays.

    Each method that may decide something returns an `Outcome`, or None if nothing is decided by it.

    Args:
        request: what is asked; sent to each of `asked` by the caller.
        source: as in `MigrationReport`.
        asked_by: the task or person that wants the move, for the ledger.
        neighbours: the neighbours in a role that hosts tasks.
        now_s: host time.
        to: the only neighbour to ask; empty: all.
        dry_run: compare, and move nothing.
        window_s: how long to wait for other answers once a bid has come, in host time.
        patience_s: how long to wait if none has.
        cause: as in `MigrationReport`.

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
        self.source = source
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
        """The neighbour that the migration is under way to, or that has the task; empty: none."""
        return self._chosen

    def begin(self, now_s: float) -> Outcome | None:
        """Begins. To be called before the answers come; decides at once if there is no neighbour to ask."""
        return None if self.asked else self._close(now_s)

    def bid(self, peer: str, cost: float, terms: Mapping[str, float], now_s: float) -> Outcome | None:
        """Takes a bid. One that cannot be compared counts as a refusal."""
        fault = fault_of(cost, terms)
        if len(terms) > MOST_TERMS or any(len(name) > MOST_LETTERS for name in terms):
            fault = f"it has more than {MOST_TERMS} terms, or too long a name"
        if fault:
            return self._answer(Line(peer, "refused", "refused", reason=f"its bid does not count: {fault}"), now_s)
        return self._answer(Line(peer, "bid", "lost", cost, dict(terms)), now_s)

    def refuse(self, peer: str, refusal: Refusal, now_s: float) -> Outcome | None:
        """Takes a refusal, or the news that the link to `peer` is gone."""
        return self._answer(_refused(Line(peer, "refused", "refused"), refusal), now_s)

    def tick(self, now_s: float) -> Outcome | None:
        """Closes the window once it is time. To be called after `window_s`, and after `patience_s`."""
        return self._close(now_s) if self._open and self._late(now_s) else None

    def failed(self, peer: str, refusal: Refusal, now_s: float) -> Outcome | None:
        """Takes the news that the migration to the chosen neighbour came to nothing; the next one's turn."""
        if self._open or peer != self._chosen or self._ended_s is not None:
            return None
        self._lines[peer] = _refused(replace(self._lines[peer], fate="failed"), refusal)
        return self._choose(now_s)

    def moved(self, peer: str, now_s: float) -> None:
        """Takes the news that the chosen neighbour owns the task."""
        if not self._open and peer == self._chosen and self._ended_s is None:
            self._ended_s = now_s

    def ledger(self, now_s: float) -> MigrationReport:
        """Returns the account as it stands at `now_s` (host time)."""
        ended_s = now_s if self._ended_s is None else self._ended_s
        if self._ended_s is None:
            outcome = "undecided"
        elif not self._chosen:
            outcome = "stayed"
        else:
            outcome = "dry run" if self.dry_run else "moved"
        return MigrationReport(
            task_id=str(self.request.task_id),
            source=self.source,
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
            return Exhausted(NoCandidateError(self._sentence()))
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
        if self._to == self.source:
            return f"{name} is on {self._to} already: name another agent"
        if self._to:
            hint = hint_of(self._to, self._known)
            linked = "" if self._known else f", nor is any other agent that runs tasks{UNLINKED}"
            return f"no neighbour can take {name}: {self._to} is not linked to {self.source}{linked}{hint}"
        return f"no neighbour can take {name}: no agent that runs tasks is linked to {self.source}{UNLINKED}"


UNLINKED: Final = " (are their addresses in `peers` of [agent]?)"


def _refused(line: Line, refusal: Refusal) -> Line:
    """Returns the line of a neighbour with why it did not get the task."""
    text = refusal.text[:MOST_LETTERS]
    return replace(line, reason=text, code=refusal.code, retry_after_s=refusal.retry_after_s)
