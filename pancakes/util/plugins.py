"""Find plug-ins by entry point: those of the core and of other distributions alike.

The metadata of a distribution names its plug-ins:

    [options.entry_points]
    pancakes.tasks =
        encirclement.ScanTarget = pancakes_encirclement.scan_target:ScanTarget

Nothing is imported before it is asked for. A bad plug-in is reported by name and does not affect the others.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from functools import cache, partial
from itertools import islice
from typing import Any, Final, NamedTuple

import msgspec

from pancakes.errors import ClassError, PluginError, chain_of
from pancakes.util.class_checks import check_loaded
from pancakes.util.entry_points import Distribution, distributions, load, points_in
from pancakes.util.text import suggestion

GROUPS: Final = {
    "pancakes.tasks": "task type",
    "pancakes.services": "service type",
    "pancakes.drivers": "driver",
    "pancakes.filters": "filter",
    "pancakes.costs": "cost",
    "pancakes.transports": "transport",
    "pancakes.packets": "packet module",
    "pancakes.demos": "demo",
    "pancakes.commands": "command",
    "pancakes.robot_models": "robot model",
}
"""The entry point groups, each with the word for one of its entries."""

BROUGHT_BY: Final = {
    "pancakes.tasks": {
        "encirclement": "pancakes-encirclement",
        "robotarium": "pancakes-robotarium",
        "ros2": "pancakes-ros2",
        "sensor_field": "pancakes-sensor-field",
    },
    "pancakes.services": {"mqtt": "pancakes-mqtt", "ros2": "pancakes-ros2"},
    "pancakes.drivers": {
        "khepera3": "pancakes-pi",
        "mqtt": "pancakes-mqtt",
        "pi": "pancakes-pi",
        "robotarium": "pancakes-robotarium",
        "ros2": "pancakes-ros2",
        "sensor_field": "pancakes-sensor-field",
    },
    "pancakes.costs": {"encirclement": "pancakes-encirclement"},
    "pancakes.transports": {"zenoh": "pancakes-zenoh"},
    "pancakes.demos": {
        "encirclement": "pancakes-encirclement",
        "endless": "pancakes-robotarium",
        "energy": "pancakes-encirclement",
        "intruder": "pancakes-encirclement",
        "pioneer": "pancakes-encirclement",
        "rescue": "pancakes-encirclement",
        "robotarium": "pancakes-robotarium",
        "ros2": "pancakes-ros2",
        "sensor-field": "pancakes-sensor-field",
    },
    "pancakes.commands": {"rosbag": "pancakes-ros2", "zenoh": "pancakes-zenoh"},
    "pancakes.robot_models": {"gternal": "pancakes-robotarium"},
}
"""Pancakes' own distributions besides the core, by group and by the part of a name before the dot."""


class UnknownPluginError(PluginError):
    """No distribution offers a plug-in of this name.

    Attributes:
        problem: the sentence without its suggestion.
        suggestion: what was probably meant, or an empty string.
    """

    def __init__(self, problem: str, near: str) -> None:
        self.problem = problem
        self.suggestion = near
        super().__init__(f"{problem}, did you mean {near!r}?" if near else problem)


class Version(NamedTuple):
    """The source of a plug-in. Both are empty for one that was registered in code."""

    distribution: str
    version: str


class Offered(NamedTuple):
    """One entry point, as its distribution states it; it may not work.

    Attributes:
        name: its name.
        place: `module:attribute`; empty for one that was registered in code.
        version: its distribution.
    """

    name: str
    place: str
    version: Version


class _Offer(msgspec.Struct, frozen=True):
    """One entry point of one distribution; `load` imports it, and `on_disk` reads the distribution's version again."""

    version: Version
    value: str
    load: Callable[[], Any]
    on_disk: Callable[[], str] = lambda: ""


_Offers = dict[str, list[_Offer]]
"""The offers of one group, by name; several with one name are an error."""


