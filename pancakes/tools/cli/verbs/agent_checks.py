"""Check running agents for `pancakes doctor`: entries, fleet, devices, peers, clocks, guards and fences.

A check takes the descriptions of agents, as plain values, and yields findings (`pancakes.tools.cli.verbs.checks`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

from pancakes import __version__
from pancakes.devices.health import share_of
from pancakes.durable.record import DISK_LOST, MOVED, OLD_COPY, WAITS
from pancakes.mesh.sockets import ADVICE
from pancakes.supervision.restart import tries
from pancakes.tools.cli.verbs.checks import (
    AGENT_CHECKS,
    FLEET_CHECKS,
    TASK_CHECKS,
    Facts,
    Finding,
    agent_check,
    fleet_check,
    task_check,
)

DEVICES: Final = "device"
"""The service whose tasks are the devices of an agent."""
MISSED_READINGS_SHARE: Final = 0.01
"""The largest share of missed readings of a device that is not reported."""


@task_check
def check_device(agent: str, task: dict[str, Any], facts: Facts) -> Iterator[Finding]:
    """Look for a device that is silent, or misses many readings."""
    about = f"{agent}/{task['task']}"
    readings = task.get("readings")  # only devices have it
    if readings is None or task["state"] != "running":
        return
    if readings["silent_s"] is not None:
        text = f"has had no reading for {readings['silent_s']:.0f} s"
        advice = "check that its hardware is connected and has power, and that the source of its readings is reachable"
        yield Finding("warning", about, text, advice)
    tries = readings["came"] + readings["missed"]
    if readings["missed"] > MISSED_READINGS_SHARE * tries:
        share = share_of(readings["missed"], tries)
        text = f"missed {readings['missed']} of {tries} readings or commands ({share}); the last one: {readings['why']}"
        yield Finding("warning", about, text, f"check its cables and settings: pancakes task info {about}")


@task_check
def check_filters(agent: str, task: dict[str, Any], facts: Facts) -> Iterator[Finding]:
    """Look for filters that keep an actuator in its safe hold, and for those that break."""
    about = f"{agent}/{task['task']}"
    for row in task.get("filters", ()) if task["state"] == "running" else ():
        if row["doing"] != "holds":
            continue
        broken = row["why"].startswith("failed: ")
        text = f"is held by its filter {row['filter']} for {row['for_s']:.0f} s: {row['why']}"
        advice = f"see docs/filters.md for what each reason means, and pancakes task info {about}"
        yield Finding("error" if broken else "warning", about, text, advice)


@agent_check
def check_halt(agent: dict[str, Any], facts: Facts) -> Iterator[Finding]:
    """Report an agent that is halted."""
    halt = agent.get("halt")
    if halt is None:
        return
    reason = f": {halt['reason']}" if halt["reason"] else ""
    text = f"is halted by {halt['by'].partition('/')[0]}{reason}. Its actuators are stopped"
    advice = "once it is safe for all of them to move: pancakes halt --end"
    yield Finding("warning", agent["agent"], text, advice)


@agent_check
def check_reserve(agent: dict[str, Any], facts: Facts) -> Iterator[Finding]:
    """Report a robot that cannot be charged, or that is too low to reach a dock."""
    reserve = agent.get("reserve")  # only robots that measure it
    if reserve is None:
        return
    advice = "see docs/energy.md for what each sentence means"
    if reserve["trouble"]:
        yield Finding("warning", agent["agent"], reserve["trouble"], advice)
    elif reserve["seconds"] < 0.0 and not reserve["charging"]:
        text = f"has {-reserve['seconds']:.0f} s less than it needs to reach {reserve['dock']} with its margin"
        yield Finding("warning", agent["agent"], text, "bring it to a dock, or charge it by hand")


@agent_check
def check_allocation(agent: dict[str, Any], facts: Facts) -> Iterator[Finding]:
    """Report tasks for which the newest round of the allocation has found no robot."""
    for task, reason in sorted(agent.get("unplaced", {}).items()):
        text = f"has {task}, and the allocation finds no robot for it: {reason}"
        advice = f"see what each robot bids: pancakes what-if allocate {agent['agent']}"
        yield Finding("warning", agent["agent"], text, advice)


IN_DOUBT: Final = "in doubt"
NEAR: Final = 0.9
"""The share of a bound at which a peer is reported, before the agent refuses it."""
_STORIES: Final = {
    IN_DOUBT: "tasks whose hand-off from {peer} is in doubt",
    "taken back": "marks of hand-offs that {peer} has withdrawn",
    "guarded": "checkpoints of tasks of {peer}, as their guardian",
    "removed": "marks of removed guarded tasks of {peer}",
}


@agent_check
def check_kept(agent: dict[str, Any], facts: Facts) -> Iterator[Finding]:
    """Look for peers that are near a bound, and for tasks that peers left behind when they went away."""
    name = agent["agent"]
    for row in agent.get("kept_of_peers", ()):
        peer, kind = row["peer"], row["kind"]
        away = kind == IN_DOUBT and peer not in agent["neighbours"]
        if row["share"] < NEAR and not away:
            continue
        story = _STORIES[kind].format(peer=peer)
        text = f"keeps {row['count']} {story} ({row['bytes'] / 2**20:.1f} MiB), {row['share']:.0%} of the limit"
        if away:
            text += f", and {peer} is away"
        yield Finding("warning", name, text, _advice(name, peer, kind))


def _advice(name: str, peer: str, kind: str) -> str:
    if kind == IN_DOUBT:
        return f"start {peer}; if it is gone for good: pancakes task forget-peer {name} {peer} --dry-run"
    return f"check whether {peer} invents tasks; if so, revoke it: pancakes keys revoke {peer} REASON"


DAY_S: Final = 1.0
"""The largest difference between times of day that is not reported."""
ASKED_S: Final = 5.0
"""The same against this machine's clock: an answer may take this long to arrive."""
MISSION_S: Final = 1.0
"""The largest difference between mission times that is not reported, in mission seconds."""
DRIFT: Final = 0.01
"""The largest share that a clock may gain or lose without a report."""
LEASE_DRIFT: Final = 0.05
"""Leases of guarded tasks are safe only if the rates of clocks differ by less than this share."""
UNITS: Final = (("year", 365.25 * 86_400), ("day", 86_400.0), ("hour", 3600.0), ("minute", 60.0))
HERE: Final = "this machine"


