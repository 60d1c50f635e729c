"""Check a configuration against its plug-ins, its migration rules and this machine.

It checks whether the plug-ins exist, whether their settings fit, and whether what they need is there. `doubts_of` finds
settings that are valid but probably not meant; it looks up host names, which may take seconds.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from math import isfinite
from typing import TYPE_CHECKING, Any, Final

from pancakes.config.key_lines import KeyPath, KeyPlaces
from pancakes.config.tables import Config, DeviceConfig, TaskConfig
from pancakes.errors import Fault, PluginError
from pancakes.mesh.address import parse_address
from pancakes.mesh.sockets import ADVICE, would_be_near_only
from pancakes.migration import ALLOCATION, MOST_UNITS, MigrationRule, faults_of_weights
from pancakes.packet import body_class, field_names, known_types
from pancakes.settings import check_settings, known_keys
from pancakes.util.plugins import Plugins, UnknownPluginError, to_install
from pancakes.util.text import suggestion

if TYPE_CHECKING:
    from pancakes.devices.driver import Driver


def faults_of_rule(rule: MigrationRule, task: str, tasks: Mapping[str, TaskConfig]) -> Iterator[tuple[str, str, str]]:
    """Yield (key, problem, suggestion) for each mistake in the rule of a task.

    An empty key means the rule as a whole; `cost.NAME` is a key of the table `cost`.

    Args:
        rule: the rule.
        task: the name of the task that it migrates.
        tasks: all tasks of the configuration.
    """
    if not rule.when:
        yield "when", "is empty: name the type of the packets to watch, such as 'battery'", ""
    yield from _faults_of_allocated(rule, task)
    if rule.below is None and rule.above is None and not rule.allocated:
        yield "", "needs a bound: below, above or both", ""
    for name, bound in (("below", rule.below), ("above", rule.above)):
        if bound is not None and not isfinite(bound):
            yield name, f"expected a finite number, not {bound:g}", ""
        elif bound is not None and rule.field == "level" and not 0 <= bound <= 1:
            yield name, f"expected a number from 0 to 1 (a level is a share), not {bound:g}", ""
    if rule.below is not None and rule.above is not None and rule.below > rule.above:
        yield "below", f"is more than above ({rule.above:g}), so that the task would always migrate", ""
    if rule.cost == "":
        yield "cost", "is empty: name a cost function, such as 'tasks'", ""
    elif not isinstance(rule.cost, str):
        for name, problem in faults_of_weights(rule.cost):
            yield f"cost.{name}" if name else "cost", problem, ""
    if not (isfinite(rule.again_s) and rule.again_s > 0):
        yield "again_s", f"expected a number of seconds > 0, not {rule.again_s:g}", ""
    for key, name, why in (
        ("then", rule.then, "which has just left"),
        ("otherwise", rule.otherwise, "which is stopped then"),
    ):
        if name == task:
            yield key, f"names the task itself, {why}", ""
        elif name and name not in tasks:
            yield key, f"there is no task {name!r} here", suggestion(name, [it for it in tasks if it != task])


_OF_READINGS: Final = ("below", "above", "field", "then", "otherwise")
_OF_ALLOCATION: Final = ("value", "move_price", "takes_mission_s", "ends_by_mission_s", "after", "together")


def _faults_of_allocated(rule: MigrationRule, task: str) -> Iterator[tuple[str, str, str]]:
    """Yield what is wrong with the keys of a rule that are about the team's allocation, or not for it."""
    defaults = MigrationRule(rule.when)
    for name in _OF_READINGS if rule.allocated else _OF_ALLOCATION:
        if getattr(rule, name) != getattr(defaults, name):
            for_ = "a rule that watches readings" if rule.allocated else f"when = {ALLOCATION!r}"
            yield name, f"is only for {for_}, not for when = {rule.when!r}", ""
    if not 0 < rule.value <= MOST_UNITS:
        yield "value", f"expected a number > 0 and at most {MOST_UNITS:g}, not {rule.value:g}", ""
    for name, number in (("move_price", rule.move_price), ("takes_mission_s", rule.takes_mission_s)):
        if not 0 <= number <= MOST_UNITS:
            yield name, f"expected a number from 0 to {MOST_UNITS:g}, not {number:g}", ""
    if rule.ends_by_mission_s is not None and not abs(rule.ends_by_mission_s) <= MOST_UNITS:
        yield "ends_by_mission_s", f"expected a number of at most {MOST_UNITS:g}, not {rule.ends_by_mission_s:g}", ""
    for name, others in (("after", rule.after), ("together", rule.together)):
        if task in others:
            yield name, "names the task itself", ""


