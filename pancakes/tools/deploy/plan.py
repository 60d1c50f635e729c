"""Plan a deployment: from the agents of a fleet file and the reports of their hosts to the changes on each host.

`plan_of` returns the plan, or raises one error with all obstacles; it changes nothing on a host. `check_configs` checks
the configurations on this machine, with the wheels to deploy. `change_of` plans the change of one agent, and is pure.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pancakes.agent.transport_settings import keyed_addresses
from pancakes.config import Config
from pancakes.config.toml_reader import self_contained
from pancakes.errors import PancakesError
from pancakes.tools.deploy.wheels import (
    CORE,
    PIP,
    Platform,
    Wheel,
    build_of,
    digests,
    distribution_of,
    distribution_of_file,
    extras_of,
    libraries_for,
    name_of,
    version_of_file,
)
from pancakes.tools.launch.fleet_file import Member
from pancakes.tools.launch.remote_hosts import Host, HostedAgent
from pancakes.util.plugins import Plugins
from pancakes.util.text import hint_of

MARGIN: Final = 1.1
"""How much more than the bytes of files is needed on a disk, as a factor."""


@dataclass(frozen=True)
class Supply:
    """What one host gets.

    Attributes:
        host: the host.
        build: the build of Pancakes and its plug-ins.
        environment: the name of the environment that is made of it.
        own: the wheels of Pancakes and its plug-ins, and pip's.
        libraries: the name of the folder with their dependencies.
        others: the wheels that are unpacked in that folder, and pip's.
        missing: the wheels that must be sent.
        damaged: files of the host's environment that were changed by hand, so that a new one is made.
    """

    host: Host
    build: str
    environment: str
    own: Sequence[Wheel]
    libraries: str
    others: Sequence[Wheel]
    missing: Sequence[Wheel]
    damaged: Sequence[str] = ()

    @property
    def brought_bytes(self) -> int:
        """How many bytes are sent."""
        return sum(wheel.path.stat().st_size for wheel in self.missing)

    def shortage(self) -> str:
        """Return a sentence if the host's disk has too little room; empty if it has enough."""
        unpacked = 0
        if self.environment not in self.host.is_["environments"]:
            unpacked += sum(wheel.unpacked_bytes for wheel in self.own)
        if self.libraries not in self.host.is_["libraries"]:
            unpacked += sum(wheel.unpacked_bytes for wheel in self.others)
        needed, free = MARGIN * (self.brought_bytes + unpacked), self.host.is_["free_bytes"]
        if free >= needed:
            return ""
        left, wanted = (f"{value / 1e6:.0f} MB" for value in (free, needed))
        disk = f"its disk ({self.host.is_['data']})"
        return f"{self.host.name} has {left} left on {disk} and needs {wanted}: make room there"


def needed_extras(config: Config, has_keys: bool, plugins: Plugins) -> list[str]:
    """Return the extras that the configuration of an agent needs.

    Args:
        config: the configuration.
        has_keys: whether the host has keys of the agent.
        plugins: where its transports are found.
    """
    network = config.services.get("network")
    settings = network.settings if network is not None else {}
    named = bool(settings.get("keys"))
    keyed = bool(keyed_addresses(config.agent, plugins)) and not settings.get("insecure")
    needed = {
        "keys": has_keys or named or keyed,  # an agent with keys but without this extra ignores revocations
        "mdns": config.agent.mdns,
        "metrics": any(service.type == "metrics" for service in config.services.values()),
        "otel": any(service.type == "traces" for service in config.services.values()),
        "record": config.record is not None,
    }
    return [extra for extra, is_needed in needed.items() if is_needed]