@fleet_check
def check_clocks(facts: Facts) -> Iterator[Finding]:
    """Look for wrong clocks: times of day that differ or were never set, rates, and mission times.

    An agent is reported if more than half of the agents that know its clock find it wrong. If only two agents know each
    other's clocks and disagree, both are reported.
    """
    agents = facts.agents
    for agent in agents:
        if agent["utc_s"] is None and agent["process"] is not None:
            text = f"{_on(agent)} has no time of day: its clock was not set since it was switched on"
            yield Finding("warning", agent["agent"], text, _set_clock(agent))
    days = _measured(agents, "day_ahead_s")
    for agent in agents:
        if (utc_s := agent["utc_s"]) is not None and facts.now_s is not None:
            ahead_s = utc_s - facts.now_s
            days.setdefault(agent["agent"], {})[HERE] = ahead_s if abs(ahead_s) > ASKED_S else 0.0
    by_name = {agent["agent"]: agent for agent in agents}
    for name, ahead_s, others in _off(days, DAY_S):
        if (agent := by_name[name])["utc_s"] is not None:
            text = f"the time of day of {_on(agent)} is {_apart(ahead_s)} that of {others}"
            yield Finding("warning", name, text, _set_clock(agent))
    for name, drift, others in _off(_measured(agents, "drift"), DRIFT):
        agent, verb = by_name[name], "gains" if drift > 0 else "loses"
        text = f"the clock of {_on(agent)} {verb} {abs(drift):.1%} against that of {others}"
        advice = f"no crystal drifts so much: check the clock source of {_host(agent)} (chronyc tracking, dmesg)"
        if abs(drift) >= LEASE_DRIFT:
            text += ": guarded tasks are not safe there"
        yield Finding("error" if abs(drift) >= LEASE_DRIFT else "warning", name, text, advice)
    for name, ahead_s, others in _off(_measured(agents, "mission_ahead_s"), MISSION_S):
        text = f"its mission time is {_apart(ahead_s)} that of {others}"
        advice = f"if they should share one mission, restart {name}: it continues at the mission time of its fleet"
        yield Finding("warning", name, text, advice)


