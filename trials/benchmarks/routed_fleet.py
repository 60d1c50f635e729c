"""A fleet that is larger than a full mesh, at one Zenoh router: what it costs idle, and whether all talk arrives.

Each agent is a process with keys, its four services, and a task that waits; each keeps a few links (`[agent] links`).
Then each tenth one talks to another one at 10 Hz, to which it has no link in most cases. There is no baseline.
"""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from benchmarks.figure import Figure, Plan
from soak.agents import Fleet, NotInTimeError, names_of
from soak.tasks import TALK
from soak.vitals import processor_s, vitals_of
from zenoh_links.routers import Router

TITLE = "agents with a few links each, at one Zenoh router, all on this machine"
BESIDE = ""
AGENTS = 300
LINKS = 4
DISCOVERY_HZ = 0.1
SILENT_S = 10.0
"""As zenohd has it, of routers and agents."""
AT_ONCE = 10
"""So many are started together: each of them takes a second of a core."""
SETTLE_S = 60.0
"""So long they are left alone first: links that are too many end."""
SPAN_S = 20.0
TALK_S = 20.0
LAST_S = 10.0
"""So long what was said last may take."""
WITHIN_S = 900.0
PROCESSOR, MEMORY = 0.8, 20.0


def measure(plan: Plan) -> Iterator[Figure]:
    """Measures one fleet, once."""
    size = max(2 * LINKS, plan.share(AGENTS))
    met = Figure(f"{size} agents: from the first start until all have their links", "s")
    idle = Figure(f"{size} agents and the router, idle", "cores", wanted=PROCESSOR, absolute=True)
    each = Figure(f"{size} agents: CPU of one, idle", "ms/s")
    memory = Figure(f"{size} agents: memory of one, shared pages shared", "MB", wanted=MEMORY, absolute=True)
    links = Figure(f"{size} agents: links of one", "")
    lost = Figure(f"{size // 10} of them talk at 10 Hz: packets that did not arrive", "", wanted=0.0, absolute=True)
    p50, p99 = (Figure(f"{size // 10} of them talk at 10 Hz: on the way, {it}", "ms") for it in ("p50", "p99"))
    router = Router(more=("--silent", str(SILENT_S)))
    with tempfile.TemporaryDirectory(prefix="pancakes-bench-") as name:
        directory, names = Path(name), names_of(size)
        speakers = names[::10]
        hearers = {one: names[(names.index(one) + size // 2 + 1) % size] for one in speakers}
        zenoh = f"transports = {{ zenoh = {{ silent_s = {SILENT_S} }} }}"
        network = f"[service.network]\nsettings = {{ discovery_hz = {DISCOVERY_HZ}, {zenoh} }}\n"
        rest = dict.fromkeys(names, f"links = {LINKS}\n{network}")
        for one, other in hearers.items():
            rest[one] += f"[channel.{TALK}]\n[task.Talker]\ntype = 'soak.Talker'\nsettings = {{ to = '{other}', "
            rest[one] += f"while_there = '{directory / 'talk'}' }}\n"
        for other in set(hearers.values()):
            rest[other] += (
                f"[channel.{TALK}]\n[task.Listener]\ntype = 'soak.Listener'\n"
                f"settings = {{ file = '{directory}/{other}.heard' }}\n"
            )
        addresses = {one: f"zenoh://{one}:7400" for one in names}
        router.start()
        try:
            with Fleet(directory, names, rest, addresses=addresses) as fleet:
                fleet.environment["PANCAKES_ZENOH"] = router.address
                began_s = time.monotonic()
                for first in range(0, size, AT_ONCE):
                    fleet.start(*names[first : first + AT_ONCE])
                    fleet.until(partial(_have_links, fleet, min(LINKS, first + 1)), "all have links", WITHIN_S)
                met.runs.append(time.monotonic() - began_s)
                time.sleep(SETTLE_S)
                assert router.process is not None
                processes = [agent.process.pid for agent in fleet.alive() if agent.process is not None]
                began_s, agents_s, router_s = time.monotonic(), _all_s(processes), processor_s(router.process.pid)
                time.sleep(SPAN_S)
                agents_s, router_s = _all_s(processes) - agents_s, processor_s(router.process.pid) - router_s
                took_s = time.monotonic() - began_s
                idle.runs.append((agents_s + router_s) / took_s)
                each.runs.append(agents_s / took_s / size * 1e3)
                memory.runs.append(sum(vitals_of(pid).pss_kib for pid in processes) * 1024 / 1e6 / size)
                fleet.read()
                links.runs.append(sum(len(agent.links) for agent in fleet.alive()) / size)
                (directory / "talk").touch()
                time.sleep(TALK_S)
                (directory / "talk").unlink()
                time.sleep(LAST_S)
                heard, way_s = _heard(directory, set(hearers.values()))
        finally:
            router.end()
    if len(heard) < len(hearers):
        raise NotInTimeError(f"only {len(heard)} of {len(hearers)} speakers were heard")
    lost.runs.append(float(sum(last - count for last, count in heard.values())))
    p50.runs.append(1000 * way_s[len(way_s) // 2])
    p99.runs.append(1000 * way_s[len(way_s) * 99 // 100])
    yield from (met, idle, each, memory, links, lost, p50, p99)


def _all_s(processes: list[int]) -> float:
    return sum(map(processor_s, processes))


def _have_links(fleet: Fleet, enough: int) -> bool:
    return all(len(agent.links) >= enough for agent in fleet.alive())


def _heard(directory: Path, hearers: set[str]) -> tuple[dict[str, tuple[int, int]], list[float]]:
    """Returns the highest number and the count of what was heard of each speaker, and how long all took, sorted."""
    last: Counter[str] = Counter()
    count: Counter[str] = Counter()
    took_s: list[float] = []
    for hearer in hearers:
        for line in (directory / f"{hearer}.heard").read_text().splitlines():
            source, number, took = line.split()
            last[source] = max(last[source], int(number))
            count[source] += 1
            took_s.append(float(took))
    return {source: (last[source], count[source]) for source in count}, sorted(took_s)