DRIVERS = "pancakes.drivers"
SERVICES = "pancakes.services"
TASKS = "pancakes.tasks"
COSTS = "pancakes.costs"
FILTERS = "pancakes.filters"
TRANSPORTS = "pancakes.transports"


def check_plugins(
    config: Config, plugins: Plugins, must_load: bool = False, missing: set[str] | None = None
) -> list[Fault]:
    """Return all that a configuration gets wrong about drivers, filters, services, tasks, costs and transports.

    Checks that need a plug-in that cannot be imported are skipped.

    Args:
        config: a configuration; tables without a type are skipped.
        plugins: where the plug-ins come from. Those that the configuration names are imported, and so are all
            types of packets.
        must_load: whether it is a fault if a plug-in that the configuration names cannot be imported. Otherwise it is
            left to `Plugins.problems`, and the rest of an agent runs.
        missing: takes the names of plug-ins that are not installed, which then are not faults; None: they are faults.
    """
    check = _Check(config, plugins, must_load, missing)
    check.run()
    return config.places.in_order(check.faults)


def check_task(config: Config, task: TaskConfig, plugins: Plugins) -> list[Fault]:
    """Return all that one task of a configuration gets wrong about its class, costs and devices.

    Args:
        config: the configuration that it is in.
        task: the task; without a type it is skipped.
        plugins: where the plug-ins come from. One that cannot be imported is a fault.
    """
    check = _Check(config, plugins, must_load=True)
    check.task(task)
    return check.faults