def _measured(agents: Sequence[dict[str, Any]], key: str) -> dict[str, dict[str, float]]:
    """Return a figure of each agent's clock, by agent and by the agent that measured it."""
    measured: dict[str, dict[str, float]] = {agent["agent"]: {} for agent in agents}
    for agent in agents:
        for peer in agent["mesh"]["peers"]:
            value = (peer["clock"] or {}).get(key)
            if value is not None and peer["name"] in measured:
                measured[peer["name"]][agent["agent"]] = value
    return measured


def _off(measured: dict[str, dict[str, float]], limit: float) -> Iterator[tuple[str, float, str]]:
    """Yield each agent whose clock is off, the median of the offsets, and the names of those that measured them."""
    for name, values in sorted(measured.items()):
        off = {other: value for other, value in values.items() if abs(value) > limit}
        if 2 * len(off) > len(values):
            middle = sorted(off.values())[len(off) // 2]
            yield name, middle, _names(sorted(off, key=lambda other: (other == HERE, other)))


def _names(names: Sequence[str]) -> str:
    return " and ".join((", ".join(names[:-1]), names[-1])) if len(names) > 1 else names[0]


def _on(agent: dict[str, Any]) -> str:
    """Return the host of an agent, for people."""
    return f"{_host(agent)}, on which {agent['agent']} runs,"


def _host(agent: dict[str, Any]) -> str:
    process = agent["process"]
    return process["host"] if process is not None else agent["agent"]


def _set_clock(agent: dict[str, Any]) -> str:
    return f"see timedatectl on {_host(agent)}; let chrony or systemd-timesyncd synchronise it"


def _apart(seconds: float) -> str:
    """Return how far apart two times are, for people, such as `3.0 days behind`."""
    long = f"{abs(seconds):.1f} s"
    for unit, length_s in UNITS:
        if abs(seconds) >= (0.95 if unit == "year" else 2.0) * length_s:
            long = f"{abs(seconds) / length_s:.1f} {unit}s"
            break
    return f"{long} {'ahead of' if seconds > 0 else 'behind'}"


@task_check
def check_fences(agent: str, task: dict[str, Any], facts: Facts) -> Iterator[Finding]:
    """Look for tasks that an actuator refuses, because it has seen a higher epoch than their present one.

    A lower epoch is in order: the next command of the task raises it.
    """
    for row in facts.fences(agent, f"{DEVICES}/{task['task']}") if task["service"] == DEVICES else ():
        if row["obeyed"] is False and _epoch(row["seen"]) > _epoch(row["owner_has"]):
            text = (
                f"refuses {row['task_id']}, which {row['owner']} has under epoch {row['owner_has']}: it has seen epoch"
                f" {row['seen']}, brought by {row['brought_by']}"
            )
            name = f"{row['owner']}/{row['task_id'].partition('/')[2]}"
            advice = f"check that it runs only once, then: pancakes task recover {name}"
            yield Finding("error", row["actuator"], text, advice)


def _epoch(text: str) -> tuple[int, str]:
    number, _, minter = text.partition("@")
    return int(number), minter


@fleet_check
def check_guards(facts: Facts) -> Iterator[Finding]:
    """Look for guarded tasks that would be lost with their agents, or that are paused."""
    tasks: dict[str, list[dict[str, Any]]] = {}
    for row in facts.guards:
        tasks.setdefault(row["task_id"], []).append(row)
    for task_id, known in sorted(tasks.items()):
        newest = max(_number(row) for row in known)
        owners = [row for row in known if "guardians" in row and _number(row) == newest]
        name = task_id.partition("/")[2]
        if owners:
            yield from _check_owned(owners[0], known)
        elif not any(row["lease"] for row in known) and any(row["wanted"] for row in known):
            text = f"is run by no agent: its owner {known[0]['owner']} is silent"
            advice = f"see what can be done: pancakes task recover {known[0]['agent']}/{name}"
            yield Finding("error", task_id, text, advice)
        elif any(row["wanted"] for row in known):
            yield from _awaited(task_id, [row for row in known if row["lease"]])


def is_awaited(row: dict[str, Any]) -> bool:
    """Return whether a guardian only waits for the end of a lease: a living owner renews the lease much earlier."""
    return row["lease"] and row["silent_s"] > row["lease_left_s"]


def _awaited(task_id: str, leased: Sequence[dict[str, Any]]) -> Iterator[Finding]:
    """Report the leases that must end before a take-over; a guardian that was restarted waits a whole lease."""
    if not all(map(is_awaited, leased)):
        return
    names = ", ".join(f"{row['agent']} ({row['lease_left_s']:.0f} s)" for row in leased)
    text = f"is run by no agent that answers: guardians wait until the lease of {leased[0]['owner']} ends: {names}"
    yield Finding("warning", task_id, text, "wait: then another agent takes over, or the owner continues if it is back")


def _number(row: dict[str, Any]) -> int:
    return int(row["epoch"].partition("@")[0])


def _check_owned(owner: dict[str, Any], known: Sequence[dict[str, Any]]) -> Iterator[Finding]:
    about, guardians = f"{owner['agent']}/{owner['task_id'].partition('/')[2]}", owner["guardians"]
    silent = [name for name in guardians if name not in {row["agent"] for row in known}]
    if owner["wanted"] and not owner["permit_s"]:
        text = "is paused: more than half of its guardians do not answer"
        advice = f"see which of them: pancakes task guards; if they are gone for good: pancakes task recover {about}"
        yield Finding("error", about, text, advice)
    elif len(guardians) < owner["guard"]:
        text = f"has {len(guardians)} of the {owner['guard']} guardians that it needs: it would be lost with its agent"
        yield Finding("warning", about, text, "link its agent to more agents that may guard it, such as a witness")
    elif silent:
        text = f"has a guardian that does not answer: {', '.join(silent)}"
        yield Finding("warning", about, text, "check that it runs; after a minute another agent takes its place")
    yield from _check_machine(about, owner)


def _check_machine(about: str, owner: dict[str, Any]) -> Iterator[Finding]:
    if devices := ", ".join(owner.get("no_dead_man", ())):
        text = f"commands {devices}, whose hardware has no dead-man switch: it keeps its last command if its agent dies"
        yield Finding("warning", about, text, "see docs/writing-a-driver.md for what a dead-man switch must do")
    if steps := owner.get("clock_steps", 0):
        times = "once" if steps == 1 else f"{steps} times"
        text = f"was paused {times} because the time of day of {owner['agent']} was set forward"
        yield Finding("warning", about, text, "make sure that its clock is set before the agent starts")


MISSED_SHARE: Final = 0.01
"""The largest share of missed ticks of a task that is not reported."""


@fleet_check
def check_entries(facts: Facts) -> Iterator[Finding]:
    """Check the agents of this machine from outside: their names and processes."""
    entries = facts.entries
    for entry in entries:
        same = [other.pid for other in entries if (other.fleet, other.name) == (entry.fleet, entry.name)]
        if len(same) > 1 and entry.pid == same[0]:
            text = (
                f"{len(same)} agents of the fleet {entry.fleet} have this name: processes {', '.join(map(str, same))}"
            )
            yield Finding("error", entry.name, text, "end all but one of them")
        elsewhere = sorted({other.fleet for other in entries if other.name == entry.name})
        if len(elsewhere) > 1 and entry.fleet == elsewhere[0]:
            text = f"agents of the fleets {', '.join(elsewhere)} have this name"
            yield Finding("warning", entry.name, text, "name the fleet with --fleet, or an address with --at HOST:PORT")
        if is_suspended(entry.pid):
            text = f"its process {entry.pid} is suspended: it neither answers nor drives anything"
            yield Finding("error", entry.name, text, f"kill -CONT {entry.pid}")


def is_suspended(pid: int) -> bool:
    """Return whether a process was stopped by a signal, or by a debugger."""
    import psutil

    try:
        return psutil.Process(pid).status() in (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP)
    except psutil.Error:
        return False


@fleet_check
def check_silent(facts: Facts) -> Iterator[Finding]:
    """Report the agents that do not answer; one whose network sleeps is in order."""
    for sentence in facts.silent:
        if sentence in facts.asleep:
            yield Finding("ok", "agents", sentence)
        else:
            advice = "check whether it runs, and whether its process is suspended or its computer is unreachable"
            yield Finding("error", "agents", sentence, advice)


@agent_check
def check_unlinked(agent: dict[str, Any], facts: Facts) -> Iterator[Finding]:
    """Report an agent without a link to another agent of its fleet, though others run."""
    others = [it["agent"] for it in facts.agents if it["fleet"] == agent["fleet"] and it is not agent]
    networks = [it["state"] for it in agent["services"] if it["service"] == "network"]
    if others and not agent["neighbours"] and networks == ["running"]:
        text = f"has no link to another agent of its fleet ({', '.join(others)}): no task can migrate"
        advice = 'put an address of one of them into its file, or its own into theirs: [agent] peers = ["ADDRESS"]'
        yield Finding("warning", agent["agent"], text, advice)


@fleet_check
def check_versions(facts: Facts) -> Iterator[Finding]:
    """Look for agents of another version than this command."""
    versions = {agent["process"]["version"] for agent in facts.agents if agent["process"] is not None}
    if versions - {__version__}:
        text = f"agents run the versions {', '.join(sorted(versions))}, and this command is {__version__}"
        yield Finding("warning", "agents", text, "update them: tasks migrate only between equal versions")


def _in_order(agent: dict[str, Any]) -> Finding:
    """Return the finding for an agent without other findings."""
    running = sum(task["state"] == "running" for task in agent["tasks"])
    connected = len(agent["neighbours"])
    text = f"is ready, with {_count(running, 'task')} running and {_count(connected, 'neighbour')}"
    if few := agent["mesh"]["few"]:
        text += f" of {_count(few['known'], 'known agent')}"
    if routed := sum(peer["reach"] == "routers" for peer in agent["mesh"]["peers"]):
        text += f"; {_count(routed, 'link')} through routers"
    return Finding("ok", agent["agent"], text)


def _check_warnings(agent: dict[str, Any], findings: Sequence[Finding]) -> Iterator[Finding]:
    """Report recent warnings of an agent, unless a finding covers them."""
    in_error = {finding.about for finding in findings if finding.level == "error"}
    for line in agent.get("warnings", ()):
        if any(finding.text in line["text"] or line["text"] in finding.text for finding in findings):
            continue
        name, _, target = line["text"].partition(" ")[0].partition("/")
        if f"{name}/{target.rpartition('/')[2]}" in in_error:
            continue  # the warnings before the error describe the same fault
        times = f"{line['count']} times, last " if line["count"] > 1 else ""
        text = f"warned {times}{line['ago_s']:.0f} s ago: {line['text']}"
        advice = f"see what came before it: pancakes log --from {agent['agent']} --level warning"
        yield Finding("warning", line["source"], text, advice)


@agent_check
def check_roster(agent: dict[str, Any], facts: Facts) -> Iterator[Finding]:
    """Compare the roster of an agent with those of its fleet, and with that of this machine."""
    here = facts.rosters.get(agent["fleet"], 0)
    own, fault = agent["roster"], agent.get("roster_fault")
    if own is None:
        return
    others = max((it["roster"] or 0 for it in facts.agents if it["fleet"] == agent["fleet"]), default=0)
    if fault is not None and fault["number"] in (0, own):
        advice = "make room, or give its user write access; it tries again every minute"
        if fault["number"] == 0:
            advice = "install it, or use pancakes deploy; until then this agent accepts members that you revoke"
        yield Finding("error", agent["agent"], fault["text"], advice)
    elif fault is not None and fault["number"] > own:
        yield Finding("error", agent["agent"], fault["text"], "fix that: it accepts members that were revoked since")
    if own < others:
        text = f"has the roster {own} of its fleet, and others have the roster {others}"
        advice = "link it to an agent that has the newer one: it accepts members that were revoked since"
        yield Finding("warning", agent["agent"], text, advice)
    elif own < here:
        text = f"has the roster {own} of its fleet, and this machine has the roster {here}"
        advice = "try again in a minute; if it has not changed: pancakes keys sign --at HOST:PORT"
        yield Finding("warning", agent["agent"], text, advice)


@fleet_check
def check_builds(facts: Facts) -> Iterator[Finding]:
    """Report the builds that agents run, if they differ."""
    by_version: dict[str, list[str]] = {}
    for agent in facts.agents:
        if agent["process"] is not None:
            version = agent["process"].get("build") or agent["process"]["version"]
            by_version.setdefault(version, []).append(agent["agent"])
    if len(by_version) > 1:
        versions = "; ".join(f"{version} on {', '.join(names)}" for version, names in sorted(by_version.items()))
        advice = "install one version on all hosts: pancakes deploy FLEET"
        yield Finding("warning", "agents", f"agents of a fleet run different versions: {versions}", advice)


@fleet_check
def check_plugins(facts: Facts) -> Iterator[Finding]:
    """Report agents that lack a distribution with task types that other agents of their fleet have."""
    for agent in facts.agents:
        others = [other for other in facts.agents if other["fleet"] == agent["fleet"]]
        for name in sorted({it for other in others for it in other["plugins"]} - set(agent["plugins"])):
            owners = ", ".join(other["agent"] for other in others if name in other["plugins"])
            text = f"lacks the plug-in {name}, which {owners} has: tasks of this plug-in cannot migrate to it"
            advice = f"install {name} in the environment of {agent['agent']} (or use pancakes deploy), and restart it"
            yield Finding("warning", agent["agent"], text, advice)


@agent_check
def check_agent(agent: dict[str, Any], facts: Facts) -> Iterator[Finding]:
    """Check what an agent reports about itself as a whole."""
    name = agent["agent"]
    if not agent["ready"]:
        yield Finding("warning", name, "is not ready: its tasks are still starting", f"pancakes task list {name}")
    if fault := agent.get("journal_fault"):
        advice = "make room on that disk, or give its user write access; then the agent continues by itself"
        yield Finding("error", name, f"cannot save the state of its tasks: {fault}", advice)
    if (config := agent.get("config_file")) and config["changed"]:
        text = f"runs with an old configuration: {config['path']} was changed or removed since it started"
        advice = f"check the file with pancakes config check {config['path']}, and restart the agent"
        yield Finding("warning", name, text, advice)
    if agent["held"]:
        text = "its mission clock is held at 0, so its tasks do not act"
        yield Finding("warning", name, text, "the launcher must release it, as pancakes up does")
    if agent["insecure"]:
        text = f"uses {agent['insecure']} without keys: anyone who can reach it can read its packets and command it"
        yield Finding("warning", name, text, "run pancakes keys join, and remove insecure = true from its file")
    for why in agent["mesh"].get("near_only", ()):
        yield Finding("warning", name, f"is not reached from other machines: {why}", ADVICE)
    if agent["dead_letters"]:
        text = f"has {_count(agent['dead_letters'], 'dead letter')}: packets whose handlers failed"
        yield Finding("warning", name, text, f"see which and why: pancakes log --from {name} --level warning")


@agent_check
def check_services(agent: dict[str, Any], facts: Facts) -> Iterator[Finding]:
    """Look for services that do not run."""
    for service in agent["services"]:
        about = f"{agent['agent']}/{service['service']}"
        yield from _check_tries(about, "service", service)
        if service["state"] == "stopped" and service["reason"]:
            text = f"does not run, so its tasks do not run either: {service['reason']}"
            yield Finding("warning", about, text, f"to start it: pancakes service start {about}")


@agent_check
def check_peers(agent: dict[str, Any], facts: Facts) -> Iterator[Finding]:
    """Look for peers that are away, and for links that lose packets or are not encrypted."""
    name, mesh = agent["agent"], agent["mesh"]
    connected = {peer["name"] for peer in mesh["peers"]}
    asleep = {peer["name"] for peer in mesh["asleep"]}
    for known in mesh["addresses"]:
        if known["static"] and not known["rests"] and known["name"] not in connected | asleep:
            peer = f"{known['name']} at {known['address']}" if known["name"] else f"at {known['address']}"
            text = f"is not connected to its peer {peer}" + (f": {known['refused']}" if known["refused"] else "")
            advice = "start that agent, or correct peers in [agent]"
            if "certificate" in known["refused"]:
                advice = "see pancakes keys list, and enrol the peer again if it belongs to the fleet"
            yield Finding("warning", name, text, advice)
    for peer in mesh["peers"]:
        lost = sum(peer["dropped"].values())
        if lost and peer["role"] != "client":
            channels = ", ".join(f"{count} of {channel}" for channel, count in peer["dropped"].items())
            text = f"dropped {_count(lost, 'packet')} to {peer['name']}, which is too slow for them: {channels}"
            yield Finding("warning", name, text, "publish less often, or check the network between them")
        scheme = peer["remote"].partition("://")[0]
        if peer["reach"] in ("network", "routers") and not peer["encrypted"] and not agent["insecure"]:
            text = f"has a link to {peer['name']} over {scheme}://, which does not encrypt: others may read it"
            yield Finding("warning", name, text, "use an address with encryption: see pancakes agent info")
        if peer["refused"]:
            text = f"refused {_count(peer['refused'], 'packet')} of {peer['name']}, which may not send them"
            yield Finding("warning", name, text, f"see why: pancakes log --from {name} --level warning")


@task_check
def check_failures(agent: str, task: dict[str, Any], facts: Facts) -> Iterator[Finding]:
    """Look for a task that has failed."""
    yield from _check_tries(f"{agent}/{task['task']}", "task", task)


@task_check
def check_ownership(agent: str, task: dict[str, Any], facts: Facts) -> Iterator[Finding]:
    """Look for a task that does not run because another agent may have it."""
    about = f"{agent}/{task['task']}"
    if task["rest"] == "disputed":
        text = "is paused, because another agent owns it too: " + (task["reason"] or "see the log of both")
        yield Finding("error", about, text, f"choose the copy to keep: pancakes task recover {about}")
    if task.get("guarding", {}).get("copied"):
        text = f"is paused: the disk of {agent} is a copy, so the guardians decide which agent runs the task"
        yield Finding("error", about, text, f"if the guardians are gone: pancakes task recover {about}")
    rest, reason = task["rest"], task["reason"]
    if rest.startswith(WAITS):
        text = f"is not born yet: {reason}"
        yield Finding("warning", about, text, "start that agent, or correct peers in [agent]")
    elif rest == DISK_LOST:
        yield Finding("error", about, f"is not born: {reason}", f"see what can be done: pancakes task recover {about}")
    elif rest == OLD_COPY:
        advice = f"see what can be done: pancakes task recover {about}"
        yield Finding("error", about, f"is paused: {reason}", advice)
    elif rest.startswith(MOVED) and _is_lost(rest.removeprefix(MOVED), task["task"], facts):
        text = f"was given to {rest.removeprefix(MOVED)}, which answers and does not list it, nor does any other agent"
        yield Finding("error", about, text, f"see what can be done: pancakes task recover {about}")


def _is_lost(given_to: str, task: str, facts: Facts) -> bool:
    """Return whether no agent that answers lists a task, the one that it was given to among them."""
    rows = [row for it in facts.agents for row in it["tasks"] if row["task"] == task]
    answers = any(it["agent"] == given_to for it in facts.agents)
    return answers and all(row["rest"].startswith(MOVED) for row in rows)


@task_check
def check_load(agent: str, task: dict[str, Any], facts: Facts) -> Iterator[Finding]:
    """Look for a task that is stuck, misses ticks, or loses packets."""
    about = f"{agent}/{task['task']}"
    if task["state"] == "stuck":
        text = "was asked to stop, but its handler does not return"
        yield Finding("error", about, text, "restart its agent; a task that blocks for long must set blocking = True")
    ticks = task["ticks"] + task["missed"]
    if task["missed"] and task["missed"] > MISSED_SHARE * ticks:
        late = f"missed {task['missed']} of {ticks} ticks, and was up to {task['lateness_max_s']:.3g} s late"
        yield Finding("warning", about, late, f"lower its rate: pancakes task rate {about} HZ")
    described = facts.describe(agent, f"{task['service']}/{task['task']}") if task["dropped"] else None
    for read in described["reads"] if described is not None else ():
        if read["dropped"]:
            text = f"lost {_count(read['dropped'], 'packet')} on {read['channel']}: it reads more slowly than they come"
            yield Finding("warning", about, text, f"see its publishers: pancakes channel hz {agent}/{read['channel']}")


def _check_tries(about: str, noun: str, row: dict[str, Any]) -> Iterator[Finding]:
    """Report a task or a service that has failed; a device is a task."""
    when = tries(row)
    if row["state"] == "failed":
        text = f"was given up: {row['reason']}" + (f" ({when})" if when else "")
        yield Finding("error", about, text, f"fix that, then: pancakes {noun} start {about}")
    elif row.get("rest") == "failed":
        text = "does not run: it was given up before its agent was last started"
        advice = f"see the agent's earlier log for the reason; then: pancakes {noun} start {about}"
        yield Finding("error", about, text, advice)
    elif row.get("waits") and row["rest"] == "":
        advice = f"fix that, and it starts by itself; see pancakes {noun} info {about}"
        yield Finding("warning", about, f"does not run: {row['reason']}", advice)
    elif row["state"] == "restarting":
        advice = f"fix that; to try at once: pancakes {noun} start {about}"
        yield Finding("warning", about, f"{when or 'is restarting'}: {row['reason']}", advice)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def check_agents(facts: Facts) -> Iterator[Finding]:
    """Run all checks of agents."""
    for fleet_wide in FLEET_CHECKS:
        yield from fleet_wide(facts)
    for agent in facts.agents:
        findings: list[Finding] = []
        for of_agent in AGENT_CHECKS:
            findings += of_agent(agent, facts)
        for task in agent["tasks"]:
            for of_task in TASK_CHECKS:
                findings += of_task(agent["agent"], task, facts)
        findings += _check_warnings(agent, findings)
        yield from findings or [_in_order(agent)]
