"""Run an undisturbed fleet of processes: do all agents find each other, and does no link end?"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from soak.agents import Fleet, NotInTimeError, bytes_sent, names_of
from soak.vitals import processor_s, vitals_of

STARTS_WITHIN_S: Final = 60.0
MEETS_WITHIN_S: Final = 5.0
"""How long all agents may take to connect with each other after the last one listens, in seconds."""
LOOK_S: Final = 1.0


@dataclass
class Outcome:
    """The result of a steady run.

    Attributes:
        agents: the number of agents.
        started_s: how long it took until the last one was ready.
        met_s: how much longer it took until all were connected with each other.
        processor_ms: mean processor time of one agent per second.
        sent_bytes: mean bytes that one agent sends per second, without the headers of TCP and IP.
        memory_kib: mean proportional memory of one agent.
        faults: a sentence for each fault; empty: the run has passed.
    """

    agents: int
    started_s: float = 0.0
    met_s: float = 0.0
    processor_ms: float = 0.0
    sent_bytes: float = 0.0
    memory_kib: float = 0.0
    faults: list[str] = field(default_factory=list)


def run(directory: Path, agents: int, duration_s: float, say: Callable[[str], None]) -> Outcome:
    """Start a number of agents at once, and watch them for a while.

    Args:
        directory: the folder for all files.
        agents: the number of agents.
        duration_s: how long to watch, from the moment at which all are connected.
        say: prints a line for people.
    """
    outcome = Outcome(agents)
    with Fleet(directory, names_of(agents), {}) as fleet:
        try:
            fleet.start()
            outcome.started_s = fleet.until(fleet.all_ready, "all agents start", STARTS_WITHIN_S)
            outcome.met_s = fleet.until(fleet.is_full_mesh, "all agents meet", STARTS_WITHIN_S)
            say(f"{agents} agents: started in {outcome.started_s:.1f} s, all connected {outcome.met_s:.1f} s later")
            if outcome.met_s > MEETS_WITHIN_S:
                outcome.faults.append(f"all were connected only after {outcome.met_s:.1f} s, not {MEETS_WITHIN_S:g} s")
            _watch(fleet, duration_s, outcome, say)
        except NotInTimeError as error:
            outcome.faults.append(str(error))
        outcome.faults += [f"{agent} lost {peer}: {reason}" for agent, peer, reason in fleet.ended_links()]
    return outcome


def _watch(fleet: Fleet, duration_s: float, outcome: Outcome, say: Callable[[str], None]) -> None:
    processes = [agent.process.pid for agent in fleet.alive() if agent.process is not None]
    sent, asked_s = bytes_sent(fleet)
    used_s, began_s = sum(map(processor_s, processes)), time.monotonic()
    said_s = began_s
    while (now_s := time.monotonic()) - began_s < duration_s:
        fleet.read()
        if fleet.dead():
            raise NotInTimeError(f"{', '.join(fleet.dead())} ended by itself")
        if now_s - said_s >= 60.0:
            said_s = now_s
            say(f"{now_s - began_s:.0f} s: {len(list(fleet.ended_links()))} links have ended; {fleet.missing()}")
        time.sleep(min(LOOK_S, max(0.0, began_s + duration_s - now_s)))
    used_s, took_s = sum(map(processor_s, processes)) - used_s, time.monotonic() - began_s
    outcome.processor_ms = 1000 * used_s / took_s / len(processes)
    sent_then, asked_then_s = bytes_sent(fleet)
    outcome.sent_bytes = (sent_then - sent) / (asked_then_s - asked_s) / len(processes)
    outcome.memory_kib = sum(vitals_of(pid).pss_kib for pid in processes) / len(processes)
    fleet.read()
    if not fleet.is_full_mesh():
        outcome.faults.append(f"at the end {fleet.missing()}")
