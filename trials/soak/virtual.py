"""Run a large fleet in virtual time: all agents find each other, every task migrates once, and no link ends."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from soak.agents import names_of
from soak.tasks import Roamer

from pancakes.agent.agent import Agent
from pancakes.config import parse
from pancakes.control import Migrate
from pancakes.events import Event
from pancakes.packet import LOG, SYSCTRL, Packet, join, type_name
from pancakes.simulation.fleet import Fleet

MEETS_WITHIN_S: Final = 5.0
MOVES_WITHIN_S: Final = 10.0
FIRST_PORT: Final = 7400
FEW: Final = 100
"""A larger fleet gets beacons and heartbeats every 5 s, as its user would choose: with the defaults, two hundred agents
send 80,000 messages a second, which takes one thread longer than a second.
"""


@dataclass
class Outcome:
    """The result of a virtual run.

    Attributes:
        agents: the number of agents.
        links: the number of links, each counted at both ends.
        met_s: virtual time until all were connected with each other.
        moved: how many tasks have migrated to the next agent.
        wall_s: how long the run took on this machine.
        faults: a sentence for each fault; empty: the run has passed.
    """

    agents: int
    links: int = 0
    met_s: float = 0.0
    moved: int = 0
    wall_s: float = 0.0
    faults: list[str] = field(default_factory=list)


def run(agents: int, duration_s: float, seed: int, say: Callable[[str], None]) -> Outcome:
    """Start a number of agents at once, migrate the task of each to the next one, and watch them for a while.

    Args:
        agents: the number of agents.
        duration_s: the duration of the run, in virtual time.
        seed: the seed of the fleet.
        say: prints a line for people.
    """
    began_s = time.monotonic()
    outcome = Outcome(agents)
    names = names_of(agents)
    fleet = Fleet(seed, classes={"soak.Roamer": Roamer})

    def wall_s() -> float:
        return time.monotonic() - began_s

    for number, name in enumerate(names):
        config = parse(_config(name, number, agents), name)
        agent = fleet.start_config(config, settle=False, probe=False)
        agent.kernel.stream.tap(LOG, _watch(agent.agent, outcome))
    # Links are counted from events, once at each end: asking all agents after each step would cost more than the fleet.
    if not fleet.run_until(lambda: outcome.links >= agents * (agents - 1), MEETS_WITHIN_S):
        outcome.faults.append(f"not all were connected within {MEETS_WITHIN_S:g} s")
    outcome.met_s = fleet.now()
    gc.freeze()  # the present objects stay; scanning them again and again would take a third of the whole time
    say(f"{agents} agents were connected after {outcome.met_s:.3f} s of virtual time ({wall_s():.0f} s here)")
    for name, to in zip(names, [*names[1:], names[0]], strict=True):
        kernel = fleet.agents[name].kernel
        body = Migrate(f"client/Roamer-{name}", to=to)
        address = join(name, "client")
        packet = Packet(
            SYSCTRL, type_name(body), address, name, kernel.mission.now(), kernel.seq_of(address).take(), body
        )
        kernel.stream.publish(packet)
    fleet.run_for(MOVES_WITHIN_S)
    for name, to in zip(names, [*names[1:], names[0]], strict=True):
        homes = [other for other in names if fleet.agents[other].kernel.registry.get(f"{other}/client/Roamer-{name}")]
        outcome.moved += homes == [to]
        if homes != [to]:
            outcome.faults.append(f"the task of {name} is on {', '.join(homes) or 'no agent'}, and not on {to}")
    say(f"{outcome.moved} tasks have migrated ({wall_s():.0f} s here)")
    while fleet.now() < duration_s:
        fleet.run_for(min(60.0, duration_s - fleet.now()))
        say(f"{fleet.now():.0f} s of virtual time ({wall_s():.0f} s here)")
    if outcome.links != agents * (agents - 1):
        outcome.faults.append("at the end not all are connected with each other")
    outcome.wall_s = wall_s()
    fleet.close()
    gc.unfreeze()
    return outcome


def _config(name: str, number: int, agents: int) -> str:
    few = agents <= FEW
    discovery_hz, heartbeat_s = (1.0, 0.5) if few else (0.2, 5.0)
    peers = f'peers = ["tcp://127.0.0.1:{FIRST_PORT}"]' if number else ""
    return f"""
schema = 1
[agent]
name = "{name}"
listen = "tcp://127.0.0.1:{FIRST_PORT + number}"
{peers}
[clock]
join_s = 0
[service.network]
settings = {{discovery_hz = {discovery_hz}, heartbeat_s = {heartbeat_s}}}
[service.log]
settings = {{console = false}}
[task.Roamer-{name}]
type = "soak.Roamer"
"""


def _watch(agent: Agent, outcome: Outcome) -> Callable[[Packet], None]:
    def hear(packet: Packet) -> None:
        body = packet.body
        if not isinstance(body, Event) or outcome.wall_s:  # at the end, all agents stop
            return
        if body.kind == "peer_up":
            outcome.links += 1
        elif body.kind == "peer_down":
            outcome.links -= 1
            fields = body.fields
            outcome.faults.append(f"{packet.stamp_s:.3f} s: {agent.name} lost {fields['peer']}: {fields['reason']}")

    return hear