@dataclass(frozen=True)
class AgentChange:
    """The planned change of one agent.

    Attributes:
        name: the agent.
        fleet: its fleet.
        host: its host.
        version: its new version.
        environment: the environment of the new version.
        config: the configuration of the new version, as TOML.
        was: its present version; empty: none.
        last: the version before the present one; empty: none.
        ran: whether a service manager runs it now.
        changed: what differs between the present and the new version, for people.
        edited: a clause about what a person has edited on its host; empty: nothing.
    """

    name: str
    fleet: str
    host: str
    version: str
    environment: str
    config: str
    was: str
    last: str
    ran: bool
    changed: tuple[str, ...] = ()
    edited: str = ""

    @property
    def what(self) -> str:
        """What is done: `nothing`, `start`, `switch`, or `new`."""
        if self.was == self.version:
            return "nothing" if self.ran else "start"
        return "switch" if self.was else "new"


def change_of(member: Member, hosted: HostedAgent, supply: Supply) -> AgentChange:
    """Plan the change of an agent.

    Args:
        member: the agent.
        hosted: its host's report on it (`pancakes.tools.remote_host.host_probe`).
        supply: what its host gets.
    """
    config = effective_config(member.path, member.sets)
    digest = digest_of(config)
    base = f"{supply.build.partition('-')[0]}-{digest_of(supply.environment, config)[:12]}"
    now, kept = hosted["version"], hosted["versions"]
    # If its file was edited on the host, the version differs, even if its name is the same.
    is_same = (
        now in series(base, {*kept, now}) and hosted["config"] == digest and hosted["environment"] == supply.environment
    )
    free = next(it for it in series(base, {*kept, now}) if it != now and kept.get(it, digest) == digest)
    service = hosted["service"]
    return AgentChange(
        member.name,
        member.config.agent.fleet,
        member.host,
        now if is_same else free,
        supply.environment,
        config,
        now,
        hosted["last"],
        service is not None and service["state"] in ("active", "starting"),
        () if is_same or not now else tuple(_changed(hosted, supply, digest)),
        _edited(hosted),
    )


def digest_of(*texts: str) -> str:
    """Return the digest of texts; for one text, the same as a host's digest of a file with it."""
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()


def series(base: str, used: Collection[str]) -> list[str]:
    """Return the possible names of something: `base`, `base.2`, ..., up to the first that is not in use."""
    names = [base]
    while names[-1] in used or len(names) < 1 + sum(it.startswith(f"{base}.") for it in used):
        names.append(f"{base}.{len(names) + 1}")
    return names


def _edited(hosted: HostedAgent) -> str:
    """Return a clause if the configuration on the host differs from the deployed one; empty if not."""
    deployed = hosted["about"].get("config", "")
    if not hosted["version"] or not deployed or deployed == hosted["config"]:
        return ""
    what = "was edited" if hosted["config"] else "is missing or cannot be read"
    return f"its configuration {what} there since the last deployment (versions/{hosted['version']}/agent.toml)"


def _changed(hosted: HostedAgent, supply: Supply, digest: str) -> Iterator[str]:
    """Yield what differs from the host's present version, for people."""
    before = {distribution_of_file(it): (it, seal) for it, seal in dict(hosted["about"].get("wheels") or {}).items()}
    after = {distribution_of_file(it): (it, seal) for it, seal in digests(supply.own).items()}
    for name in sorted({*before, *after} - {PIP} if before else ()):
        if name not in before:
            yield f"{name} is new"
        elif name not in after:
            yield f"{name} is gone"
        elif before[name] != after[name]:
            was, now = (version_of_file(it[name][0]) for it in (before, after))
            yield f"{name} {was} → {now}" if was != now else f"{name} {now} is another build"
    if hosted["about"].get("libraries") != supply.libraries:
        yield "libraries"
    if hosted["config"] != digest:
        yield "configuration"
    if hosted["environment"] != supply.environment:
        yield "environment"


def effective_config(path: Path, sets: tuple[str, ...]) -> str:
    """Return an agent's file as TOML, with what it extends, and the changes of fleet file and command line.

    Raises:
        ConfigError: the file cannot be read.
    """
    return self_contained(str(path), sets)


PROGRAM: Final = """
import json, sys
from pancakes.errors import ConfigError
from pancakes.config import load
from pancakes.util.plugins import Plugins

plugins, faults = Plugins(), []
for path, sets in json.load(sys.stdin):
    try:
        load(path, sets, plugins)
    except ConfigError as error:
        faults += [str(fault) for fault in error.faults]
print(json.dumps(faults))
"""


