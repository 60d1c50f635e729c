"""Carry out a deployment: prepare all hosts, then switch one agent after the other; on a failure, roll all back.

Agents that need keys get them first, from the authority of their fleet (`enrol`).
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal, TypedDict

from pancakes.agent.transport_settings import keyed_addresses
from pancakes.errors import PancakesError, describe
from pancakes.security.key_store import FLEET, KEY, ROSTER
from pancakes.security.roster import CertifiedRole
from pancakes.tools.deploy.drain import AgentBefore, TaskMoves
from pancakes.tools.deploy.plan import AgentChange, Supply, digest_of
from pancakes.tools.deploy.wheels import digests
from pancakes.tools.launch.fleet_file import Member
from pancakes.tools.launch.remote_hosts import Host
from pancakes.tools.launch.ssh import HostLink
from pancakes.util.plugins import Plugins

if TYPE_CHECKING:
    from pancakes.security.authority import Authority


Need = Literal["has", "needs", "none"]


def keys_needed(members: Sequence[Member], hosts: Mapping[str, Host]) -> dict[str, Need]:
    """Return for each agent, by name, whether its host has keys, or it needs keys, or it needs none."""
    plugins = Plugins()
    found: dict[str, Need] = {}
    for member in members:
        network = member.config.services.get("network")
        settings = network.settings if network is not None else {}
        if hosts[member.host].agent(member.name)["keys"] or settings.get("keys"):
            found[member.name] = "has"
        else:
            needs = bool(keyed_addresses(member.config.agent, plugins)) and not settings.get("insecure")
            found[member.name] = "needs" if needs else "none"
    return found


def check_keys(members: Sequence[Member], needed: Mapping[str, Need]) -> None:
    """Check that no agent lacks keys.

    Raises:
        PancakesError: agents lack keys; the sentences name them, and say what to do.
    """
    problems = [
        f"{it.name} needs keys of the fleet {it.config.agent.fleet}, and {it.host} has none: use pancakes deploy"
        f" --enrol here, or pancakes keys join on {it.host}"
        for it in members
        if needed[it.name] == "needs"
    ]
    if problems:
        raise PancakesError("\n".join([*problems, "no host was changed"]))


def enrol(
    members: Sequence[Member],
    needed: Mapping[str, Need],
    hosts: Mapping[str, Host],
    authorities: Mapping[str, Authority],
    tell: Callable[[str, str], None],
) -> None:
    """Give keys to the agents that need them.

    Args:
        members: the agents.
        needed: see `keys_needed`.
        hosts: their hosts.
        authorities: the authorities of their fleets, by fleet.
        tell: reports a clause about an agent, to be read after its name.

    Raises:
        PancakesError: a host does not accept the keys.
    """
    for member in members:
        if needed[member.name] != "needs":
            continue
        agent = member.config.agent
        authority = authorities[agent.fleet]
        role: CertifiedRole = "environment" if agent.role == "environment" else "agent"
        before = [it for it in authority.entries if not it.revoked and it.who == f"{role}/{agent.name}"]
        files = authority.enrol_with_key(role, agent.name, before[-1].groups if before else ())
        sent = {ROSTER: files.roster, FLEET: files.authority, KEY: files.certificate + files.key}
        encoded = {name: b64encode(data).decode() for name, data in sent.items()}
        hosts[member.host].link.obtain("put_keys", fleet=agent.fleet, name=agent.name, files=encoded)
        again = "; its earlier certificate stays valid" if before else ""
        tell(member.name, f"has keys of the fleet {agent.fleet} on {member.host}, with a new certificate{again}")


LOCK_S: Final = 120.0
"""How long a host may take to finish the request of a lost connection, in seconds."""


class _Checked(TypedDict):
    """The answer of a host that has checked a configuration."""

    sound: bool
    said: str


@dataclass
class _Done:
    """How far the switch of one agent has got, so that it can be undone."""

    change: AgentChange
    before: AgentBefore = field(default_factory=AgentBefore)
    stopped: bool = False
    runs: bool = False


class Deployment:
    """One deployment.

    Args:
        supplies: what each host gets, by host.
        changes: the agents, in the order in which they are switched.
        moves: migrate the tasks, by fleet.
        tell: reports a clause about a host or an agent, to be read after its name. Any thread may call it.
        calm_s: how long the tasks of an agent must run before the next agent is switched, in seconds.
        called_off: returns whether a person has called the deployment off; checked between two steps.
    """

    def __init__(
        self,
        supplies: Mapping[str, Supply],
        changes: Sequence[AgentChange],
        moves: Mapping[str, TaskMoves],
        tell: Callable[[str, str], None],
        calm_s: float,
        called_off: Callable[[], bool],
    ) -> None:
        self._supplies = supplies
        self._links = {name: supply.host.link for name, supply in supplies.items()}
        self._changes = changes
        self._moves = moves
        self._tell = tell
        self._calm_s = calm_s
        self._called_off = called_off
        self._new_links: list[HostLink] = []

    def prepare(self) -> None:
        """Copy everything to all hosts and check it there, without touching anything that runs.

        Raises:
            PancakesError: a host cannot be prepared; the copied files are removed from all hosts.
        """
        shortages = [text for supply in self._supplies.values() if (text := supply.shortage())]
        if shortages:
            raise PancakesError("\n".join(shortages))
        try:
            self._everywhere(self._prepare)
        except BaseException:
            self.clean()
            raise

    def switch(self) -> None:
        """Switch one agent after the other.

        Raises:
            PancakesError: an agent does not run as it should; all agents were rolled back.
        """
        done: list[_Done] = []
        try:
            for change in self._changes:
                if change.what == "nothing":
                    self._tell(change.name, f"has the version {change.version} and runs")
                    for clause in self._moves[change.fleet].given_up(change.name):
                        task = clause.partition(" ")[0]
                        self._tell(change.name, f"does not run {clause} (pancakes task start {change.name}/{task})")
                    continue
                done.append(_Done(change))
                self._exchange(done[-1])
            self._all_back()
        except BaseException as error:
            what = str(error) if isinstance(error, PancakesError) else f"the deployment failed: {describe(error)}"
            raise PancakesError("\n".join([what, *self._undo(done)])) from None
        finally:
            self.clean()
            for link in self._new_links:
                link.close()

    def clean(self) -> None:
        """Remove from all hosts the files that no version needs."""
        for link in self._links.values():
            with suppress(PancakesError):  # a host that cannot be reached keeps its files
                link.obtain("clean")

    def _check_called_off(self) -> None:
        """Raise if a person has called the deployment off."""
        if self._called_off():
            raise PancakesError("the deployment is called off")

    # A host ----------------------------------------------------------------------------------------------------

    def _everywhere(self, act: Callable[[Supply], None]) -> None:
        """Call `act` for all hosts in parallel; raise one error with all failures."""

        def tried(supply: Supply) -> str:
            try:
                act(supply)
            except PancakesError as error:
                return str(error)
            return ""

        with ThreadPoolExecutor(max_workers=max(1, len(self._supplies))) as threads:
            failed = [text for text in threads.map(tried, self._supplies.values()) if text]
        if failed:
            raise PancakesError("\n".join(failed))

    def _prepare(self, supply: Supply) -> None:
        host = supply.host.name
        link = self._links[host]
        for wheel in supply.missing:
            self._check_called_off()
            link.send_file(wheel.name, wheel.digest, wheel.path.read_bytes())
        if supply.missing:
            self._tell(host, f"has {len(supply.missing)} new wheels ({supply.brought_bytes / 1e6:.1f} MB)")
        own = digests(supply.own)
        self._check_called_off()
        link.obtain("libraries", name=supply.libraries, wheels=digests(supply.others))
        made = link.obtain(
            "environment", name=supply.environment, libraries=supply.libraries, wheels=own, build=supply.build
        )
        self._tell(host, f"{'has a new' if made else 'has the'} environment {supply.environment}")
        for change in self._changes:
            if change.host != host:
                continue
            link.obtain(
                "version",
                fleet=change.fleet,
                name=change.name,
                version=change.version,
                environment=change.environment,
                config=change.config,
                about={
                    "build": supply.build,
                    "libraries": supply.libraries,
                    "environment": supply.environment,
                    "wheels": own,
                    "config": digest_of(change.config),
                },
            )
            found = link.obtain("check", kind=_Checked, fleet=change.fleet, name=change.name, version=change.version)
            if not found["sound"]:
                raise PancakesError(f"{change.name} cannot run on {host}: {found['said']}")
            if found["said"]:
                self._tell(change.name, f"is checked on {host}: {found['said']}")

    # An agent --------------------------------------------------------------------------------------------------

    def _exchange(self, done: _Done) -> None:
        change = done.change
        moves = self._moves[change.fleet]
        if change.ran:
            done.before = moves.look(change.name)
        self._check_called_off()
        if change.ran:
            moves.away(change.name)
        self._check_called_off()
        done.stopped = True
        self._restart(change)
        done.runs = True
        moves.run_again(change.name, done.before, only_those=False)
        moves.back(change.name)
        fault = moves.settle(change.name, done.before.states, self._calm_s, self._called_off)
        self._check_called_off()
        if fault:
            raise PancakesError(f"{change.name} does not run on {change.host} as it should: {fault}")
        changed = f" ({', '.join(change.changed)})" if change.changed else ""
        self._tell(change.name, f"runs the version {change.version} on {change.host}{changed}")

    def _restart(self, change: AgentChange) -> None:
        """Stop an agent, switch it to its version, and start it."""
        self._ask(change, "stop_service")
        self._use(change, change.version, change.last if change.what == "start" else change.was)
        self._ask(change, "install_service")
        self._ask(change, "start_service")

    def _use(self, change: AgentChange, version: str, last: str) -> None:
        self._links[change.host].obtain("switch", fleet=change.fleet, name=change.name, version=version, last=last)

    def _undo(self, done: Iterable[_Done]) -> list[str]:
        """Roll agents back, the last one first; return a sentence for each that could not be rolled back."""
        problems = []
        for it in reversed(list(done)):
            change = it.change
            moves = self._moves[change.fleet]
            try:
                self._reach_again(change.host)
                if it.stopped:
                    if it.runs and change.ran:
                        moves.away(change.name)
                    self._take_back(change)
                    if change.ran:
                        moves.run_again(change.name, it.before, only_those=True)
                if change.ran:
                    moves.back(change.name)
                self._tell(change.name, f"is back at the version {change.was}" if change.was else "is removed again")
            except PancakesError as error:
                problems.append(f"{change.name} could not be rolled back on {change.host}: {error}")
        self._all_back()
        return problems

    def _all_back(self) -> None:
        for moves in self._moves.values():
            moves.all_back()

    def _reach_again(self, host: str) -> None:
        """Connect again to a host whose connection was lost, after it has finished the old connection's request."""
        if not self._links[host].lost:
            return
        self._links[host] = HostLink(host)
        self._new_links.append(self._links[host])
        self._links[host].obtain("lock", within=LOCK_S)

    def _take_back(self, change: AgentChange) -> None:
        if not change.was:
            self._ask(change, "forget_service")
            self._use(change, "", "")
            return
        self._ask(change, "stop_service")
        self._use(change, change.was, change.last)
        self._ask(change, "install_service")
        if change.ran:
            self._ask(change, "start_service")

    def _ask(self, change: AgentChange, what: str) -> None:
        self._links[change.host].obtain(what, fleet=change.fleet, name=change.name)
