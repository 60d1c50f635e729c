"""A fleet of processes that is left alone: do all agents find each other, and does no link end?"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from soak.agents import Fleet, NotInTime, bytes_sent, names_of
from soak.vitals import processor_s, vitals_of

STARTS_WITHIN_S: Final = 60.0
MEETS_WITHIN_S: Final = 5.0
"""After the last agent listens, all are to be connected with all."""
LOOK_S: Final = 1.0


@dataclass
class Outcome:
    """What was found.

    Attributes:
        agents: how many there were.
        started_s: how long it took until the last said that it is ready.
        met_s: how much longer, until each was connected with each.
        processor_ms: processor time of one agent in one second, in the mean.
        sent_bytes: what one agent sends in one second, without the headers of TCP and IP, in the mean.
        memory_kib: proportional memory of one agent, in the mean.
        faults: a sentence for each thing that must not be; none: it has passed.
    """

    agents: int
    started_s: float = 0.0
    met_s: float = 0.0
    processor_ms: float = 0.0
    sent_bytes: float = 0.0
    memory_kib: float = 0.0
    faults: list[str] = field(default_factory=list)


def run(directory: Path, agents: int, duration_s: float, told: Callable[[str], None]) -> Outcome:
    """Starts so many agents at once, and watches them for a while.

    Args:
        directory: all files.
        agents: how many.
        duration_s: for how long, from the moment on at which all have met.
        told: takes a line for people, now and then.
    """
    outcome = Outcome(agents)
    with Fleet(directory, names_of(agents), {}) as fleet:
        try:
            fleet.start()
            outcome.started_s = fleet.until(fleet.all_ready, "all agents start", STARTS_WITHIN_S)
            outcome.met_s = fleet.until(fleet.is_full_mesh, "all agents meet", STARTS_WITHIN_S)
            told(f"{agents} agents: started in {outcome.started_s:.1f} s, all had met {outcome.met_s:.1f} s later")
            if outcome.met_s > MEETS_WITHIN_S:
                outcome.faults.append(f"all had met only after {outcome.met_s:.1f} s, not {MEETS_WITHIN_S:g} s")
            _watch(fleet, duration_s, outcome, told)
        except NotInTime as error:
            outcome.faults.append(str(error))
        outcome.faults += [f"{agent} lost {peer}: {reason}" for agent, peer, reason in fleet.ended_links()]
    return outcome


def _watch(fleet: Fleet, duration_s: float, outcome: Outcome, told: Callable[[str], None]) -> None:
    processes = [agent.process.pid for agent in fleet.alive() if agent.process is not None]
    sent, asked_s = bytes_sent(fleet)
    used_s, began_s = sum(map(processor_s, processes)), time.monotonic()
    told_s = began_s
    while (now_s := time.monotonic()) - began_s < duration_s:
        fleet.read()
        if fleet.dead():
            raise NotInTime(f"{', '.join(fleet.dead())} ended by itself")
        if now_s - told_s >= 60.0:
            told_s = now_s
            told(f"{now_s - began_s:.0f} s: {len(list(fleet.ended_links()))} links have ended; {fleet.missing()}")
        time.sleep(min(LOOK_S, max(0.0, began_s + duration_s - now_s)))
    used_s, took_s = sum(map(processor_s, processes)) - used_s, time.monotonic() - began_s
    outcome.processor_ms = 1000 * used_s / took_s / len(processes)
    sent_then, asked_then_s = bytes_sent(fleet)
    outcome.sent_bytes = (sent_then - sent) / (asked_then_s - asked_s) / len(processes)
    outcome.memory_kib = sum(vitals_of(pid).pss_kib for pid in processes) / len(processes)
    fleet.read()
    if not fleet.is_full_mesh():
        outcome.faults.append(f"in the end {fleet.missing()}")
