"""Check whether an agent with a valid configuration could start on this machine and be reached.

`pancakes config check` and `pancakes-agent --check` give the same warnings. No agent is started.
"""

from __future__ import annotations

import grp
import os
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pancakes.config.state_dir import state_dir_of
from pancakes.errors import EXTRAS, ConfigError, Fault
from pancakes.journal.file_journal import fault_of
from pancakes.mesh.address import is_local, parse_address
from pancakes.mesh.sockets import why_not_here
from pancakes.util.files import NoHome

if TYPE_CHECKING:
    from pancakes.config import Config
    from pancakes.config.key_lines import KeyPath
    from pancakes.util.plugins import Plugins


def start_doubts(config: Config) -> Iterator[tuple[KeyPath, str]]:
    """Yield the reasons why an agent would not start here, each with its configuration key.

    It creates and changes nothing. It looks up host names, which may take some seconds.
    """
    if reason := _of_state(config):
        yield ("agent", "state_dir"), reason
    group = config.agent.local_group
    if group and not _is_group(group):
        yield ("agent", "local_group"), f"the group {group!r} does not exist on this machine"
    for address in config.agent.listen:
        if reason := _of_local(address) if is_local(address) else why_not_here(address):
            yield ("agent", "listen"), f"cannot listen at {address}: {reason}"


def _is_group(name: str) -> bool:
    try:
        grp.getgrnam(name)
    except (KeyError, ValueError):  # ValueError: the name contains NUL
        return False
    return True


def _of_state(config: Config) -> str:
    try:
        directory = state_dir_of(config)
    except NoHome as error:
        return str(error)
    if directory is None:
        return ""
    try:
        return fault_of(directory, directory.stat()) if directory.is_dir() else _why_not_made(directory)
    except OSError as error:
        return f"the state directory {directory} cannot be used: {error.strerror}"


def _of_local(address: str) -> str:
    path = parse_address(address).path
    return _why_not_made(Path(path).parent) if path.startswith("/") else ""


def _why_not_made(path: Path) -> str:
    """Return why a directory is missing and cannot be made; empty if it exists or can be made."""
    existing = next((it for it in (path, *path.absolute().parents) if os.path.lexists(it)), Path("/"))
    if not existing.is_dir():
        return f"{existing} is not a directory"
    return "" if os.access(existing, os.W_OK | os.X_OK) else f"this user may not write in {existing}"


def _missing_extras(config: Config) -> Iterator[tuple[KeyPath, str]]:
    """Yield what an agent would be told to do without, as an extra is not installed."""
    wanted: list[tuple[KeyPath, str, str]] = []
    if config.agent.mdns:
        wanted.append((("agent", "mdns"), "zeroconf", "no agent is announced or found by mDNS"))
    for name, service in config.services.items():
        if service.type in OF_SERVICES:
            wanted.append((("service", name, "type"), *OF_SERVICES[service.type]))
    for key, module, what in wanted:
        if not _is_installed(module):
            package = module.partition(".")[0]
            yield key, f"{what} without {package}: pip install 'pancakes-agents[{EXTRAS[package]}]'"


def _is_installed(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # a package that it is in
        return False


OF_SERVICES: Final = {
    "metrics": ("prometheus_client", "there are no metrics"),
    # Other distributions bring a part of `opentelemetry` too.
    "traces": ("opentelemetry.exporter.otlp.proto.http", "no traces are sent"),
}
"""The module of an extra that a service needs, and what an agent does without if it is not installed."""
NOT_HERE: Final = "it would not start on this machine"


def machine_doubts(config: Config, plugins: Plugins) -> list[Fault]:
    """Return the warnings of `pancakes config check` and `pancakes-agent --check`.

    They are warnings, not errors, because the configuration may be for another machine.

    Args:
        config: a valid configuration.
        plugins: where transports come from.
    """
    from pancakes.agent.transport_settings import keys_for, network_settings
    from pancakes.config.checks import doubts_of

    found = doubts_of(config)
    found += [config.places.fault(key, f"{NOT_HERE}: {why}") for key, why in start_doubts(config)]
    found += [config.places.fault(key, text) for key, text in _missing_extras(config)]
    try:
        keys_for(config, network_settings(config), plugins)
    except ConfigError as error:
        found += [fault._replace(problem=f"{NOT_HERE}: {fault.problem}") for fault in error.faults]
    return found