class Plugins:
    """All plug-ins of this Python environment. May be asked from any thread.

    Args:
        extra: plug-ins that are registered in code, by (group, name); they hide installed ones of the same name.
    """

    def __init__(self, extra: Mapping[tuple[str, str], Any] | None = None) -> None:
        self._extra = dict(extra or {})
        for group, _ in self._extra:
            _check_group(group)
        self._installed: dict[str, _Offers] | None = None
        self._unreadable: list[PluginError] = []
        self._loaded: dict[tuple[str, str], Any] = {}
        self._broken: dict[tuple[str, str], str] = {}

    def names(self, group: str) -> list[str]:
        """Return the names of all plug-ins of a group, sorted."""
        return sorted(self._offers(group))

    def get(self, group: str, name: str) -> Any:
        """Return a plug-in, importing it at the first call.

        Raises:
            UnknownPluginError: no distribution offers it.
            PluginError: it cannot be imported, or two distributions offer it. The message names the distribution
                and the reason.
        """
        key = (group, name)
        if key in self._broken:
            raise PluginError(self._broken[key])
        if key not in self._loaded:
            try:
                self._loaded.setdefault(key, _load(group, name, self._find(group, name)))
            except UnknownPluginError:
                raise
            except PluginError as error:
                self._broken[key] = str(error)
                raise
        return self._loaded[key]

    def at_hand(self, group: str, name: str) -> bool:
        """Return whether `get` needs no import: it was called before, or there is nothing to import."""
        key = (group, name)
        return key in self._loaded or key in self._broken or key in self._extra or name not in self._offers(group)

    def offered(self, group: str) -> list[Offered]:
        """Return all entry points of a group, by name; including those that are offered twice. Imports nothing."""
        return [
            Offered(name, offer.value, offer.version)
            for name, offers in sorted(self._offers(group).items())
            for offer in sorted(offers, key=lambda offer: offer.version)
        ]

    def version(self, group: str, name: str) -> Version:
        """Return the distribution that offers a plug-in, and its version. Imports nothing.

        Raises:
            UnknownPluginError: no distribution offers it.
            PluginError: two distributions offer it.
        """
        return self._find(group, name).version

    def brings_tasks(self) -> dict[str, str]:
        """Return the version of each distribution that offers task types. Imports nothing."""
        offers = (offer for several in self._offers("pancakes.tasks").values() for offer in several)
        return dict(sorted({offer.version for offer in offers if offer.version.distribution}))

    def again(self) -> Plugins:
        """Return the plug-ins that are installed now; those that were registered in code are the same."""
        return Plugins(self._extra)

    def place(self, group: str, name: str) -> str:
        """Return the `module:attribute` of a plug-in; empty for one that was registered in code. Imports nothing.

        Raises:
            PluginError: no distribution offers it, or two do.
        """
        return self._find(group, name).value

    def used_of(self, distribution: str) -> list[tuple[str, str]]:
        """Return the group and name of each plug-in of a distribution that was imported, sorted."""
        own = self._named_by(distribution)
        return sorted(key for key in self._loaded if key in own)

    def version_of(self, distribution: str) -> str:
        """Return the version in which a distribution offers plug-ins; empty: it offers none. Imports nothing."""
        for group in GROUPS:
            for offers in self._offers(group).values():
                for offer in offers:
                    if offer.version.distribution == distribution:
                        return offer.version.version
        return ""

    def replace(self, distribution: str, now: Plugins) -> None:
        """Take a distribution as another instance has found and loaded it; what that has not loaded stays as it is.

        Args:
            distribution: its name.
            now: the other instance.
        """
        own = self._named_by(distribution)
        found: dict[str, _Offers] = {}
        for group in GROUPS:
            offers: _Offers = {}
            for plugins, is_wanted in ((self, False), (now, True)):
                for name, several in plugins.on_disk(group).items():
                    kept = [one for one in several if (one.version.distribution == distribution) is is_wanted]
                    if kept:
                        offers[name] = [*offers.get(name, ()), *kept]
            found[group] = offers
        self._loaded = {**self._loaded, **now.imported()}
        self._broken = {key: why for key, why in self._broken.items() if key not in own}  # it may work now
        self._installed = found

    def imported(self) -> Mapping[tuple[str, str], Any]:
        """Return the plug-ins that were imported, by group and name."""
        return dict(self._loaded)

    def on_disk(self, group: str) -> _Offers:
        """Return the entry points of a group without those that were registered in code, by name. Imports nothing."""
        self._offers(group)  # which reads all of them
        return dict((self._installed or {}).get(group, {}))

    def _named_by(self, distribution: str) -> set[tuple[str, str]]:
        """Return the group and name of each plug-in that a distribution offers."""
        return {
            (group, name)
            for group in GROUPS
            for name, offers in self._offers(group).items()
            if any(offer.version.distribution == distribution for offer in offers)
        }

    def load_packets(self) -> list[PluginError]:
        """Import all modules that register packet types.

        Returns:
            The plug-ins that failed; the others are registered.
        """
        failed = []
        for name in self.names("pancakes.packets"):
            try:
                self.get("pancakes.packets", name)
            except PluginError as error:
                failed.append(error)
        return failed

    def unreadable(self) -> list[PluginError]:
        """Return a sentence for each distribution whose entry points cannot be read."""
        self._offers("pancakes.tasks")  # which reads all of them
        return list(self._unreadable)

    def problems(self) -> list[PluginError]:
        """Return the faults so far: distributions that cannot be read, plug-ins that cannot be loaded."""
        return [*self._unreadable, *(PluginError(text) for text in self._broken.values())]

    def _offers(self, group: str) -> _Offers:
        _check_group(group)
        if self._installed is None:  # reading all metadata takes milliseconds, so only once, and late
            self._installed, self._unreadable = _scan()
        offers = dict(self._installed.get(group, {}))
        for (extra_group, name), plugin in self._extra.items():
            if extra_group == group:
                offers[name] = [_Offer(Version("", ""), "", lambda plugin=plugin: plugin)]  # type: ignore[misc]
        return offers

    def _find(self, group: str, name: str) -> _Offer:
        """Return the only offer of a name."""
        offers = self._offers(group)
        if name not in offers:
            raise _unknown(group, name, list(offers))
        if len(offers[name]) > 1:
            several = sorted(offers[name], key=lambda offer: offer.version)
            sources = " and ".join(f"{offer.version.distribution} ({offer.value})" for offer in several)
            raise PluginError(f"the {GROUPS[group]} {name!r} is offered twice, by {sources}: uninstall one of them")
        return offers[name][0]