class _Check:
    """Check one configuration."""

    def __init__(self, config: Config, plugins: Plugins, must_load: bool, missing: set[str] | None = None) -> None:
        self._missing = missing
        self._config = config
        self._must_load = must_load
        self._plugins = plugins
        self._places: KeyPlaces = config.places
        self._broken = False  # whether a plug-in could not be imported, so the rest is not fully known
        self.faults: list[Fault] = []

    def run(self) -> None:
        config = self._config
        self._check_transports()
        device_types = self._check_devices()
        self._check_filters()
        self._check_services()
        classes = {
            task.name: self._check_part(TASKS, task.type, task.settings, ("task", task.name), "type")
            for task in config.tasks.values()
        }
        started = [task.name for task in config.tasks.values() if task.start]
        rules = [task.migrate for task in config.tasks.values() if task.migrate]
        started += [name for rule in rules for name in (rule.then, rule.otherwise)]
        for task in config.tasks.values():
            if task.name in started:
                self._check_requires(task, classes[task.name], device_types)
        if self._plugins.load_packets():
            self._broken = True
        for task in config.tasks.values():
            if task.migrate:
                self._check_rule(task.migrate, ("task", task.name, "migrate"))

    def task(self, task: TaskConfig) -> None:
        """Check one task, but not the rest of the configuration."""
        cls = self._check_part(TASKS, task.type, task.settings, ("task", task.name), "type")
        self._check_requires(task, cls, self._device_types())
        if task.migrate:
            self._check_rule(task.migrate, ("task", task.name, "migrate"))

    def _device_types(self) -> list[str] | None:
        faults = self.faults
        self.faults = []
        found = self._check_devices()
        self.faults = faults  # faults of devices are reported with the devices
        return found

    def _fault(self, key: KeyPath, problem: str, near: str = "") -> None:
        self.faults.append(self._places.fault(key, problem, near))

    def _get(self, group: str, name: str, key: KeyPath) -> Any | None:
        """Return a plug-in; None if it cannot be loaded, which is noted."""
        try:
            return self._plugins.get(group, name)
        except UnknownPluginError as error:
            if self._missing is None:
                self._fault(key, error.problem, error.suggestion)
            else:
                self._missing.add(name)
                self._broken = True
        except PluginError as error:
            self._broken = True
            if self._must_load:
                self._fault(key, str(error))
        return None

    def _check_part(self, group: str, name: str, settings: Mapping[str, Any], table: KeyPath, key: str) -> Any | None:
        """Check that a class exists and that its settings fit; return it if it can be used."""
        if not name:
            return None  # its absence has been reported
        found = self._get(group, name, (*table, key))
        if found is None:
            return None
        if not _is_class_of(group, found):
            kind = group.removeprefix("pancakes.")[:-1]
            self._fault((*table, key), f"{name!r} is not a {kind} but {_shown(found)}: a defect of its distribution")
            return None
        for problem in check_settings(found.Settings, settings):
            self._fault((*table, "settings", *problem.path), problem.text, problem.suggestion)
        return found

    def _check_transports(self) -> None:
        """Check the transport of each address; faults in its form were reported before."""
        agent = self._config.agent
        addresses: list[tuple[KeyPath, str]] = [(("agent", "listen"), it) for it in agent.listen]
        addresses += [(("agent", "peers", index), peer) for index, peer in enumerate(agent.peers)]
        known = self._plugins.names(TRANSPORTS) if addresses else []
        for key, text in addresses:
            try:
                scheme = parse_address(text).scheme
            except ValueError:
                continue
            if scheme not in known and self._missing is not None:
                self._missing.add(f"{scheme}://")
            elif scheme not in known:
                command = to_install(TRANSPORTS, scheme, known)
                problem = f"unknown transport {scheme!r} in {text!r}" + (f": {command}" if command else "")
                self._fault(key, problem, "" if command else suggestion(scheme, known))
            elif self._must_load:
                self._get(TRANSPORTS, scheme, key)
        self._check_transport_settings()

    def _check_transport_settings(self) -> None:
        """Check the settings of transports in the network's settings, by scheme."""
        network = self._config.services.get("network")
        given = network.settings.get("transports") if network is not None else None
        for scheme, settings in given.items() if isinstance(given, dict) else ():
            table = ("service", "network", "settings", "transports", scheme)
            found = self._get(TRANSPORTS, scheme, table)
            for problem in check_settings(found.Settings, settings) if found is not None else ():
                self._fault((*table, *problem.path), problem.text, problem.suggestion)

    def _check_services(self) -> None:
        from pancakes.services.device import DeviceService

        classes = {
            service.name: self._check_part(SERVICES, service.type, service.settings, ("service", service.name), "type")
            for service in self._config.services.values()
        }
        for name, cls in classes.items():
            if cls is not None and cls.only_name not in ("", name):
                problem = f"an agent has one service of the type {self._config.services[name].type!r}, and that is"
                self._fault(("service", name, "type"), f"{problem} [service.{cls.only_name}]")
        for device in self._config.devices.values():
            cls = classes.get(device.service)
            if cls is not None and not issubclass(cls, DeviceService):
                self._fault(("device", device.name, "service"), f"{device.service!r} is not a service for devices")

    def _check_devices(self) -> list[str] | None:
        """Check the devices and return their types; None if not all of them can be known."""
        from pancakes.devices.driver import Actuator

        device_types: list[str] | None = []
        for device in self._config.devices.values():
            table = ("device", device.name)
            found = self._check_part(DRIVERS, device.driver, device.settings, table, "driver")
            device_type = getattr(found, "type", None)
            if found is not None and not isinstance(device_type, str):
                problem = f"{device.driver!r} does not define the type of its device: a defect of its distribution"
                self._fault((*table, "driver"), problem)
            if not isinstance(device_type, str):
                device_types = None
            elif device_types is not None:
                device_types.append(device_type)
            if found is not None:
                self._check_rate(table, device.driver, found)
            for key in ("hold_after_mission_s", "drive_stop_s"):
                if found is not None and not issubclass(found, Actuator) and self._places.has(*table, key):
                    self._fault((*table, key), f"is for actuators, and {device.driver!r} is not one")
            silent_key = (*table, "silent_mission_s")
            if found is not None and issubclass(found, Actuator) and self._places.has(*silent_key):
                self._fault(silent_key, f"is for sensors, and {device.driver!r} is not one")
            elif found is not None:
                self._check_silence(table, device, found)
        return device_types

    def _check_filters(self) -> None:
        """Check the filters: each stands before an actuator whose commands it takes."""
        from pancakes.devices.driver import Actuator
        from pancakes.filters.chain import SETTING

        for filter_ in self._config.filters.values():
            table = ("filter", filter_.name)
            found = self._check_part(FILTERS, filter_.type, filter_.settings, table, "type")
            device = self._config.devices.get(filter_.device)
            try:
                driver = self._plugins.get(DRIVERS, device.driver) if device is not None and device.driver else None
            except PluginError:
                continue  # reported with the device
            if device is None or not isinstance(driver, type):
                continue
            if not issubclass(driver, Actuator):
                text = f"{filter_.device!r} is no actuator: filters are for commands, and {device.driver!r} takes none"
                self._fault((*table, "device"), text)
            elif found is not None and found.type not in ("", driver.type):
                text = f"{filter_.type!r} is for actuators of the type {found.type!r}, and {filter_.device!r} is of"
                self._fault((*table, "device"), f"{text} the type {driver.type!r}")
            elif SETTING in known_keys(driver.Settings):
                text = f"{device.driver!r} has a setting {SETTING!r} of its own, so it can have no filters"
                self._fault((*table, "device"), f"{text}: a defect of its distribution")

    def _check_rate(self, table: KeyPath, driver: str, found: type[Driver]) -> None:
        """Check that a sensor that needs a rate has one, and that no other device has one."""
        from pancakes.devices.driver import Actuator

        key = (*table, "rate_hz")
        given = self._places.has(*key)
        if found.rate == "needed" and not given:
            self._fault(key, f"is missing: {driver!r} has a reading only at a rate, such as `rate_hz = 1`")
        elif found.rate == "none" and given:
            hint = ": `settings.max_hz` bounds them" if "max_hz" in known_keys(found.Settings) else ""
            self._fault(key, f"is not for {driver!r}, whose readings come when its hardware has them{hint}")
        elif given and issubclass(found, Actuator) and found.tick is Actuator.tick:
            self._fault(key, f"is not for {driver!r}, which does nothing at a rate")

    def _check_silence(self, table: KeyPath, device: DeviceConfig, found: type[Driver]) -> None:
        """Check that a sensor does not count as silent before its next reading can come."""
        given = device.silent_mission_s is not None
        silent_s = device.silent_mission_s if given else getattr(found, "silent_s", None)
        if device.rate_hz and silent_s is not None and silent_s <= 1 / device.rate_hz:
            apart = f"{1 / device.rate_hz:g} s, the time between two readings at `rate_hz = {device.rate_hz:g}`"
            text = f"must be longer than {apart}"
            default = "" if given else f"; {device.driver!r} has {silent_s:g} s unless it is given"
            self._fault((*table, "silent_mission_s"), text + default)

    def _check_requires(self, task: TaskConfig, cls: Any | None, device_types: list[str] | None) -> None:
        if cls is None or device_types is None:
            return
        missing = [need for need in _strings(getattr(cls, "requires", ())) if need not in device_types]
        if missing:
            there = ", ".join(dict.fromkeys(device_types)) or "no device"
            kinds = f"device of the type {missing[0]}" if len(missing) == 1 else f"devices: {', '.join(missing)}"
            needs = f"needs a {kinds}" if len(missing) == 1 else f"needs {kinds}"
            near = suggestion(missing[0], device_types) if len(missing) == 1 else ""
            self._fault(("task", task.name, "type"), f"{needs}; this agent has {there}", near)

    def _check_rule(self, rule: MigrationRule, table: KeyPath) -> None:
        if isinstance(rule.cost, str):
            if rule.cost:  # an empty one was reported before
                self._get(COSTS, rule.cost, (*table, "cost"))
        else:
            for name in rule.cost:
                self._get(COSTS, name, (*table, "cost", name))
        if rule.allocated or not rule.when or self._broken:
            return  # a module that could not be imported may define this type
        body = body_class(rule.when)
        if body is None:
            self._fault(
                (*table, "when"), f"unknown type of packets {rule.when!r}", suggestion(rule.when, known_types())
            )
        elif rule.field not in (known := field_names(body)):
            key = (*table, "field") if self._places.has(*table, "field") else table
            problem = f"a packet of the type {rule.when!r} has no field {rule.field!r}, but {', '.join(known)}"
            self._fault(key, problem, suggestion(rule.field, known))