def check_configs(members: Sequence[Member], own: Sequence[Wheel]) -> str:
    """Check the configurations of agents with the Pancakes and the plug-ins of some wheels.

    Args:
        members: the agents.
        own: the wheels of Pancakes and its plug-ins.

    Returns:
        Why this machine cannot check them, as a clause; empty: they were checked.

    Raises:
        PancakesError: some are invalid; the sentences name file, line and key.
    """
    with tempfile.TemporaryDirectory(prefix="pancakes-check-") as folder:
        for wheel in own:
            with zipfile.ZipFile(wheel.path) as archive:
                archive.extractall(folder)
        environment = {**os.environ, "PYTHONPATH": folder}
        asked = json.dumps([(str(member.path), member.sets) for member in members])
        done = subprocess.run(
            [sys.executable, "-P", "-c", PROGRAM], input=asked, capture_output=True, text=True, env=environment
        )
    try:
        faults: list[str] = json.loads(done.stdout)
    except ValueError:  # those wheels need libraries that this machine lacks
        return next((line for line in reversed(done.stderr.splitlines()) if line.strip()), "there is no output")
    if faults:
        raise PancakesError("\n".join([*dict.fromkeys(faults), "no host was changed"]))
    return ""


@dataclass(frozen=True)
class DeploymentPlan:
    """A planned deployment.

    Attributes:
        supplies: what each host gets, by host.
        changes: the agents, in the order in which they are switched.
    """

    supplies: Mapping[str, Supply]
    changes: Sequence[AgentChange]


def plan_of(
    members: Sequence[Member], hosts: Mapping[str, Host], own: Sequence[Wheel], extras: Sequence[str], upgrade: bool
) -> DeploymentPlan:
    """Plan a deployment, without changing a host.

    Args:
        members: the agents that have a host.
        hosts: their hosts.
        own: the wheels of Pancakes and its plug-ins.
        extras: extras of Pancakes to install, besides those that the configurations need.
        upgrade: whether to look for newer libraries instead of using those that were downloaded before.

    Raises:
        PancakesError: a host cannot take part; the sentences name all obstacles.
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
                by_platform[platform] = libraries_for(own, extras, platform, upgrade)
        except PancakesError as error:
            raise PancakesError(f"{name}: {error}") from None
        supplies[name] = _supply(host, own, by_platform[platform], platform)
    changes = [change_of(it, hosts[it.host].agent(it.name), supplies[it.host]) for it in members if it.host]
    return DeploymentPlan(supplies, changes)


def has_keys(member: Member, hosts: Mapping[str, Host]) -> bool:
    """Return whether the host of an agent has its keys."""
    return bool(hosts[member.host].agent(member.name)["keys"])


def _supply(host: Host, own: Sequence[Wheel], others: Sequence[Wheel], platform: Platform) -> Supply:
    build = build_of(own)
    version, python = build.partition("-")[0], f"py{platform.python}"
    own = [*own, *(wheel for wheel in others if distribution_of(wheel) == PIP)]
    made, folders, damaged = host.is_["environments"], host.is_["libraries"], []

    def intact(kind: str, base: str, existing: Collection[str]) -> str:
        """Return the name of an existing undamaged folder, or a free name."""
        names = series(base, existing)
        for name in names:
            if name in existing:
                if not (found := host.link.obtain("damaged", kind=list[str], folder=kind, name=name)):
                    return name
                damaged.extend(found)
        return next(name for name in names if name not in existing)

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
    """Raise if an agent was started by a person or a launcher: a deployment must not restart it."""
    problems = []
    for member in members:
        host = hosts[member.host]
        pid, service = host.runs(member), host.agent(member.name)["service"]
        if pid and (service is None or pid != service["pid"]):
            advice = "stop it first, with pancakes down FILE or its launcher"
            problems.append(
                f"{member.name} already runs on {host.name} (process {pid}), not from a deployment: {advice}"
            )
    if problems:
        raise PancakesError("\n".join(problems))