@cache
def installed() -> Plugins:
    """Return the plug-ins of this environment, for code that is not handed any: they are looked for once a process."""
    return Plugins()


def _check_group(group: str) -> None:
    if group not in GROUPS:
        raise ValueError(f"{group!r} is not a group of plug-ins; the groups are {', '.join(GROUPS)}")


def _load(group: str, name: str, offer: _Offer) -> Any:
    version = offer.version
    if (now := offer.on_disk()) != version.version:
        # Its modules would be of another version than those that are loaded already.
        how = f"on disk it is {now} now" if now else "it is not on disk any more"
        command = f"`pancakes task reload {name}`, or " if now and group == "pancakes.tasks" else ""
        raise PluginError(
            f"the {GROUPS[group]} {name!r} of {version.distribution} {version.version} cannot be loaded: {how}:"
            f" {command}restart the agent"
        )
    try:
        found = offer.load()
        check_loaded(found)
    except ClassError as error:  # its message has the place
        raise PluginError(f"the {GROUPS[group]} {name!r}{_source(offer)} cannot be loaded: {error}") from None
    except (Exception, SystemExit) as error:  # an import may raise anything, and a script even ends the process
        raise PluginError(f"the {GROUPS[group]} {name!r}{_source(offer)} cannot be loaded: {_line(error)}") from None
    return found


