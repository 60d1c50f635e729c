"""Find the task types and cost functions that are installed on an agent, for services that take tasks in."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import TYPE_CHECKING

from pancakes.errors import PluginError
from pancakes.migration import Cost
from pancakes.task import Task
from pancakes.util.plugins import Plugins, UnknownPluginError

if TYPE_CHECKING:
    from pancakes.durable.reload_types import NewVersion


class Installed:
    """Finds task types and cost functions for the services that take tasks in. Any thread.

    Args:
        plugins: where they are found.
    """

    def __init__(self, plugins: Plugins) -> None:
        self._plugins = plugins
        self._costs: dict[str, Cost] | None = None

    def find(self, type_name: str) -> tuple[type[Task], str]:
        """Returns a task's class, and the version of its distribution.

        Raises:
            PluginError: there is none of this name, or it cannot be imported.
        """
        cls = self._plugins.get("pancakes.tasks", type_name)
        return cls, self._plugins.version("pancakes.tasks", type_name).version

    def prepare(self, type_name: str) -> NewVersion:
        """Import the version of a task type's distribution that is on disk; see `reload_types.prepare`. May take long.

        Raises:
            PancakesError: it cannot be imported, or not replaced; the message says why.
        """
        from pancakes.durable.reload_types import prepare  # few agents are ever asked

        return prepare(self._plugins, type_name)

    def at_hand(self, type_name: str) -> bool:
        """Returns whether a question about a task type is answered without an import."""
        return self._plugins.at_hand("pancakes.tasks", type_name)

    def version_of(self, type_name: str) -> str | None:
        """Returns the version in which a task type is installed and can be imported; None: it is not."""
        try:
            return self.find(type_name)[1]
        except PluginError:
            return None

    def fault_of(self, type_name: str) -> str:
        """Returns why an installed task type cannot be loaded; empty: it can, or is not installed."""
        try:
            self.find(type_name)
        except UnknownPluginError:
            return ""
        except PluginError as error:
            return str(error)
        return ""

    def costs(self) -> Mapping[str, Cost]:
        """Returns the cost functions by name, without those that cannot be made; each is made once."""
        if self._costs is None:
            costs: dict[str, Cost] = {}
            for name in self._plugins.names("pancakes.costs"):
                with suppress(Exception, SystemExit):  # the constructor of a plug-in may raise anything
                    costs[name] = self._plugins.get("pancakes.costs", name)()
            self._costs = costs
        return self._costs
