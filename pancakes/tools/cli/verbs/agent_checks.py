"""What `pancakes doctor` looks at in agents that run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

from pancakes import __version__
from pancakes.mesh.migration.rest import DISK_LOST, OLD_COPY, WAITS
from pancakes.mesh.near_only import ADVICE
from pancakes.runtime.life.restart import tries
from pancakes.runtime.runtime_dir import RunningAgent
from pancakes.tools.cli.verbs.device_checks import check_device
from pancakes.tools.cli.verbs.finding import Finding
from pancakes.tools.cli.verbs.peer_checks import check_kept

MISSED_SHARE: Final = 0.01
"""A task that misses more than this share of its ticks is named."""

_NO_ROSTERS: Final[Mapping[str, int]] = {}

Ask = Callable[[str, str], Any]
"""Returns the detailed description of a task (an agent's name, `service/task`); None where there is none."""


def check_entries(entries: Sequence[RunningAgent]) -> Iterator[Finding]:
    """Looks at the agents of this machine from outside: their names and processes."""
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
            yield Finding("warning", entry.name, text, "say which you mean with --at HOST:PORT")
        if is_suspended(entry.pid):
            text = f"its process {entry.pid} is suspended: it neither answers nor drives anything"
            yield Finding("error", entry.name, text, f"kill -CONT {entry.pid}")


def is_suspended(pid: int) -> bool:
    """Returns whether a process was stopped by a signal, or by a debugger."""
    import psutil

    try:
        return psutil.Process(pid).status() in (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP)
    except psutil.Error:
        return False


def check_fleet(
    agents: Sequence[dict[str, Any]],
    silent: Sequence[str],
    ask: Ask,
    asleep: Sequence[str] = (),
    rosters: Mapping[str, int] = _NO_ROSTERS,
) -> Iterator[Finding]:
    """Looks at what agents say of themselves.

    Args:
        agents: the result of `Describe` of each.
        silent: a sentence for each that said nothing.
        ask: asks for more.
        asleep: those of the sentences whose agent had said that its network would sleep, which is as it should be.
        rosters: the number of the last roster that this machine has of each fleet.
    """
    for sentence in silent:
        if sentence in asleep:
            yield Finding("ok", "agents", sentence)
            continue
        advice = "see whether it runs, and whether its process is suspended or its computer is away"
        yield Finding("error", "agents", sentence, advice)
    versions = {agent["process"]["version"] for agent in agents if agent["process"] is not None}
    if versions - {__version__}:
        text = f"agents run the versions {', '.join(sorted(versions))}, and this command is {__version__}"
        yield Finding("warning", "agents", text, "update them: tasks move between equal versions only")
    yield from _check_builds(agents)
    yield from _check_plugins(agents)
    for agent in agents:
        findings = [
            *_check_roster(agent, agents, rosters.get(agent["fleet"], 0)),
            *_check_agent(agent),
            *_check_peers(agent),
            *check_kept(agent),
            *_check_tasks(agent, ask),
        ]
        findings += _check_warnings(agent, findings)
        yield from findings
        if not findings:
            running = sum(task["state"] == "running" for task in agent["tasks"])
            connected = len(agent["neighbours"])
            text = f"is ready, with {_count(running, 'task')} running and {_count(connected, 'neighbour')}"
            if few := agent["mesh"]["few"]:
                text += f" of {_count(few['known'], 'agent')} that it knows"
            if routed := sum(peer["reach"] == "routers" for peer in agent["mesh"]["peers"]):
                text += f"; {_count(routed, 'link')} through routers"
            yield Finding("ok", agent["agent"], text)


def _check_warnings(agent: dict[str, Any], findings: Sequence[Finding]) -> Iterator[Finding]:
    """Tells what an agent has warned of lately, unless a finding says so already."""
    in_error = {finding.about for finding in findings if finding.level == "error"}
    for line in agent.get("warnings", ()):
        if any(finding.text in line["text"] or line["text"] in finding.text for finding in findings):
            continue
        name, _, target = line["text"].partition(" ")[0].partition("/")
        if f"{name}/{target.rpartition('/')[2]}" in in_error:
            continue  # how it came to that, try by try
        times = f"{line['count']} times, last " if line["count"] > 1 else ""
        text = f"warned {times}{line['ago_s']:.0f} s ago: {line['text']}"
        advice = f"see what led to it: pancakes log --from {agent['agent']} --level warning"
        yield Finding("warning", line["source"], text, advice)


def _check_roster(agent: dict[str, Any], agents: Sequence[dict[str, Any]], here: int) -> Iterator[Finding]:
    """Compares the roster of an agent with those of its fleet, and with that of this machine."""
    own, fault = agent["roster"], agent.get("roster_fault")
    if own is None:
        return
    others = max((it["roster"] or 0 for it in agents if it["fleet"] == agent["fleet"]), default=0)
    if fault is not None and fault["number"] in (0, own):
        advice = "make room, or give its user the right to write there; it tries again each minute"
        if fault["number"] == 0:
            advice = "pancakes deploy brings it; until then this agent goes on to believe whom you revoke"
        yield Finding("error", agent["agent"], fault["text"], advice)
    elif fault is not None and fault["number"] > own:
        yield Finding("error", agent["agent"], fault["text"], "mend that: it believes what was revoked since")
    if own < others:
        text = f"goes by the roster {own} of its fleet, and others know the roster {others}"
        yield Finding("warning", agent["agent"], text, "link it to one that knows: it believes what was revoked since")
    elif own < here:
        text = f"goes by the roster {own} of its fleet, and this machine has the roster {here}"
        advice = "look again in a minute; if it stays so, pancakes fleet sign --tell HOST:PORT"
        yield Finding("warning", agent["agent"], text, advice)


def _check_builds(agents: Sequence[dict[str, Any]]) -> Iterator[Finding]:
    """Names the versions that agents run, where these differ."""
    by_version: dict[str, list[str]] = {}
    for agent in agents:
        if agent["process"] is not None:
            version = agent["process"].get("build") or agent["process"]["version"]
            by_version.setdefault(version, []).append(agent["agent"])
    if len(by_version) > 1:
        told = "; ".join(f"{version} on {', '.join(names)}" for version, names in sorted(by_version.items()))
        advice = "pancakes deploy FLEET brings one version to all of its hosts"
        yield Finding("warning", "agents", f"agents of a fleet run different versions: {told}", advice)


def _check_plugins(agents: Sequence[dict[str, Any]]) -> Iterator[Finding]:
    """Names the agents that lack a distribution with task types which others of their fleet have."""
    for agent in agents:
        others = [other for other in agents if other["fleet"] == agent["fleet"]]
        for name in sorted({it for other in others for it in other["plugins"]} - set(agent["plugins"])):
            having = ", ".join(other["agent"] for other in others if name in other["plugins"])
            text = f"lacks the plug-in {name}, which {having} has: no task of it can migrate there"
            advice = f"install {name} in the environment of {agent['agent']} (pancakes deploy does), and start it again"
            yield Finding("warning", agent["agent"], text, advice)


def _check_agent(agent: dict[str, Any]) -> Iterator[Finding]:
    name = agent["agent"]
    if not agent["ready"]:
        yield Finding("warning", name, "is not ready: its tasks are still starting", f"pancakes task list {name}")
    if fault := agent.get("journal_fault"):
        advice = "make room on that disk, or give its user the right to write there; it goes on by itself then"
        yield Finding("error", name, f"keeps nothing that its tasks do: {fault}", advice)
    if (config := agent.get("config_file")) and config["changed"]:
        text = f"runs with what {config['path']} said when it started: the file was changed, or is gone, since"
        advice = f"pancakes config check {config['path']}, and start the agent again"
        yield Finding("warning", name, text, advice)
    if agent["held"]:
        text = "its mission waits at 0, so nothing of it moves"
        yield Finding("warning", name, text, "it begins when its launcher says so, as pancakes launch does")
    if agent["insecure"]:
        text = f"speaks over {agent['insecure']} without keys: all that reach it can read what it says, and command it"
        yield Finding("warning", name, text, "pancakes fleet join, and take insecure = true out of its file")
    for why in agent["mesh"].get("near_only", ()):
        yield Finding("warning", name, f"is not reached from other machines: {why}", ADVICE)
    for service in agent["services"]:
        about = f"{name}/{service['service']}"
        yield from _check_tries(about, "service", service)
        if service["state"] == "stopped" and service["reason"]:
            text = f"does not run, and none of its tasks: {service['reason']}"
            yield Finding("warning", about, text, f"to start it: pancakes service start {about}")
    if agent["dead_letters"]:
        text = f"readers failed at {_count(agent['dead_letters'], 'packet')}, given up after that"
        yield Finding("warning", name, text, f"see which and why: pancakes log --from {name} --level warning")


def _check_peers(agent: dict[str, Any]) -> Iterator[Finding]:
    name, mesh = agent["agent"], agent["mesh"]
    connected = {peer["name"] for peer in mesh["peers"]}
    asleep = {peer["name"] for peer in mesh["asleep"]}
    for known in mesh["addresses"]:
        if known["static"] and not known["rests"] and known["name"] not in connected | asleep:
            peer = f"{known['name']} at {known['address']}" if known["name"] else f"at {known['address']}"
            text = f"is not connected to its peer {peer}" + (f": {known['refused']}" if known["refused"] else "")
            advice = "start that agent, or correct peers in [agent]"
            if "certificate" in known["refused"]:
                advice = "pancakes fleet list, and enrol it again if it is to belong to the fleet"
            yield Finding("warning", name, text, advice)
    for peer in mesh["peers"]:
        lost = sum(peer["dropped"].values())
        if lost and peer["role"] != "client":
            channels = ", ".join(f"{count} of {channel}" for channel, count in peer["dropped"].items())
            text = f"dropped {_count(lost, 'packet')} to {peer['name']}, which is too slow for them: {channels}"
            yield Finding("warning", name, text, "send less often, or look at the network between them")
        scheme = peer["remote"].partition("://")[0]
        if peer["reach"] in ("network", "routers") and not peer["encrypted"] and not agent["insecure"]:
            text = f"has a link to {peer['name']} over {scheme}://, which does not encrypt: others may read it"
            yield Finding("warning", name, text, "take an address whose way is encrypted: pancakes agent info")
        if peer["refused"]:
            text = f"refused {_count(peer['refused'], 'packet')} of {peer['name']}, which may not send them"
            yield Finding("warning", name, text, f"see why: pancakes log --from {name} --level warning")


def _check_tasks(agent: dict[str, Any], ask: Ask) -> Iterator[Finding]:
    name = agent["agent"]
    for task in agent["tasks"]:
        about = f"{name}/{task['task']}"
        yield from _check_tries(about, "task", task)
        yield from check_device(about, task)
        if task["rest"] == "disputed":
            text = "is owned by another agent too, and rests: " + (task["reason"] or "see the log of both")
            yield Finding(
                "error", about, text, f"pancakes task resolve AGENT/{task['task']} says which of the two lives"
            )
        yield from _check_unsure(about, task)
        if task.get("guarding", {}).get("copied"):
            text = f"stands still: the disk of {name} is a copy, so its guardians have an agent go on with the task"
            yield Finding("error", about, text, f"where they are gone: pancakes task revive {about}")
        if task["state"] == "stuck":
            text = "was asked to stop and does not come back from what it is doing"
            yield Finding("error", about, text, "restart its agent; a task that waits for long sets blocking = True")
        ticks = task["ticks"] + task["missed"]
        if task["missed"] and task["missed"] > MISSED_SHARE * ticks:
            late = f"missed {task['missed']} of {ticks} ticks, and was up to {task['lateness_max_s']:.3g} s late"
            yield Finding("warning", about, late, f"let it tick less often: pancakes task rate {about} HZ")
        if task["dropped"]:
            yield from _check_drops(name, about, ask(name, f"{task['service']}/{task['task']}"))


def _check_unsure(about: str, task: dict[str, Any]) -> Iterator[Finding]:
    """Looks at a task whose agent does not know whether it is elsewhere."""
    rest, reason = task["rest"], task["reason"]
    if rest.startswith(WAITS):
        text = f"is not born yet: {reason}"
        yield Finding("warning", about, text, "start that agent, or correct peers in [agent]")
    elif rest == DISK_LOST:
        advice = f"see where it is: pancakes task list; pancakes task forget {about} leaves it there"
        yield Finding("error", about, f"is not born: {reason}", advice)
    elif rest == OLD_COPY:
        yield Finding("error", about, f"stands still: {reason}", "see that those agents run, or decide yourself")


def _check_tries(about: str, noun: str, row: dict[str, Any]) -> Iterator[Finding]:
    """Looks at a task or a service that has failed; a device is a task."""
    when = tries(row)
    if row["state"] == "failed":
        text = f"was given up: {row['reason']}" + (f" ({when})" if when else "")
        yield Finding("error", about, text, f"mend that, then: pancakes {noun} start {about}")
    elif row.get("rest") == "failed":
        text = "does not run: it was given up before its agent was last started"
        advice = f"the agent's log from then says why (pancakes log); then: pancakes {noun} start {about}"
        yield Finding("error", about, text, advice)
    elif row.get("waits") and row["rest"] == "":
        advice = f"mend that: it starts once it can; pancakes {noun} info {about}"
        yield Finding("warning", about, f"does not run: {row['reason']}", advice)
    elif row["state"] == "restarting":
        advice = f"mend that; to try at once: pancakes {noun} start {about}"
        yield Finding("warning", about, f"{when or 'is started again'}: {row['reason']}", advice)


def _check_drops(agent: str, about: str, described: Any) -> Iterator[Finding]:
    for read in described["reads"] if described is not None else ():
        if read["dropped"]:
            text = f"lost {_count(read['dropped'], 'packet')} on {read['channel']}: it reads more slowly than they come"
            yield Finding("warning", about, text, f"see its publishers: pancakes channel hz {agent}/{read['channel']}")


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
