"""Read the new version of a distribution's task types, while the one in use goes on.

`prepare` imports it beside the one in use, so an import that fails changes nothing. `NewVersion.install` makes it the
agent's own: tasks that begin from then on, and those that arrive, are of the new classes.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from types import ModuleType
from typing import Any, Final

import msgspec

from pancakes.errors import ControlRefusedError, PluginError
from pancakes.packet import THREAD, NewTypes, new_types
from pancakes.settings import check_settings
from pancakes.task import Task
from pancakes.util.class_versions import module_differs
from pancakes.util.plugins import GROUPS, Plugins
from pancakes.util.reimport import Reimported, is_below, reimport, roots_of, users_of

TASKS: Final = "pancakes.tasks"
REPLACED: Final = (TASKS, "pancakes.packets")
"""The groups whose plug-ins are replaced while an agent runs."""
IN_USE: Final = ("pancakes.drivers", "pancakes.services", "pancakes.filters", "pancakes.transports", "pancakes.costs")
"""The groups whose plug-ins go on as they are until their agent starts again."""


class NewVersion(msgspec.Struct, frozen=True):
    """The version of a distribution that is on disk, imported beside the one in use.

    Attributes:
        distribution: its name.
        before: the version in use; empty: the agent did not know the distribution.
        version: the new one.
        classes: the new classes of task types, by type.
        stays: the plug-ins that go on as they are, each as its group's word and its name.
    """

    distribution: str
    before: str
    version: str
    classes: Mapping[str, type[Task]]
    stays: tuple[str, ...]
    _plugins: Plugins
    _now: Plugins
    _modules: Reimported[NewTypes]

    @property
    def replaces_packets(self) -> bool:
        """Whether a packet type has another form now: what still waits for a task is of the old one."""
        return bool(self._modules.found.replaced)

    def forget(self) -> None:
        """Leave the agent's own version as it is, for good. Any thread."""
        self._modules.found.forget()

    def install(self) -> None:
        """Make this the version of the agent, for all that begins from now on. Any thread."""
        self._modules.install()
        self._modules.found.install()
        self._plugins.replace(self.distribution, self._now)


def prepare(plugins: Plugins, type_name: str) -> NewVersion:
    """Import the task types of a distribution as they are on disk, beside those in use. May take long.

    All modules of the distribution's packages are imported again, as one may have changed that others import. So its
    other task types that are in use are replaced as well.

    Args:
        plugins: the plug-ins of the agent.
        type_name: one of its task types.

    Raises:
        PluginError: the type is not installed, or the import fails; the message has the file and line.
        ControlRefusedError: it cannot be replaced while the agent runs; the message says why.
    """
    _must_not_be_other(plugins, type_name)
    importlib.invalidate_caches()  # those of metadata too
    now = plugins.again()
    source = now.version(TASKS, type_name)
    if not source.distribution:
        raise ControlRefusedError(
            f"the program that started the agent brings the task type {type_name!r} itself, so there is no file to"
            " import it from again",
            "unsupported",
        )
    if source.distribution == "pancakes-agents":
        raise ControlRefusedError(
            f"{type_name!r} is a part of Pancakes, which is not replaced while it runs: restart the agent",
            "unsupported",
        )
    used = plugins.used_of(source.distribution)
    known = [it for it in used if it[0] in REPLACED and it[1] in now.names(it[0])]
    wanted = sorted({(TASKS, type_name), *known})
    places = [plugins.place(group, name) for group, name in used] + [now.place(TASKS, type_name)]
    roots = roots_of(place.partition(":")[0].strip() for place in places)
    if any(is_below(root, ("pancakes",)) for root in roots):
        raise ControlRefusedError(
            f"{source.distribution} has modules in the package `pancakes`, which is not replaced while it runs:"
            " restart the agent",
            "unsupported",
        )
    modules = reimport(roots, lambda before: _load(now, wanted, before), _stays)
    gone = [it for it in used if it[0] == TASKS and it not in known]  # their tasks go on, and no new one begins
    stays = tuple(f"{GROUPS[group]} {name}" for group, name in used if group in IN_USE or (group, name) in gone)
    try:
        _must_fit_others(source.distribution, modules, roots, stays)
    except ControlRefusedError:
        modules.found.forget()
        raise
    classes = {name: now.get(TASKS, name) for group, name in wanted if group == TASKS}
    before = plugins.version_of(source.distribution)
    return NewVersion(source.distribution, before, source.version, classes, stays, plugins, now, modules)


def _must_not_be_other(plugins: Plugins, name: str) -> None:
    """Raise `ControlRefusedError` if a name is not that of a task type, but of something else that an agent runs."""
    if name in plugins.names(TASKS):
        return
    for group in IN_USE:
        if name in plugins.names(group):
            raise ControlRefusedError(
                f"{name!r} is a {GROUPS[group]}: only task types are replaced while an agent runs, so restart the"
                " agent for a new version of it",
                "unsupported",
            )


def _load(now: Plugins, wanted: list[tuple[str, str]], before: Mapping[str, ModuleType]) -> NewTypes:
    """Import plug-ins, while their new modules are in `sys.modules`; gathers their packet types."""
    with new_types(lambda module: vars(before[module]) if module in before else {}) as gathered:
        for group, name in wanted:
            loaded: Any = now.get(group, name)
            if group == TASKS:
                if not (isinstance(loaded, type) and issubclass(loaded, Task)):
                    raise PluginError(f"the task type {name!r} is no class of tasks in {now.place(group, name)}")
                # Annotations that are strings are read in the module's names, so they are read now.
                check_settings(loaded.Settings, {})
                check_settings(loaded.State, {})
    return gathered


def _stays(before: ModuleType, after: ModuleType) -> bool:
    """Return whether a module has not changed: then what it defines is known to all as it is."""
    if module_differs(before, after):
        return False
    if THREAD.new_types is not None:
        THREAD.new_types.forget(after.__name__)
    return True


def _must_fit_others(
    distribution: str, modules: Reimported[NewTypes], roots: frozenset[str], stays: tuple[str, ...]
) -> None:
    """Raise `ControlRefusedError` if a packet type has another form, and others would go on with the old one."""
    replaced = modules.found.replaced
    if not replaced:
        return
    others = next(
        ((f"the module {name} uses it", cls) for name, cls in users_of(tuple(replaced.values()), roots)), None
    )
    if others is None and stays:
        others = (f"the {stays[0]} of {distribution} may use it", next(iter(replaced.values())))
    if others is not None:
        why, cls = others
        name = next(name for name, one in replaced.items() if one is cls)
        raise ControlRefusedError(
            f"the packet type {name!r} has another form in the new version, and {why} in its old form: restart the"
            " agent",
            "unable",
        )
