"""What `pancakes doctor` looks at in the clocks of agents that run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

from pancakes.tools.cli.verbs.finding import Finding

DAY_S: Final = 1.0
"""Times of day that are further apart than this are named."""
ASKED_S: Final = 5.0
"""An answer may be on its way for so long: the time of day of this machine tells no less than that."""
MISSION_S: Final = 1.0
"""Missions that are further apart than this are named, in mission time."""
DRIFT: Final = 0.01
"""A clock that gains or loses more than this share is named."""
LEASE_DRIFT: Final = 0.05
"""Leases of guarded tasks rest on clocks that differ by less than this."""
UNITS: Final = (("year", 365.25 * 86_400), ("day", 86_400.0), ("hour", 3600.0), ("minute", 60.0))
HERE: Final = "this machine"


def check_clocks(agents: Sequence[dict[str, Any]], now_s: float) -> Iterator[Finding]:
    """Looks at clocks: times of day that differ or were never set, rates, and mission times.

    An agent is named where more than half of those that know its clock say that it is off; where there are two that
    disagree, and no third that knows better, both are.

    Args:
        agents: the result of `Describe` of each.
        now_s: the time of day here when they answered, in seconds since 1970.
    """
    for agent in agents:
        if agent["utc_s"] is None and agent["process"] is not None:
            text = f"{_on(agent)} has no time of day: its clock was never set since it was switched on"
            yield Finding("warning", agent["agent"], text, _set_clock(agent))
    days = _told(agents, "day_ahead_s")
    for agent in agents:
        if (utc_s := agent["utc_s"]) is not None:
            ahead_s = utc_s - now_s
            days.setdefault(agent["agent"], {})[HERE] = ahead_s if abs(ahead_s) > ASKED_S else 0.0
    by_name = {agent["agent"]: agent for agent in agents}
    for name, ahead_s, others in _off(days, DAY_S):
        if (agent := by_name[name])["utc_s"] is not None:
            text = f"the time of day of {_on(agent)} is {_apart(ahead_s)} that of {others}"
            yield Finding("warning", name, text, _set_clock(agent))
    for name, drift, others in _off(_told(agents, "drift"), DRIFT):
        agent, way = by_name[name], "gains" if drift > 0 else "loses"
        text = f"the clock of {_on(agent)} {way} {abs(drift):.1%} against that of {others}"
        advice = f"no crystal is so bad: see which clock its kernel uses (chronyc tracking, dmesg) on {_host(agent)}"
        if abs(drift) >= LEASE_DRIFT:
            text += ": guarded tasks are not safe there"
        yield Finding("error" if abs(drift) >= LEASE_DRIFT else "warning", name, text, advice)
    for name, ahead_s, others in _off(_told(agents, "mission_ahead_s"), MISSION_S):
        text = f"its mission is {_apart(ahead_s)} that of {others}"
        advice = f"restart {name}, where it is to be one mission: it goes on at the time of its fleet"
        yield Finding("warning", name, text, advice)


def _told(agents: Sequence[dict[str, Any]], what: str) -> dict[str, dict[str, float]]:
    """Returns what is told of each agent that was asked, by the agent that tells it."""
    told: dict[str, dict[str, float]] = {agent["agent"]: {} for agent in agents}
    for agent in agents:
        for peer in agent["mesh"]["peers"]:
            value = (peer["clock"] or {}).get(what)
            if value is not None and peer["name"] in told:
                told[peer["name"]][agent["agent"]] = value
    return told


def _off(told: dict[str, dict[str, float]], limit: float) -> Iterator[tuple[str, float, str]]:
    """Gives each agent that is off, by how much most say that it is, and the names of these."""
    for name, values in sorted(told.items()):
        off = {other: value for other, value in values.items() if abs(value) > limit}
        if 2 * len(off) > len(values):
            middle = sorted(off.values())[len(off) // 2]
            yield name, middle, _names(sorted(off, key=lambda other: (other == HERE, other)))


def _names(names: Sequence[str]) -> str:
    return " and ".join((", ".join(names[:-1]), names[-1])) if len(names) > 1 else names[0]


def _on(agent: dict[str, Any]) -> str:
    """Returns what has the clock of an agent, for people."""
    return f"{_host(agent)}, on which {agent['agent']} runs,"


def _host(agent: dict[str, Any]) -> str:
    process = agent["process"]
    return process["host"] if process is not None else agent["agent"]


def _set_clock(agent: dict[str, Any]) -> str:
    return f"timedatectl on {_host(agent)} shows whether it is synchronised; have chrony or systemd-timesyncd set it"


def _apart(seconds: float) -> str:
    """Returns how far apart two times are, for people, such as `3.0 days behind`."""
    long = f"{abs(seconds):.1f} s"
    for unit, length_s in UNITS:
        if abs(seconds) >= (0.95 if unit == "year" else 2.0) * length_s:
            long = f"{abs(seconds) / length_s:.1f} {unit}s"
            break
    return f"{long} {'ahead of' if seconds > 0 else 'behind'}"
