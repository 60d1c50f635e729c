"""Read fleet files: `fleet.toml`, folders and `--set` become the agents of a launch, or one error with all faults.

`load_fleet` reads one file into frozen dataclasses. `make_fleet` reads all files of a command line, merges the changes
for each agent, and returns one `Member` per agent in the order of start. `check_free` checks that no running agent has
the name of a member and no program has its port. Nothing is started here.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

from msgspec import Meta

from pancakes.config import Address, Config, load, parse_address
from pancakes.config.key_lines import KeyPath, KeyPlaces, set_text
from pancakes.config.schema import closed, named_tables, schema_document
from pancakes.config.state_dir import state_dir_of
from pancakes.config.toml_reader import Tables, fault_of_schema, read_layers, read_values, text_of
from pancakes.config.toml_writer import key_text, leaves, value_text
from pancakes.config.variables import TABLE as VARIABLES
from pancakes.config.variables import replace_variables
from pancakes.errors import ConfigError, Fault, PancakesError
from pancakes.mesh.address import DEFAULT_FLEET
from pancakes.settings import check_settings
from pancakes.supervision.restart import Policy, fault_of_pauses
from pancakes.tools.launch.ports import Claim, listening_fault, within_machine
from pancakes.tools.launch.ssh import fault_of_host
from pancakes.util import codecs
from pancakes.util.files import NoHome, NoPathError, at_home
from pancakes.util.plugins import Plugins
from pancakes.util.runtime_dir import RunningAgent, entries
from pancakes.util.schema import schema_of
from pancakes.util.text import hint_of, suggestion


@dataclass(frozen=True, slots=True)
class ProcessRestart:
    """What the launcher does when the process of an agent has ended by itself.

    Attributes:
        policy: `on-failure`: restart the agent if its exit code is not 0, as after a crash; `always`: also after a
            graceful stop, as by `pancakes down`; `no`: never.
        at_most: how many restarts are tried ...
        within_s: ... in this many seconds in which the agent is ready; after one more end it is given up. Pauses and
            failed starts do not count as time here.
        pause_s: how long the first restart waits, in seconds. Each further one within `within_s` waits twice as long as
            the one before, minus a random part of up to a quarter.
        pause_max_s: the longest pause before a restart, in seconds.
    """

    policy: Policy = "on-failure"
    at_most: Annotated[int, Meta(ge=0)] = 3
    within_s: Annotated[float, Meta(gt=0, le=1e9)] = 60.0
    pause_s: Annotated[float, Meta(ge=0, le=1e9)] = 0.1
    pause_max_s: Annotated[float, Meta(ge=0, le=1e9)] = 10.0


@dataclass(frozen=True, slots=True)
class Member:
    """One agent of a fleet.

    Attributes:
        name: the agent's name.
        path: its configuration file.
        sets: the changes to that file, as `--set` takes them.
        config: the resulting configuration.
        restart: what happens when its process ends.
        after: the agents that must be ready before it starts, and that end after it.
        host: where it runs, as `ssh` takes it: `pi@robot1`; empty: on this machine.
        unchecked: the names in its configuration that are not installed here, and so were not checked.
    """

    name: str
    path: Path
    sets: tuple[str, ...]
    config: Config
    restart: ProcessRestart = field(default_factory=ProcessRestart)
    after: tuple[str, ...] = ()
    host: str = ""
    unchecked: tuple[str, ...] = ()


def overrides(table: Mapping[str, Any]) -> Iterator[str]:
    """Yield `table.key=value` for each value in nested tables; the other keys of the file stay unchanged."""
    for keys, value in leaves(table) if table else ():
        yield f"{key_text(keys)}={value_text(value)}"


def whose(change: str, agents: Sequence[str]) -> tuple[Sequence[str], str]:
    """Return the agents that a change from the command line applies to, and the change without the agent's name.

    Args:
        change: `AGENT:table.key=value`, or `table.key=value` for all agents.
        agents: the names of all agents.

    Raises:
        ConfigError: the change names an unknown agent.
    """
    keys, equals, value = change.partition("=")
    agent, colon, rest = keys.partition(":")
    if not colon:
        return agents, change
    if agent not in agents:
        near = suggestion(agent, agents)
        raise ConfigError([Fault(f"--set {change}", agent, f"is not one of the agents {', '.join(agents)}", near)])
    return (agent,), f"{rest}{equals}{value}"


FLEET_FILE: Final = "fleet.toml"
"""The name of a folder's fleet file."""

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class FleetTable:
    """The table `[fleet]`: the settings that all agents of the fleet share.

    Attributes:
        name: the name of the fleet; empty: the file of each agent names it.
        set: changes to each agent's file: tables and keys as in that file, such as `{ clock.speed = 5 }`.
        restart: what happens when a process ends, unless the table of the agent has its own `restart`.
    """

    name: str = ""
    set: Mapping[str, Any] = field(default_factory=dict)
    restart: ProcessRestart = field(default_factory=ProcessRestart)


