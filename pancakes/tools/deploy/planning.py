"""From the agents of a fleet file and what their hosts say to a deployment, or to all that stands against it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from pancakes.errors import PancakesError
from pancakes.runtime.foundation.suggestion import hint_of
from pancakes.runtime.plugins import Plugins
from pancakes.tools.deploy.change import AgentChange, change_of, series
from pancakes.tools.deploy.needed_extras import needed_extras
from pancakes.tools.deploy.supply import Supply
from pancakes.tools.deploy.wheels import (
    CORE,
    PIP,
    Platform,
    Wheel,
    build_of,
    digests,
    distribution_of,
    extras_of,
    libraries_for,
    name_of,
)
from pancakes.tools.launch.hosts import Host
from pancakes.tools.launch.member import Member


@dataclass(frozen=True)
class DeploymentPlan:
    """What is to be done where.

    Attributes:
        supplies: what is brought, by host.
        changes: the agents, in the order in which they are switched.
    """

    supplies: Mapping[str, Supply]
    changes: Sequence[AgentChange]


def plan_of(
    members: Sequence[Member], hosts: Mapping[str, Host], own: Sequence[Wheel], extras: Sequence[str], anew: bool
) -> DeploymentPlan:
    """Returns what is to be done; nothing is changed on a host.

    Args:
        members: the agents that have a host.
        hosts: their hosts.
        own: the wheels of Pancakes and its plug-ins.
        extras: those of Pancakes that are installed with it, beside those that the configurations need.
        anew: whether newer libraries are looked for than those that were fetched before.

    Raises:
        PancakesError: a host cannot take part; the sentences say all that stands against it.
    """
    _check_extras(own, extras)
    _check_running(members, hosts)
    plugins = Plugins()
    needed = [it for member in members for it in needed_extras(member.config, has_keys(member, hosts), plugins)]
    extras = sorted({*extras, *needed})
    by_platform: dict[Platform, list[Wheel]] = {}
    supplies: dict[str, Supply] = {}
    for name, host in hosts.items():
        try:
            platform = Platform.of(host.is_["python"], host.is_["platform"], host.is_["libc"])
            if platform not in by_platform:
                by_platform[platform] = libraries_for(own, extras, platform, anew)
        except PancakesError as error:
            raise PancakesError(f"{name}: {error}") from None
        supplies[name] = _supply(host, own, by_platform[platform], platform)
    changes = [change_of(it, hosts[it.host].agent(it.name), supplies[it.host]) for it in members if it.host]
    return DeploymentPlan(supplies, changes)


def has_keys(member: Member, hosts: Mapping[str, Host]) -> bool:
    """Returns whether there are keys of an agent on its host."""
    return bool(hosts[member.host].agent(member.name)["keys"])


def _supply(host: Host, own: Sequence[Wheel], others: Sequence[Wheel], platform: Platform) -> Supply:
    build = build_of(own)
    version, python = build.partition("-")[0], f"py{platform.python}"
    own = [*own, *(wheel for wheel in others if distribution_of(wheel) == PIP)]
    made, folders, damaged = host.is_["environments"], host.is_["libraries"], []

    def intact(kind: str, base: str, there: Collection[str]) -> str:
        """Returns the name of what is there and as it was made, or else one that is free."""
        names = series(base, there)
        for name in names:
            if name in there:
                if not (found := host.link.obtain("damaged", kind=list[str], folder=kind, name=name)):
                    return name
                damaged.extend(found)
        return next(name for name in names if name not in there)

    libraries = intact("libraries", name_of(python, *platform.tags[:1], wheels=others), folders)
    environment = intact("environments", name_of(f"{version}-{python}", libraries, wheels=own), made)
    needed = {wheel.name: wheel for wheel in (*own, *(others if libraries not in folders else ()))}
    lacks = set()
    if environment not in made:
        lacks = set(host.link.obtain("missing", kind=list[str], wheels=digests(needed.values())))
    missing = [wheel for name, wheel in needed.items() if name in lacks]
    return Supply(host, build, environment, own, libraries, others, missing, damaged)


def _check_extras(own: Sequence[Wheel], extras: Sequence[str]) -> None:
    (core,) = [wheel for wheel in own if distribution_of(wheel) == CORE]
    known = extras_of(core)
    for extra in extras:
        if extra not in known:
            raise PancakesError(f"Pancakes has no extra {extra!r}{hint_of(extra, known)}: {', '.join(known)}")


def _check_running(members: Sequence[Member], hosts: Mapping[str, Host]) -> None:
    """An agent that a person or a launcher has started is none that may be restarted here."""
    problems = []
    for member in members:
        host = hosts[member.host]
        pid, service = host.runs(member), host.agent(member.name)["service"]
        if pid and (service is None or pid != service["pid"]):
            advice = "end it first, with pancakes down --fleet-file or its launcher"
            problems.append(f"{member.name} runs on {host.name} already (process {pid}), not by a deployment: {advice}")
    if problems:
        raise PancakesError("\n".join(problems))