def _is_class_of(group: str, found: Any) -> bool:
    """Return whether a plug-in is a class of the kind that its group requires."""
    return isinstance(found, type) and issubclass(found, _base_of(group))


def _base_of(group: str) -> type:
    from pancakes.devices.driver import Driver  # late: only reading a file needs no kernel
    from pancakes.filters.filter import Filter
    from pancakes.service import Service
    from pancakes.task import Task

    return {DRIVERS: Driver, FILTERS: Filter, SERVICES: Service, TASKS: Task}[group]


def _shown(found: Any) -> str:
    name = getattr(found, "__qualname__", "") or type(found).__qualname__
    return f"the class {name}" if isinstance(found, type) else f"{type(found).__name__} {name}"


def _strings(value: Any) -> list[str]:
    """Return the strings of a value; `requires = ("pose")` is one string, and meant as one type."""
    if isinstance(value, str):
        return [value]
    return [item for item in value if isinstance(item, str)] if isinstance(value, Iterable) else []


def doubts_of(config: Config) -> list[Fault]:
    """Return doubts about a configuration for an agent of this machine, each with its place in the file.

    Names of hosts are looked up, which may take some seconds.
    """
    places = config.places
    tells = any(task.type == "energy.reserve" for task in config.tasks.values())
    no_reserve = (
        "no task of the type 'energy.reserve' is here, so this rule does nothing unless a task of yours tells one"
    )
    return [
        *(
            places.fault(("agent", "listen"), f"{why}. {ADVICE.capitalize()}")
            for address in config.agent.listen
            if (why := would_be_near_only(address))
        ),
        *(
            places.fault(("task", task.name, "migrate", "when"), no_reserve)
            for task in config.tasks.values()
            if task.migrate and task.migrate.when == "reserve" and not tells
        ),
    ]