@dataclass(frozen=True, slots=True)
class MemberTable:
    """A table `[agent.NAME]`: one agent of the fleet. NAME replaces the name in its configuration file.

    Attributes:
        config: its configuration file, relative to the folder of the fleet file; empty: `NAME.toml`.
        set: changes to that file, in addition to those of `[fleet]`.
        restart: what happens when its process ends; None: as `[fleet]` says.
        after: the agents that must be ready before it starts, and that end after it.
        host: where it runs, as `ssh` takes it: `pi@robot1`, or a name of `~/.ssh/config`; empty: on this machine.
    """

    config: str = ""
    set: Mapping[str, Any] = field(default_factory=dict)
    restart: ProcessRestart | None = None
    after: tuple[str, ...] = ()
    host: str = ""


@dataclass(frozen=True, slots=True)
class FleetFile:
    """The content of a fleet file.

    Attributes:
        fleet: the table `[fleet]`.
        agents: its agents by name, in the order of the file.
        places: file and line of each key, for messages.
        variables: its variables, which hold in the files of its agents too.
    """

    fleet: FleetTable
    agents: Mapping[str, MemberTable]
    places: KeyPlaces = field(repr=False, compare=False)
    variables: Mapping[str, Any] = field(default_factory=dict)


def is_fleet(values: Mapping[str, Any]) -> bool:
    """Return whether the values of a file are those of a fleet file rather than of an agent's configuration."""
    return "fleet" in values


def load_fleet(path: str) -> FleetFile:
    """Read a fleet file.

    Raises:
        ConfigError: the file cannot be read, or is invalid; the error has all faults.
    """
    tables = read_layers(text_of(path), path, named=("agent",))
    variables = tables.values.get(VARIABLES)
    tables = tables._replace(faults=[*tables.faults, *replace_variables(tables.values, tables.places)])
    reader = _FleetReader(tables.values, tables.places)
    found = reader.read()
    if faults := tables.with_faults(reader.faults):
        raise ConfigError(reader.places.in_order(faults))
    return replace(found, variables=variables or {})


