"""The tables of a configuration file as frozen structures: `[agent]`, `[task.NAME]` and so on.

`settings` stay plain mappings here; their class checks them (`pancakes.config.check_plugins`).
A key that ends in `_s` counts seconds of the host, one that ends in `_mission_s` seconds of the mission, and a rate
in Hz is per second of the mission. The docstrings appear in the generated reference.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

from msgspec import Meta, Struct, field

from pancakes.config.key_lines import KeyPlaces
from pancakes.devices.health import MissRule
from pancakes.durable.register_messages import DEFAULT_WAIT_S
from pancakes.kernel.handlers import MOST_HZ
from pancakes.mesh.address import DEFAULT_FLEET, is_local, local_address
from pancakes.mesh.messages import MOST_LISTEN
from pancakes.migration import GuardRule, MigrationRule
from pancakes.recording.settings import RecordingSettings
from pancakes.security.roster import AccessRule, Right
from pancakes.settings import FilePath
from pancakes.supervision.restart import DeviceRestartSpec, RestartSpec

SCHEMA: Final = 1
"""The number of the format that this version reads; a file states it as `schema = 1`."""

DEFAULT_SERVICES: Final = ("device", "network", "log", "client")
"""The services that every agent has, even if its file does not name them (paper §3.1)."""

Positive = Annotated[float, Meta(gt=0, le=1e9)]
"""A number above 0. The upper end keeps out infinity."""

Rate = Annotated[float, Meta(ge=0, le=MOST_HZ)]
"""How often a timer ticks, in Hz; 0: not before it is rescheduled."""


class AgentConfig(Struct, frozen=True):
    """The table `[agent]`.

    Attributes:
        name: the agent's name on the mesh; the first part of all addresses in it.
        listen: the addresses where other agents may connect, such as `tcp://0.0.0.0` (without a port it is 7401; port 0
            takes a free one); a single one need not be a list. On its own machine it can always be reached, at
            `local://NAME`, or `local://FLEET/NAME` if its fleet is not `default`.
        local_group: members of this Unix group may connect too, for an agent that runs as a system service; empty: only
            the agent's own user.
        peers: the addresses of agents to connect to, such as `tcp://192.168.1.20`, or `local://NAME` on its own
            machine. Its own among them is skipped, so that a fleet can share one list.
        mdns: whether it announces its name, fleet, port and version by multicast DNS, and dials the agents of its fleet
            that do so. It needs keys, which decide who gets a link.
        links: how many links to agents it keeps; it links to others while there is something to send. For a fleet of
            hundreds. A task that migrates asks only linked agents, or the one that it is sent to. Without it, the agent
            keeps a link to every other one.
        role: `agent` (runs tasks, may be asked to take one), `environment` (a simulated world) or `client` (a
            person's tool); the last two are never asked to take a task.
        fleet: agents of different fleets refuse each other.
        state_dir: the directory for what must outlive the process; a relative one counts from the working
            directory; empty: the default place.
        seed: the seed of the agent's random numbers; None: a new one at each start.
        folders: a command, or a task from another agent, may set a path only to a file below these folders, or to the
            value in the configuration; a relative one counts from the working directory.
        birth_wait_s: a task that is new to this agent, as on an empty disk, begins once all agents at the addresses in
            `peers` have reported that they do not know it either. After this time, in host seconds, it begins anyway,
            unless it is guarded. 0: no agent is asked.
    """

    name: str
    listen: Annotated[tuple[str, ...], Meta(max_length=MOST_LISTEN - 1)] = ()
    local_group: str = ""
    peers: tuple[str, ...] = ()
    mdns: bool = False
    links: Annotated[int, Meta(ge=2, le=200)] | None = None
    role: Literal["agent", "environment", "client"] = "agent"
    fleet: str = DEFAULT_FLEET
    state_dir: FilePath = ""
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)] | None = None
    folders: tuple[FilePath, ...] = ()
    birth_wait_s: Annotated[float, Meta(ge=0, le=3600)] = DEFAULT_WAIT_S

    @property
    def addresses(self) -> tuple[str, ...]:
        """All addresses where it listens, the one within its machine first."""
        local = tuple(it for it in self.listen if is_local(it))
        if not local and self.role != "client":
            local = (local_address(self.fleet, self.name),)
        return (*local, *(it for it in self.listen if not is_local(it)))


class AccessConfig(Struct, frozen=True):
    """The table `[access]`: what the agent's peers may do, in addition to the roster of its fleet.

    Attributes:
        allow: rules, each a table `[[access.allow]]`, for peers without a certificate: those on its own machine, and
            all if it is `insecure`. None: they may do everything. For peers with a certificate, the roster has the
            rules.
        refuse: rights that no peer has here, whatever the rules are, such as `["end"]`.
    """

    allow: tuple[AccessRule, ...] | None = None
    refuse: tuple[Right, ...] = ()


class ClockConfig(Struct, frozen=True):
    """The table `[clock]`.

    Attributes:
        speed: mission seconds for each second of the host.
        hold: whether the mission waits at 0 until a `begin` packet comes.
        join_s: how long an agent waits at its start for the mission time of those `peers` that can be reached, in host
            seconds; it continues at that time. 0: its mission begins at 0.
    """

    speed: Positive = 1.0
    hold: bool = False
    join_s: Annotated[float, Meta(ge=0, le=3600)] = 1.0


class RecordConfig(RecordingSettings):
    """The table `[record]`: the settings of the recorder, which every agent has as `log/Recorder`.

    Attributes:
        start: whether it records from the start; otherwise a packet or a command starts it.
    """

    start: bool = True


class ChannelConfig(Struct, frozen=True):
    """A table `[channel.NAME]`: a channel that exists from the start, besides the core ones."""

    name: str


class DeviceConfig(Struct, frozen=True):
    """A table `[device.NAME]`.

    Attributes:
        name: the device's name on this agent.
        driver: the name of its driver, such as `sim.ir`.
        service: the device service that runs it.
        rate_hz: how often it is sampled; 0: not before it is rescheduled. Not for drivers whose hardware decides
            when it has a reading.
        settings: plain values for the driver's `Settings`.
        restart: what the device service does when it fails.
        hold_after_mission_s: an actuator goes to its safe hold when no command came for this time, in mission seconds.
        drive_stop_s: while a person drives an actuator by hand, it stops after this time without a command of that
            person, in seconds of host time.
        missed: how many failed readings, or commands of an actuator, make the device fail.
        silent_mission_s: a sensor without a reading for this time, in mission seconds, is reported as silent, and its
            connection is dialled again if it has one; None: the driver's own value.
    """

    name: str
    driver: str
    service: str = "device"
    rate_hz: Rate | None = None
    settings: Mapping[str, Any] = {}
    restart: DeviceRestartSpec = field(default_factory=DeviceRestartSpec)
    hold_after_mission_s: Positive = 0.5
    drive_stop_s: Annotated[float, Meta(ge=0.2, le=4)] = 0.5
    missed: MissRule = field(default_factory=MissRule)
    silent_mission_s: Positive | None = None


class FilterConfig(Struct, frozen=True):
    """A table `[filter.NAME]`: each command to an actuator passes its filters, in the order of the file.

    Attributes:
        name: the filter's name on this agent.
        type: the name of its class, such as `barrier`.
        device: the actuator, the NAME of its `[device.NAME]`.
        settings: plain values for the filter's `Settings`.
    """

    name: str
    type: str
    device: str
    settings: Mapping[str, Any] = {}


class ServiceConfig(Struct, frozen=True):
    """A table `[service.NAME]`.

    Attributes:
        name: the service's name on this agent.
        type: the name of its class; the four default services have their own name as their type.
        settings: plain values for the service's `Settings`.
        restart: what the kernel does when it fails.
    """

    name: str
    type: str
    settings: Mapping[str, Any] = {}
    restart: RestartSpec = field(default_factory=RestartSpec)


class TaskConfig(Struct, frozen=True):
    """A table `[task.NAME]`.

    Attributes:
        name: the task's name on this agent.
        type: the name of its class, such as `encirclement.ScanTarget`.
        service: the service that runs it.
        start: whether it runs from the start; otherwise it waits until a packet starts it.
        rate_hz: replaces the rate of the task's `@every`; 0: no tick until it is rescheduled; None: unchanged.
        settings: plain values for the task's `Settings`.
        restart: what its service does when it fails.
        durability: `each` writes the task's state before each acknowledgement, `lazy` from time to time.
        migrate: when it migrates by itself; None: never.
        guard: how it outlives its agent; None: not at all. See docs/guarded-tasks.md.
    """

    name: str
    type: str
    service: str = "client"
    start: bool = True
    rate_hz: Rate | None = None
    settings: Mapping[str, Any] = {}
    restart: RestartSpec = field(default_factory=RestartSpec)
    durability: Literal["lazy", "each"] = "lazy"
    migrate: MigrationRule | None = None
    guard: GuardRule | None = None


class Config(Struct, frozen=True):
    """The contents of a configuration file, including overrides.

    Attributes:
        agent: the table `[agent]`.
        access: the table `[access]`.
        clock: the table `[clock]`.
        record: the table `[record]`; None if there is none.
        channels: extra channels by name, in the order of the file (so are the next four).
        devices: devices by name.
        filters: filters of actuators by name.
        services: services by name; the four default ones are always there and come first.
        tasks: tasks by name.
        path: where it was read from, for messages.
        places: the place of each key, for messages.
    """

    agent: AgentConfig
    access: AccessConfig
    clock: ClockConfig
    record: RecordConfig | None
    channels: Mapping[str, ChannelConfig]
    devices: Mapping[str, DeviceConfig]
    filters: Mapping[str, FilterConfig]
    services: Mapping[str, ServiceConfig]
    tasks: Mapping[str, TaskConfig]
    path: str
    places: KeyPlaces
