"""The services of an agent with their tasks and devices, made from its configuration."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from msgspec.structs import asdict, replace

from pancakes.config import Config, DeviceConfig, ServiceConfig, TaskConfig, read_task
from pancakes.config.effective import DEFAULT, created_tables, effective, origin
from pancakes.durable.client_service import ClientService
from pancakes.durable.installed import Installed
from pancakes.durable.record import Record
from pancakes.errors import ConfigError, ControlRefusedError, PluginError
from pancakes.filters.chain import FilterSpec
from pancakes.kernel.kernel import Folders
from pancakes.recording.settings import RecordingSettings
from pancakes.service import Service
from pancakes.services.device import DeviceService, DeviceSpec
from pancakes.services.log import LogService
from pancakes.services.network import NetworkService
from pancakes.services.service_supervisor import ServiceSpec
from pancakes.settings import paths_in
from pancakes.task import TaskSpec
from pancakes.util.plugins import Plugins
from pancakes.util.text import printable

FIRST: tuple[type[Service], ...] = (LogService, DeviceService, NetworkService)
"""Services of these classes start before all others, in this order; the tasks of the user need them."""


class Composition:
    """Make the specs of an agent's services.

    Args:
        config: the agent's configuration.
        plugins: where services and drivers come from.
        installed: where task types come from.
        shared: what services get from their agent, by class and by argument; subclasses get it too.
        arguments: what tasks get from the program that made the agent, by the task's name and by argument.
        skipped: the sentence about each part that does not run is added here.
    """

    def __init__(
        self,
        config: Config,
        plugins: Plugins,
        installed: Installed,
        shared: Mapping[type[Service], Mapping[str, Any]],
        arguments: Mapping[str, Mapping[str, Any]],
        skipped: list[str],
    ) -> None:
        self._config = config
        self._plugins = plugins
        self._installed = installed
        self._shared = shared
        self._arguments = arguments
        self._skipped = skipped

    def services(self) -> list[ServiceSpec]:
        """Return the services that can run, in the order in which they start."""
        by_service: dict[str, list[TaskSpec]] = {}
        for task in self._config.tasks.values():
            spec = self._task(task)
            if spec is not None:
                by_service.setdefault(task.service, []).append(spec)
        configs = self._config.services
        made = [self._service(config, tuple(by_service.get(name, ()))) for name, config in configs.items()]
        specs = sorted([spec for spec in made if spec is not None], key=_turn_of)
        hosts = [spec.name for spec in specs if issubclass(spec.cls, DeviceService)]
        for device in self._config.devices.values():
            if device.service not in hosts:
                self._skipped.append(
                    f"the device {device.name} does not run: no device service {device.service!r} does"
                )
        return specs

    def configuration(self, records: Iterable[Record]) -> dict[str, Any]:
        """Return the effective configuration as plain values.

        Returns:
            `config`: all of its keys, with the tasks that were created on this agent and still exist; `said`: where
                each value that is not a default was set; `created`: the names of the created tasks.
        """
        from pancakes.config.toml_writer import key_text, leaves  # tomlkit is large, and few agents are asked

        found = effective(self._config, self._plugins)
        of_records = created_tables(self._config.agent.name, records)
        created = {name: table for name, table in of_records.items() if name not in found["task"]}
        tables = {**found, "task": {**found["task"], **created}}
        said = {
            key_text(keys): printable(origin(self._config, keys))
            for keys, _ in leaves(found)
            if origin(self._config, keys) != DEFAULT
        }
        return {"config": tables, "said": said, "created": list(created)}

    def folders(self, specs: Sequence[ServiceSpec]) -> Folders:
        """Return the folders that the configuration names, and the files in the settings of these services."""
        agent = self._config.agent
        return Folders(agent.name, agent.folders, self.files(specs))

    def files(self, specs: Sequence[ServiceSpec]) -> list[str]:
        """Return the files named by the settings of these services, their tasks and their devices."""
        given: list[tuple[type, Mapping[str, Any]]] = []
        for spec in specs:
            given.append((spec.cls.Settings, spec.settings))
            given += [(task.cls.Settings, task.settings) for task in spec.tasks]
            given += [(it.settings_class, it.all_settings) for it in spec.arguments.get("devices", ())]
            given.append((RecordingSettings, spec.arguments.get("record") or {}))
        return [path for cls, settings in given for _, path in paths_in(cls, settings) if path]

    def _service(self, config: ServiceConfig, tasks: tuple[TaskSpec, ...]) -> ServiceSpec | None:
        try:
            cls = self._plugins.get("pancakes.services", config.type)
        except PluginError as error:
            self._skip(f"the service {config.name}", error)
            return None
        if cls.only_name not in ("", config.name):
            self._skipped.append(
                f"the service {config.name} does not run: an agent has one {cls.__name__}, and that is {cls.only_name}"
            )
            return None
        return ServiceSpec(
            config.name, cls, config.settings, tasks, config.restart, self._arguments_of(config.name, cls)
        )

    def _arguments_of(self, name: str, cls: type[Service]) -> dict[str, Any]:
        """Return what a service gets besides its settings and tasks. That depends on its class, not its name."""
        arguments: dict[str, Any] = {}
        for service, shared in self._shared.items():
            if issubclass(cls, service):
                arguments.update(shared)
        if issubclass(cls, ClientService):
            arguments["described"] = self.described
        if issubclass(cls, DeviceService):
            devices = [self._device(device) for device in self._config.devices.values() if device.service == name]
            arguments["devices"] = tuple(device for device in devices if device is not None)
        elif issubclass(cls, LogService):
            # The table [record] is for one recorder, because a second one would record all packets again.
            record = self._config.record if name == "log" else None
            arguments["record"] = asdict(record) if record is not None else None
        return arguments

    def _device(self, config: DeviceConfig) -> DeviceSpec | None:
        try:
            cls = self._plugins.get("pancakes.drivers", config.driver)
        except PluginError as error:
            self._skip(f"the device {config.name}", error)
            return None
        filters = [it for it in self._config.filters.values() if it.device == config.name]
        try:
            classes = [self._plugins.get("pancakes.filters", it.type) for it in filters]
        except PluginError as error:
            # Without one of its filters it must not move.
            self._skip(f"the device {config.name}", error)
            return None
        return DeviceSpec(
            config.name,
            cls,
            config.driver,
            config.settings,
            config.rate_hz,
            config.hold_after_mission_s,
            config.restart,
            config.missed,
            config.silent_mission_s,
            tuple(FilterSpec(it.name, cls, it.type, it.settings) for it, cls in zip(filters, classes, strict=True)),
            config.drive_stop_s,
        )

    def _task(self, config: TaskConfig) -> TaskSpec | None:
        try:
            return self._spec(config)
        except PluginError as error:
            self._skip(f"the task {config.name}", error)
            return None

    def described(self, name: str, table: Mapping[str, Any]) -> TaskSpec:
        """Return how to start a task that the configuration does not name. Any thread.

        Args:
            name: its name.
            table: the contents of its table `[task.NAME]`.

        Raises:
            ControlRefusedError: the table is not sound; the sentence names each key at fault.
        """
        try:
            config = read_task(name, table, self._config, self._plugins)
        except ConfigError as error:
            raise ControlRefusedError(
                "; ".join(str(fault).partition(": ")[2] for fault in error.faults), "invalid"
            ) from None
        return replace(self._spec(config), created=True, arguments={})

    def _spec(self, config: TaskConfig) -> TaskSpec:
        """Return how to start a task.

        Raises:
            PluginError: its class cannot be loaded.
        """
        cls, version = self._installed.find(config.type)
        return TaskSpec(
            name=config.name,
            cls=cls,
            type=config.type,
            version=version,
            settings=config.settings,
            rate_hz=config.rate_hz,
            start=config.start,
            restart=config.restart,
            durability=config.durability,
            rule=config.migrate,
            guard=config.guard,
            arguments=self._arguments.get(config.name, {}),
        )

    def _skip(self, part: str, error: PluginError) -> None:
        """Note one bad plug-in; the rest runs."""
        self._skipped.append(f"{part} does not run: {error}")


def _turn_of(spec: ServiceSpec) -> int:
    """Return the position of a service in the order of starting; services with equal positions keep their order."""
    return next((place for place, cls in enumerate(FIRST) if issubclass(spec.cls, cls)), len(FIRST))
