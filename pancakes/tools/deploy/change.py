"""What a deployment changes of one agent: pure, from what is wanted and what its host says."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from pancakes.runtime.config.override import apply_set
from pancakes.runtime.config.toml_source import tables_of, text_of
from pancakes.runtime.config.toml_text import document_text
from pancakes.tools.deploy.supply import Supply
from pancakes.tools.deploy.wheels import PIP, digests, distribution_of_file, version_of_file
from pancakes.tools.launch.hosts import HostedAgent
from pancakes.tools.launch.member import Member


@dataclass(frozen=True)
class AgentChange:
    """One agent, as it is and as it is to be.

    Attributes:
        name, fleet, host: which it is, and where.
        version: the version that it is to have.
        environment: the environment of that.
        config: the configuration of that, as TOML.
        was: the version that it has; empty: none.
        last: the one that it had before that; empty: none.
        ran: whether it runs, kept so by a manager.
        changed: what is another than in the version that it has, for people.
        edited: a clause about what a person has changed on its host; empty: nothing.
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


def change_of(member: Member, told: HostedAgent, supply: Supply) -> AgentChange:
    """Returns what is to be changed of an agent.

    Args:
        member: the agent.
        told: what its host says of it (`pancakes.tools.there.looking`).
        supply: what is brought to its host.
    """
    config = effective_config(member.path, member.sets)
    digest = digest_of(config)
    base = f"{supply.build.partition('-')[0]}-{digest_of(supply.environment, config)[:12]}"
    now, kept = told["version"], told["versions"]
    # A file that was edited over there makes the version another one, whatever it is called.
    is_same = (
        now in series(base, {*kept, now}) and told["config"] == digest and told["environment"] == supply.environment
    )
    free = next(it for it in series(base, {*kept, now}) if it != now and kept.get(it, digest) == digest)
    service = told["service"]
    return AgentChange(
        member.name,
        member.config.agent.fleet,
        member.host,
        now if is_same else free,
        supply.environment,
        config,
        now,
        told["last"],
        service is not None and service["state"] in ("active", "starting"),
        () if is_same or not now else tuple(_changed(told, supply, digest)),
        _edited(told),
    )


def digest_of(*texts: str) -> str:
    """Returns a digest of texts, as hosts make it of a file."""
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()


def series(base: str, used: Collection[str]) -> list[str]:
    """Returns the names that something may have: its own, and others, until one is not in use."""
    names = [base]
    while names[-1] in used or len(names) < 1 + sum(it.startswith(f"{base}.") for it in used):
        names.append(f"{base}.{len(names) + 1}")
    return names


def _edited(told: HostedAgent) -> str:
    """Returns a clause if the configuration over there is not the one that was brought; empty: it is."""
    brought = told["about"].get("config", "")
    if not told["version"] or not brought or brought == told["config"]:
        return ""
    what = "was edited" if told["config"] else "is gone or cannot be read"
    return f"its configuration {what} there since it was brought (versions/{told['version']}/agent.toml)"


def _changed(told: HostedAgent, supply: Supply, digest: str) -> Iterator[str]:
    """Yields what is another than in the version over there, for people."""
    before = {distribution_of_file(it): (it, seal) for it, seal in dict(told["about"].get("wheels") or {}).items()}
    after = {distribution_of_file(it): (it, seal) for it, seal in digests(supply.own).items()}
    for name in sorted({*before, *after} - {PIP} if before else ()):
        if name not in before:
            yield f"{name} is new"
        elif name not in after:
            yield f"{name} is gone"
        elif before[name] != after[name]:
            was, now = (version_of_file(it[name][0]) for it in (before, after))
            yield f"{name} {was} → {now}" if was != now else f"{name} {now} is another build"
    if told["about"].get("libraries") != supply.libraries:
        yield "libraries"
    if told["config"] != digest:
        yield "configuration"
    if told["environment"] != supply.environment:
        yield "environment"


def effective_config(path: Path, sets: tuple[str, ...]) -> str:
    """Returns an agent's file as TOML, with what a fleet file and the command line change of it.

    Raises:
        ConfigError: it cannot be read.
    """
    tables, places = tables_of(text_of(str(path)), str(path))
    if not sets:
        return text_of(str(path))
    for change in sets:
        apply_set(change, tables, places)
    return document_text(tables)
