"""Sum up a recording in a few figures: what a reader wants to know first. Pure, except `verdict_beside`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from pancakes.tools.report.findings import Findings
from pancakes.tools.report.mission import DigestEntry, TaskMove
from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED

MOVED: Final = "moved"
TAKEN_OVER: Final = "taken over"
STAYED: Final = ("stayed", "fenced")
"""The outcomes of migrations that came to nothing."""
PASS: Final = "PASS"
SUMMARY: Final = "summary.json"
"""The file that a demo writes beside the folder of its recording."""
RECORDING: Final = "recording"
"""The name of that folder."""
LARGEST_SUMMARY: Final = 1024 * 1024
NEGLIGIBLE_S: Final = 1e-9
"""Lateness below this is rounding: in virtual time no tick is late."""


@dataclass(frozen=True)
class Verdict:
    """What a demo said of its mission.

    Attributes:
        word: `PASS` or `FAIL`.
        reasons: why it failed.
    """

    word: str
    reasons: tuple[str, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether the mission has passed."""
        return self.word == PASS


def verdict_beside(path: Path) -> Verdict | None:
    """Return the verdict that a demo wrote beside its recording; None: there is none, or it cannot be read.

    Args:
        path: the recording: a file, or a folder.
    """
    folder = path.resolve() if path.is_dir() else path.resolve().parent
    if folder.name != RECORDING:
        return None
    try:
        with (folder.parent / SUMMARY).open("rb") as file:
            found = codecs.json_decoder()(file.read(LARGEST_SUMMARY))
    except (OSError, *MALFORMED):
        return None
    word = found.get("verdict") if isinstance(found, dict) else None
    if not isinstance(word, str) or not word:
        return None
    reasons = found.get("reasons")
    kept = reasons if isinstance(reasons, list) else []
    return Verdict(word, tuple(str(reason) for reason in kept))


@dataclass(frozen=True)
class WorstLateness:
    """The largest lateness of a tick, and whose it was; `name` is the task, and the timer if the task has several."""

    lateness_s: float
    agent: str
    task: str
    timer: str
    name: str


@dataclass(frozen=True)
class Summary:
    """What a recording shows, in a few figures.

    Attributes:
        duration_s: from its first packet to its last, in mission time.
        agents: how many agents were recorded.
        moved: how many migrations took place.
        stayed: how many came to nothing.
        longest_pause_s: the longest time for which a task that migrated was paused, in mission time; None: unknown.
        worst: the largest lateness; None: no tick was late, or the recording has no figures of tasks.
        measured: whether the recording has figures of tasks.
        missed: how many ticks were missed.
        errors: how many errors and failures were logged, and agents lost.
        warnings: how many warnings were logged.
        lost: how many packets were lost: dropped from mailboxes and links, or given up because a handler failed.
        verdict: what a demo said of its mission; None: nothing.
        taken_over: how many of the migrations that took place were take-overs.
        lost_agents: the agents that were lost.
    """

    duration_s: float
    agents: int
    moved: int
    stayed: int
    longest_pause_s: float | None
    worst: WorstLateness | None
    measured: bool
    missed: int
    errors: int
    warnings: int
    lost: int
    verdict: Verdict | None = None
    taken_over: int = 0
    lost_agents: tuple[str, ...] = ()

    @classmethod
    def of(cls, findings: Findings, verdict: Verdict | None = None) -> Summary:
        """Sum up the findings of a recording."""
        rates, moves = findings.rates, findings.moves.moves
        moved = [move for move in moves if move.ledger.outcome == MOVED]
        late = max(rates.timers.values(), key=lambda it: it.lateness_max_s, default=None)
        worst = None
        if late is not None and late.lateness_max_s > NEGLIGIBLE_S:
            worst = WorstLateness(late.lateness_max_s, late.agent, late.task, late.timer, rates.name(late))
        grave = findings.events.grave
        warnings = sum(it.count for it in grave if it.kind == "warning")
        dropped = sum(it.total for it in rates.drops.values()) + sum(it.dropped for it in rates.links.values())
        return cls(
            findings.duration_s,
            len(findings.agents),
            len(moved),
            sum(move.ledger.outcome in STAYED for move in moves),
            longest_pause_s(moved),
            worst,
            rates.samples > 0,
            sum(timer.missed for timer in rates.timers.values()),
            sum(it.count for it in grave) - warnings,
            warnings,
            dropped + sum(rates.dead_letters.values()),
            verdict,
            sum(move.outcome == TAKEN_OVER for move in moves),
            tuple(dict.fromkeys(loss.agent for loss in findings.losses.losses)),
        )

    def plain(self) -> dict[str, Any]:
        """Return it as plain values."""
        return asdict(self)


def pause_s(move: TaskMove) -> float | None:
    """Return how long the task of a migration was paused, in mission time; None: this was not recorded."""
    if move.frozen_s is None or move.started_s is None:
        return None
    return move.started_s - move.frozen_s


def longest_pause_s(moves: Sequence[TaskMove]) -> float | None:
    """Return the longest pause of migrations; None: none was recorded."""
    longest = max((pause for move in moves if (pause := pause_s(move)) is not None), default=math.nan)
    return None if math.isnan(longest) else longest


def worst_entries(entries: Sequence[DigestEntry], most: int) -> list[DigestEntry]:
    """Return the log entries to show first: errors and failures before warnings, and then by time."""
    return sorted(entries, key=lambda it: (it.kind == "warning", it.t_s))[:most]