def _source(offer: _Offer) -> str:
    """Return the source of a plug-in, for a message; empty for one that was registered in code."""
    version = offer.version
    return f" of {version.distribution} {version.version} ({offer.value})" if version.distribution else ""


def to_install(group: str, name: str, known: Collection[str]) -> str:
    """Return the command that installs the distribution of a plug-in; empty: unknown.

    Args:
        group: its group.
        name: its name.
        known: the names of the group that are installed.
    """
    family = name.partition(".")[0]
    distribution = BROUGHT_BY.get(group, {}).get(family, "")
    is_there = any(other.partition(".")[0] == family for other in known)
    return f"pip install {distribution}" if distribution and not is_there else ""


def _unknown(group: str, name: str, known: list[str]) -> UnknownPluginError:
    problem = f"unknown {GROUPS[group]} {name!r}"
    if command := to_install(group, name, known):
        return UnknownPluginError(f"{problem}: {command}", "")
    family = f"{name.partition('.')[0]}."
    if "." in name and not any(other.startswith(family) for other in known):
        problem += f": no installed distribution provides {group.removeprefix('pancakes.')} under {family!r}"
    return UnknownPluginError(problem, suggestion(name, known))


def _line(error: BaseException) -> str:
    """Return an exception in one line: where it was raised, through which files, and its causes."""
    parts: list[str] = []
    for cause in islice(chain_of(error), MOST_CAUSES):
        message = " ".join(str(cause).split())
        text = f"{type(cause).__name__}: {message}" if message else type(cause).__name__
        way = _way(cause)
        parts.append(f"{text} ({way})" if way else text)
    return ", because of ".join(parts)


def _way(error: BaseException) -> str:
    """Return the lines through which an exception came, without those of Python's import system."""
    from traceback import walk_tb  # only if something went wrong

    way = []
    for frame, line in walk_tb(error.__traceback__):
        path = frame.f_code.co_filename
        if not path.startswith("<frozen ") and frame.f_globals.get("__name__") not in _LOADING:
            way.append(f"{path.rpartition('/')[2]}:{line}")
    return " > ".join(way[-MOST_LINES:])


_LOADING: Final = (__name__, "pancakes.util.entry_points", "importlib")
MOST_CAUSES: Final = 4
MOST_LINES: Final = 4


def _scan() -> tuple[dict[str, _Offers], list[PluginError]]:
    """Read the plug-ins of all installed distributions."""
    groups: dict[str, _Offers] = {group: {} for group in GROUPS}
    unreadable = []
    seen = []
    for distribution in distributions():
        try:
            text = distribution.read("entry_points.txt") or ""
            if "pancakes." not in text:
                continue  # nearly always: its header need not be read
            points = [point for point in points_in(text) if point.group in GROUPS]
            if not points:
                continue
            version = Version(distribution.header("Name"), distribution.header("Version"))
        except Exception as error:  # foreign files may contain anything
            place = f"{_name_of(distribution)} in {distribution.root}"
            unreadable.append(PluginError(f"the entry points of {place} cannot be read: {_line(error)}"))
            continue
        if version.distribution in seen:
            continue  # found again later in sys.path, such as an editable install in its own directory
        seen.append(version.distribution)
        on_disk = partial(_version_on_disk, version.distribution, distribution)
        for point in points:
            offer = _Offer(version, point.place, partial(load, point.place), on_disk)
            same = groups[point.group].setdefault(point.name, [])
            if all(other.version != offer.version or other.value != offer.value for other in same):
                same.append(offer)
    return groups, unreadable


def _version_on_disk(name: str, distribution: Distribution) -> str:
    """Return the version of a distribution as it is on disk now; empty: it was removed."""
    with suppress(ValueError, OSError):
        return distribution.header("Version")
    for other in distributions():  # that of another version is in a folder of its own
        with suppress(Exception):  # foreign files may contain anything
            if other.header("Name") == name:
                return other.header("Version")
    return ""


def _name_of(distribution: Distribution) -> str:
    try:
        return distribution.header("Name")
    except (ValueError, OSError):
        return "a distribution"
