"""Judge tasks whose agents were killed by the tasks' own files, without asking the agents."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class Tally:
    """The tally of all kills.

    Attributes:
        kills: how many agents were killed.
        moves: how many migrations succeeded, by the tasks' own files.
        asked: how many requested migrations were answered with success.
        ticks: how often the tasks ticked.
        doubled: a sentence for each time that a task ran twice at once.
        lost: a sentence for each task that did not run after the recovery.
        backwards: a sentence for each time that a task ran with an epoch that had passed.
        worst_step_back: the most ticks that a task lost in a crash.
        longest_no_disk_s: the longest time that a trap kept an agent from writing.
        packets: how many packets to tasks had their effect.
        points: how many agents were killed at each point between effects, by its name.
        roads: how often connections failed, by kind.
        missed: a sentence for each point that no agent reached.
        heals_s: how long each recovery took.
    """

    kills: int = 0
    moves: int = 0
    asked: int = 0
    ticks: int = 0
    doubled: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    backwards: list[str] = field(default_factory=list)
    worst_step_back: int = 0
    longest_no_disk_s: float = 0.0
    packets: int = 0
    points: Counter[str] = field(default_factory=Counter)
    roads: Counter[str] = field(default_factory=Counter)
    missed: list[str] = field(default_factory=list)
    heals_s: list[float] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Add the tally of another fleet."""
        self.kills += other.kills
        self.moves += other.moves
        self.asked += other.asked
        self.ticks += other.ticks
        self.doubled += other.doubled
        self.lost += other.lost
        self.backwards += other.backwards
        self.worst_step_back = max(self.worst_step_back, other.worst_step_back)
        self.longest_no_disk_s = max(self.longest_no_disk_s, other.longest_no_disk_s)
        self.packets += other.packets
        self.points += other.points
        self.roads += other.roads
        self.missed += other.missed
        self.heals_s += other.heals_s

    def count(self, directory: Path, durability: Mapping[str, str]) -> None:
        """Read the files of the tasks.

        Args:
            directory: of their files: `NAME.count` has a line for each tick, with its number, the epoch, the agent and
                the process; `NAME.heard` one for each packet, with its number and the one that the task had heard
                before; `NAME.doubled` one for each time that it could not have its lock.
            durability: of each task, by its name.
        """
        for task, kind in durability.items():
            self.doubled += [f"{task}: {line}" for line in _lines(directory / f"{task}.doubled")]
            n = epoch = 0
            for line in _lines(directory / f"{task}.count"):
                now, under, agent, pid = line.split()
                if int(under) < epoch:
                    self.backwards.append(f"{task} ran on {agent} ({pid}) under {under}, after {epoch}")
                self.moves += max(0, int(under) - epoch)
                self.worst_step_back = max(self.worst_step_back, n - int(now))
                n, epoch = int(now), max(epoch, int(under))
                self.ticks += 1
            for line in _lines(directory / f"{task}.heard"):
                number, before = map(int, line.split())
                self.packets += 1
                if number <= before:
                    self.doubled.append(f"{task} heard packet {number} although its state held {before}")
                # Packets that a `lazy` task acknowledged after its last checkpoint do not come again.
                elif number > before + 1 and kind == "each":
                    self.lost.append(f"{task} heard packet {number} while its state held {before}")


def total(tallies: Iterable[Tally]) -> Tally:
    """Return the tally of several fleets."""
    whole = Tally()
    for tally in tallies:
        whole.add(tally)
    return whole


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.exists() else []
