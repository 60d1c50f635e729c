"""Make the systemd unit that runs an agent as a service, from the agent's configuration."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

import msgspec

from pancakes.agent.composition import Composition
from pancakes.agent.transport_settings import keyed_addresses
from pancakes.config import Config
from pancakes.devices.driver import Hardware
from pancakes.durable.installed import Installed
from pancakes.errors import PancakesError
from pancakes.settings import SettingsError, make_settings
from pancakes.util.files import at_home
from pancakes.util.plugins import Plugins

USER: Final = "pancakes"
"""The user of the machine as which its agents run, if no other is named."""
WATCHDOG_S: Final = 10
OF_TERMINAL: Final = ("PANCAKES_RUNTIME_DIR", "PYTHONPATH", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME")
"""The variables of the environment that a service of one person has from the terminal where its unit is printed."""
_USER_NAME: Final = re.compile(r"[a-z_][a-z0-9_-]{0,30}")
_PLAIN: Final = re.compile(r"[\w@+=:,./-]+")
_HOMES: Final = ("/home", "/root", "/run/user")

_SANDBOX: Final = """\
NoNewPrivileges=yes
CapabilityBoundingSet=
ProtectSystem=strict
PrivateTmp=yes
ProtectProc=invisible
ProtectClock=yes
ProtectHostname=yes
ProtectKernelTunables=yes
ProtectKernelModules=yes
ProtectKernelLogs=yes
ProtectControlGroups=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
LockPersonality=yes
RemoveIPC=yes
KeyringMode=private
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallFilter=~@privileged @resources
SystemCallErrorNumber=EPERM
UMask=0077
"""


class UnitFacts(msgspec.Struct, frozen=True):
    """What the unit of an agent rests on.

    Attributes:
        name: the agent's name.
        fleet: its fleet.
        command: the command that runs it, all paths absolute.
        networked: whether it speaks to other machines.
        group: the group of the machine that `local://` is open to; empty: none.
        writes: the folders outside its own that its configuration has it write to.
        reads: the folders that it needs to run: where its program and its configuration are.
        hardware: what its drivers open.
    """

    name: str
    fleet: str
    command: tuple[str, ...]
    networked: bool = False
    group: str = ""
    writes: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    hardware: tuple[Hardware, ...] = ()


def facts_of(config: Config, plugins: Plugins, user: str = "") -> UnitFacts:
    """Return what the unit of a configuration's agent rests on.

    Args:
        config: the configuration.
        plugins: where its parts come from.
        user: as whom it runs, whose home `~` is; empty: the user of this process.

    Raises:
        PancakesError: a part of the configuration is not installed here, or its settings are wrong; or that user has no
            home.
    """
    agent, skipped = config.agent, list[str]()
    composition = Composition(config, plugins, Installed(plugins), {}, {}, skipped)
    files = [path for path in composition.files(composition.services()) if not path.startswith("/dev/")]
    if skipped:
        raise PancakesError(f"{config.path}: {skipped[0]}")
    folders = {agent.state_dir, *agent.folders, *(os.path.dirname(path) for path in files)}
    program = Path(sys.executable).parent / "pancakes-agent"
    command = (str(program),) if program.exists() else (sys.executable, "-m", "pancakes.tools.cli.agent_command")
    path = os.path.abspath(config.path)
    sources = [os.path.dirname(os.path.abspath(file)) for file in config.places.files]  # also those that it extends
    return UnitFacts(
        agent.name,
        agent.fleet,
        (*command, "--config", path),
        networked=agent.mdns or bool(keyed_addresses(agent, plugins)),
        group=agent.local_group,
        writes=tuple(sorted(folder for it in folders if os.path.isabs(folder := at_home(it, user)))),
        reads=(sys.prefix, sys.base_prefix, str(Path(__file__).parent), *sources),
        hardware=tuple(_hardware(config, plugins)),
    )


def _hardware(config: Config, plugins: Plugins) -> Iterable[Hardware]:
    for device in config.devices.values():
        driver = plugins.get("pancakes.drivers", device.driver)
        try:
            yield from driver.hardware(make_settings(driver.Settings, device.settings))
        except SettingsError as error:
            raise PancakesError(f"{config.path}: the settings of the device {device.name}: {error}") from None


def unit_of(facts: UnitFacts, user: str = USER) -> str:
    """Return the unit of a service of the system, which runs under a user of its own.

    Raises:
        PancakesError: that is no name for a user.
    """
    if not _USER_NAME.fullmatch(user):
        raise PancakesError(f"{user!r} is no name for a user of this machine: lower-case letters, digits, - and _")
    own = f"pancakes/{facts.fleet}/{facts.name}"
    lines = [
        *_head(facts),
        f"User={user}",
        f"StateDirectory={own}",
        "StateDirectoryMode=0700",
        "LogsDirectory=pancakes",
        "WorkingDirectory=%L/pancakes",
        "RuntimeDirectory=pancakes",
        f"RuntimeDirectoryMode={'0750' if facts.group else '0700'}",
        "RuntimeDirectoryPreserve=yes",  # the other agents of this machine are there too
        "Environment=PANCAKES_RUNTIME_DIR=%t/pancakes",
        *[f"ReadWritePaths={_quoted(f'-{folder}')}" for folder in facts.writes],
        f"ProtectHome={_protect_home(facts)}",
        *_devices(facts),
        *_SANDBOX.splitlines(),
    ]
    return "\n".join([*lines, "", "[Install]", "WantedBy=multi-user.target", ""])


def user_unit_of(facts: UnitFacts, folder: str, environment: Mapping[str, str]) -> str:
    """Return the unit of a service of one person, which keeps its state where the agent has it at a terminal.

    Args:
        facts: what the unit rests on.
        folder: the working folder of the terminal: relative paths of the configuration begin there.
        environment: of the terminal; the unit has those of its variables that say where an agent keeps its files.
    """
    lines = [
        *_head(facts),
        f"WorkingDirectory={folder.replace('%', '%%')}",
        *(f"Environment={_quoted(f'{name}={environment[name]}')}" for name in OF_TERMINAL if name in environment),
        "NoNewPrivileges=yes",
        "LockPersonality=yes",
        "SystemCallArchitectures=native",
    ]
    return "\n".join([*lines, "", "[Install]", "WantedBy=default.target", ""])


def _head(facts: UnitFacts) -> Sequence[str]:
    online = ["Wants=network-online.target", "After=network-online.target time-sync.target"] if facts.networked else []
    return [
        "[Unit]",
        f"Description=Pancakes agent {facts.name} of the fleet {facts.fleet}".replace("%", "%%"),
        *online,
        "StartLimitIntervalSec=0",
        "",
        "[Service]",
        "Type=notify",
        f"ExecStart={' '.join(_quoted(word).replace('$', '$$') for word in facts.command)}",  # where $ is a variable
        f"WatchdogSec={WATCHDOG_S}",
        "Restart=on-failure",
        "RestartSec=1",
        "RestartPreventExitStatus=4",  # its configuration is bad, and will be
        "TimeoutStartSec=90",
        "TimeoutStopSec=10",
    ]


def _protect_home(facts: UnitFacts) -> str:
    needed = [*facts.reads, *facts.writes]
    return (
        "read-only" if any(path == home or path.startswith(f"{home}/") for path in needed for home in _HOMES) else "yes"
    )


def _devices(facts: UnitFacts) -> list[str]:
    groups = sorted({it.group for it in facts.hardware if it.group} | ({facts.group} - {""}))
    lines = [f"SupplementaryGroups={' '.join(groups)}"] if groups else []
    if not facts.hardware:
        return [*lines, "PrivateDevices=yes"]
    nodes = dict.fromkeys(it.node for it in facts.hardware)
    return [*lines, "DevicePolicy=closed", *(f"DeviceAllow={_quoted(node)} rw" for node in nodes)]


def _quoted(text: str) -> str:
    """Return one word of a line of a unit."""
    text = text.replace("%", "%%")
    if _PLAIN.fullmatch(re.sub(r"%%|\$", "", text) or "-"):
        return text
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