def fleet_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a fleet file."""
    fleet, agent = closed(schema_of(FleetTable)), closed(schema_of(MemberTable))
    definitions = {**fleet.pop("$defs", {}), **agent.pop("$defs", {})}
    properties = {"fleet": fleet, "agent": named_tables(agent)}
    return schema_document("A fleet", properties, {"required": ["fleet", "agent"], "properties": {}}, definitions)


class _FleetReader:
    """Make a `FleetFile` and collect its faults."""

    def __init__(self, values: dict[str, Any], places: KeyPlaces) -> None:
        self._values = values
        self.places = places
        self.faults: list[Any] = []

    def read(self) -> FleetFile:
        self._check_top()
        fleet = self._make(FleetTable, self._values.get("fleet", {}), ("fleet",))
        self._check_pauses(("fleet",), fleet.restart)
        tables = self._values.get("agent", {})
        if not isinstance(tables, dict) or not tables:
            self._fault(("agent",), "expected a table for each agent, such as [agent.NAME]")
            tables = {}
        agents = {name: self._make(MemberTable, table, ("agent", name)) for name, table in tables.items()}
        for name, table in agents.items():
            self._check_after(name, table, agents)
            self._check_pauses(("agent", name), table.restart)
            if table.host and (fault := fault_of_host(table.host)):
                self._fault(("agent", name, "host"), fault)
        if not self.faults:
            self._check_circles(agents)
        return FleetFile(fleet, agents, self.places)

    def _fault(self, key: KeyPath, problem: str, near: str = "") -> None:
        self.faults.append(self.places.fault(key, problem, near))

    def _check_top(self) -> None:
        known = ("schema", "fleet", "agent")
        for key in self._values:
            if key not in known:
                self._fault((key,), "unknown key in a fleet file", suggestion(key, known))
        fault = fault_of_schema(self._values)
        if fault:
            self._fault(("schema",), fault)
        if "fleet" not in self._values:
            self._fault(("fleet",), "is missing: a fleet file has a table [fleet], which may be empty")

    def _make(self, cls: type[_T], values: Any, key: KeyPath) -> _T:
        problems = check_settings(cls, values)
        for problem in problems:
            self._fault((*key, *problem.path), problem.text, problem.suggestion)
        return codecs.convert({} if problems else values, cls)

    def _check_pauses(self, key: KeyPath, restart: ProcessRestart | None) -> None:
        fault = fault_of_pauses(restart.pause_s, restart.pause_max_s) if restart is not None else ""
        if fault:
            self._fault((*key, "restart", "pause_max_s"), fault)

    def _check_after(self, name: str, table: MemberTable, agents: Mapping[str, MemberTable]) -> None:
        for index, other in enumerate(table.after):
            key = ("agent", name, "after", index)
            if other == name:
                self._fault(key, "an agent cannot wait for itself")
            elif other not in agents:
                self._fault(key, f"this fleet has no agent {other!r}", suggestion(other, agents))

    def _check_circles(self, agents: Mapping[str, MemberTable]) -> None:
        """Find agents that wait for each other: remove those that wait for no one, until none can be removed."""
        waiting = {name: list(table.after) for name, table in agents.items()}
        while free := [name for name, after in waiting.items() if not after]:
            waiting = {
                name: [other for other in after if other not in free]
                for name, after in waiting.items()
                if name not in free
            }
        if waiting:
            first = next(iter(waiting))
            circle = " and ".join(waiting)
            self._fault(("agent", first, "after"), f"{circle} would wait for each other for ever")


_EVERYWHERE = ("0.0.0.0", "::")


@dataclass(frozen=True, slots=True)
class _Draft:
    """A member before its configuration has been read.

    Attributes:
        set_at: where the fleet file sets each change, by the place that an error in the configuration names.
        after: None if no fleet file has it.
        host: where it runs; empty: on this machine.
    """

    name: str
    path: Path
    sets: tuple[str, ...] = ()
    set_at: Mapping[str, str] = field(default_factory=dict)
    restart: ProcessRestart = ProcessRestart()
    after: tuple[str, ...] | None = None
    host: str = ""

    def place_of(self, where: str) -> str:
        """Return the place in the fleet file of what an error in the configuration finds at a `--set`."""
        if where in self.set_at:
            return self.set_at[where]
        # The value of a variable: `node.toml:5 (gateway: --set ...)`.
        for text, place in self.set_at.items() if "(" in where else ():
            for end in (",", ")"):
                where = where.replace(f": {text}{end}", f": {place}{end}")
        return where


def make_fleet(
    paths: Sequence[Path],
    extra: Sequence[str],
    policy: Policy | None,
    plugins: Plugins | None,
    *,
    must_load: bool = False,
    local: bool = False,
    check_hosts: bool = False,
) -> list[Member]:
    """Read a fleet. Nothing is started, and running agents are not checked.

    Args:
        paths: configuration files of agents, fleet files, and folders. Of a folder, `fleet.toml` is read; without one,
            all `*.toml`, by name. Environments come first, unless a fleet file gives the order.
        extra: `[AGENT:]table.key=value` from the command line.
        policy: whether an agent is restarted when it ends; None: as the fleet file says.
        plugins: where drivers and tasks come from; None: their settings are not checked.
        must_load: whether a driver or task that cannot be imported is a fault.
        local: whether the agents communicate only within this machine, and use no TCP port.
        check_hosts: whether agents of other hosts are checked with the plug-ins of this machine, as far as these are
            installed here. Otherwise the settings of their drivers and tasks are not checked.

    Raises:
        ConfigError: a file is invalid, or two files conflict; the error has all faults.
    """
    drafts, faults = _drafts(paths)
    names = [draft.name for draft in drafts]
    sets: dict[str, list[str]] = {draft.name: list(draft.sets) for draft in drafts}
    for change in extra:
        try:
            agents, rest = whose(change, names)
        except ConfigError as error:
            faults += error.faults
            continue
        for agent in agents:
            sets[agent].append(rest)
    if local:
        faults += _elsewhere(drafts)
        _stay_within(drafts, sets)
    members: list[Member] = []
    for draft in drafts:
        changes = tuple(sets[draft.name])
        restart = draft.restart if policy is None else replace(draft.restart, policy=policy)
        try:
            # A plug-in that is missing here may be installed on the host.
            missing: set[str] | None = set() if draft.host else None
            known = plugins if check_hosts or not draft.host else None
            config = load(draft.path, changes, known, must_load=must_load and not draft.host, missing=missing)
        except ConfigError as error:
            faults += [fault._replace(where=draft.place_of(fault.where)) for fault in error.faults]
            continue
        if config.agent.name != draft.name:
            problem = f"differs from {draft.name!r}, the name of this agent in the launch"
            faults.append(config.places.fault(("agent", "name"), problem))
        after, unchecked = draft.after or (), tuple(sorted(missing or ()))
        members.append(Member(draft.name, draft.path, changes, config, restart, after, draft.host, unchecked))
    members = _in_order(members, [draft.name for draft in drafts if draft.after is None])
    faults += _clashes(members)
    if faults:
        raise ConfigError(list(dict.fromkeys(faults)))
    return members


def chosen(members: Sequence[Member], names: Sequence[str]) -> list[Member]:
    """Return the members with these names; all of them if no name is given.

    Raises:
        PancakesError: there is no member with such a name.
    """
    known = [member.name for member in members]
    for name in names:
        if name not in known:
            raise PancakesError(f"the fleet has no agent {name!r}{hint_of(name, known)}")
    return [
        replace(member, after=tuple(it for it in member.after if it in names))
        for member in members
        if member.name in names
    ] or list(members)


def unlinked(members: Sequence[Member]) -> list[str]:
    """Return the members that will have no link to another one: none has the address of the other among its peers."""
    named = {peer for member in members for peer in member.config.agent.peers}
    return [
        member.name
        for member in members
        if not member.config.agent.peers
        and not named.intersection(member.config.agent.addresses)
        and any(it.config.agent.fleet == member.config.agent.fleet for it in members if it is not member)
    ]


def check_free(members: Sequence[Member], claims: bool = True) -> Claim:
    """Check that no other agent on this machine has the name of a member, and no other program has its port.

    Args:
        members: the agents.
        claims: whether their ports are claimed; not if the launcher of their whole fleet may have claimed them.

    Returns:
        A claim that keeps other launchers from these ports.

    Raises:
        PancakesError: a name or port is in use; the sentences name it, and the agent that uses it if that is known.
    """
    registered = entries()
    running = {(entry.fleet, entry.name): entry.pid for entry in registered}
    problems = []
    running_here: list[str] = []
    is_taken = False
    here = [member for member in members if not member.host]
    for member in here:
        agent = member.config.agent
        pid = running.get((agent.fleet, agent.name))
        if pid is not None:
            problems.append(f"the agent {agent.name} of the fleet {agent.fleet} runs already (process {pid})")
            running_here.append(agent.name)
            continue
        for address in _places(member):
            if fault := listening_fault(address.host, address.port):
                is_taken = True
                problems.append(f"{agent.name} cannot listen at {address}: {fault}{_by(address, registered)}")
    if is_taken:
        problems.append("stop the program that uses the port, launch with --local (no ports), or --set another port")
    if running_here and (others := [member.name for member in here if member.name not in running_here]):
        problems.append(f"to start only the others: --only {' --only '.join(others)}")
    claim = Claim.to(address.port for member in here if claims for address in _places(member))
    if problems or claim is None:
        if claim is not None:
            claim.release()
        raise PancakesError("\n".join(problems) or "another launcher is about to use the ports of this fleet")
    return claim


def _elsewhere(drafts: Sequence[_Draft]) -> Iterator[Fault]:
    """Yield a fault for each agent on another host: `local://` reaches only this machine."""
    for draft in drafts:
        if draft.host:
            yield Fault("--local", draft.name, f"runs on {draft.host}, which local:// does not reach")


def _stay_within(drafts: Sequence[_Draft], sets: Mapping[str, list[str]]) -> None:
    """Add changes so that the members need no ports. Faults of a file are reported later, when it is loaded."""
    tables: dict[str, Any] = {}
    for draft in drafts:
        try:
            tables[draft.name] = read_values(text_of(str(draft.path)), str(draft.path), sets[draft.name]).values
        except ConfigError:
            return
    agents = {name: table.get("agent") for name, table in tables.items()}
    fleets = {name: str(it.get("fleet", DEFAULT_FLEET)) for name, it in agents.items() if isinstance(it, dict)}
    for name, changes in within_machine(tables, fleets).items():
        sets[name].extend(changes)


def _drafts(paths: Sequence[Path]) -> tuple[list[_Draft], list[Fault]]:
    drafts: list[_Draft] = []
    faults: list[Fault] = []
    for path in paths:
        try:
            files = _files(path)
        except ConfigError as error:
            faults += error.faults
            continue
        for file in files:
            try:
                drafts.extend(_of_file(file, faults))
            except ConfigError as error:
                faults += error.faults
    for index, draft in enumerate(drafts):
        earlier = next((other for other in drafts[:index] if other.name == draft.name), None)
        if earlier is not None:
            problem = f"{earlier.path!s} already defines an agent {draft.name!r}"
            faults.append(Fault(str(draft.path), "[agent] name", problem))
    return drafts, faults


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    if (path / FLEET_FILE).exists():
        return [path / FLEET_FILE]
    files = sorted(path.glob("*.toml"))
    bases = _only_extended(files)
    if not set(files) - bases:
        raise ConfigError([Fault(str(path), "folder", "contains no configuration (*.toml)")])
    return [file for file in files if file not in bases]


def _only_extended(files: Sequence[Path]) -> set[Path]:
    """Return the files that others extend, and that name no agent themselves."""
    layers: dict[Path, Tables] = {}
    for file in files:
        with suppress(ConfigError):  # which is reported when it is loaded
            layers[file] = read_layers(text_of(str(file)), str(file))
    extended = {os.path.realpath(base) for found in layers.values() for base in found.places.files[1:]}
    return {file for file, found in layers.items() if os.path.realpath(file) in extended and not _name_in(found.values)}


def _of_file(path: Path, faults: list[Fault]) -> Iterator[_Draft]:
    """Yield the agents of a file. A faulty agent adds to `faults`; the others are yielded all the same."""
    values = _values_of(path)
    if path.name != FLEET_FILE and not is_fleet(values):
        yield _Draft(_name_in(values) or path.stem, path)
        return
    found = load_fleet(str(path))
    for name, table in found.agents.items():
        try:
            # A path counts from the folder of the file that it is in, which may be one that the fleet file extends.
            file = Path(found.places.file("agent", name, "config")).parent / at_home(table.config or f"{name}.toml")
        except NoPathError as error:
            faults.append(found.places.fault(("agent", name, "config"), str(error)))
            continue
        if not file.is_file():
            faults.append(found.places.fault(("agent", name, "config"), f"the file {file} does not exist"))
            continue
        try:
            own = _values_of(file)
        except ConfigError as error:
            faults += error.faults
            continue
        set_at: dict[str, str] = {}
        for variable, value in found.variables.items():
            set_at[f"{key_text((VARIABLES, variable))}={value_text(value)}"] = found.places.where(VARIABLES, variable)
        if found.fleet.name:
            set_at[f"agent.fleet={value_text(found.fleet.name)}"] = found.places.where("fleet", "name")
        if _name_in(own) != name:
            set_at[f"agent.name={value_text(name)}"] = found.places.where("agent", name)
        set_at.update(dict.fromkeys(overrides(found.fleet.set), found.places.where("fleet", "set")))
        set_at.update(dict.fromkeys(overrides(table.set), found.places.where("agent", name, "set")))
        places = {set_text(text): where for text, where in set_at.items()}
        yield _Draft(name, file, tuple(set_at), places, table.restart or found.fleet.restart, table.after, table.host)


def _values_of(path: Path) -> dict[str, Any]:
    """Return the plain values of a file. Its faults are reported when it is loaded."""
    return read_values(text_of(str(path)), str(path)).values


def _name_in(values: Mapping[str, Any]) -> str:
    agent = values.get("agent")
    name = agent.get("name") if isinstance(agent, dict) else None
    return name if isinstance(name, str) else ""


def _in_order(members: Sequence[Member], free: Sequence[str]) -> list[Member]:
    """Start agents without an `after` after the environments: so a robot ends before its world does."""

    def acts(member: Member) -> bool:
        return member.config.agent.role != "environment"

    worlds = tuple(member.name for member in members if not acts(member) and member.name in free)
    ordered = [replace(member, after=worlds) if acts(member) and member.name in free else member for member in members]
    return sorted(ordered, key=lambda member: acts(member) and member.name in free)


def _by(address: Address, running: Iterable[RunningAgent]) -> str:
    """Return which agent has the port of an address, as the end of a sentence; empty: unknown."""
    for entry in running:
        if any(parse_address(listen).port == address.port for listen in entry.listen):
            return f", by {entry.name} of the fleet {entry.fleet} (process {entry.pid})"
    return ""


def _clashes(members: Sequence[Member]) -> Iterator[Fault]:
    """Yield a fault for each port and each state directory that two members of a host share."""
    for index, member in enumerate(members):
        for other in members[:index]:
            if other.host != member.host:
                continue
            places = member.config.places
            for one, another in product(_places(member), _places(other)):
                if _same_port(one, another):
                    problem = f"{other.name} ({other.path}) already listens at this port"
                    yield places.fault(("agent", "listen"), problem)
            directory, taken = _state_dir(member), _state_dir(other)
            if directory is not None and taken is not None and directory.absolute() == taken.absolute():
                key = ("agent", "state_dir")
                yield places.fault(key, f"is the state directory of {other.name} ({other.path}) as well")


def _state_dir(member: Member) -> Path | None:
    """Return the state directory of a member; None: it has none, or none can be found (reported at its start)."""
    try:
        return state_dir_of(member.config)
    except NoHome:
        return None


def _places(member: Member) -> list[Address]:
    """Return the addresses that a member listens at, without those whose port the system chooses."""
    return [address for address in map(parse_address, member.config.agent.listen) if address.port]


def _same_port(one: Address, other: Address) -> bool:
    if one.port != other.port:
        return False
    return one.host == other.host or one.host in _EVERYWHERE or other.host in _EVERYWHERE
