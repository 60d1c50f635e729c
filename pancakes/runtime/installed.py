"""Task types and cost functions that an agent has installed."""

from __future__ import annotations

from collections.abc import Mapping

from pancakes.errors import PluginError
from pancakes.mesh.migration.cost import Cost
from pancakes.runtime.plugins import Plugins
from pancakes.task import Task


class Installed:
    """Finds task types and cost functions for the services that take tasks in. Any thread.

    Args:
        plugins: where they are found.
    """

    def __init__(self, plugins: Plugins) -> None:
        self._plugins = plugins

    def find(self, type_name: str) -> tuple[type[Task], str]:
        """Returns a task's class, and the version of its distribution.

        Raises:
            PluginError: there is none of this name, or it cannot be imported.
        """
        cls = self._plugins.get("pancakes.tasks", type_name)
        return cls, self._plugins.version("pancakes.tasks", type_name).version

    def at_hand(self, type_name: str) -> bool:
        """Returns whether a question about a task type is answered without an import."""
        return self._plugins.at_hand("pancakes.tasks", type_name)

    def version_of(self, type_name: str) -> str | None:
        """Returns the version in which a task type is installed and can be imported; None where it is not."""
        try:
            return self.find(type_name)[1]
        except PluginError:
            return None

    def costs(self) -> Mapping[str, Cost]:
        """Returns the cost functions by name, without those that cannot be made."""
        costs: dict[str, Cost] = {}
        for name in self._plugins.names("pancakes.costs"):
            try:
                costs[name] = self._plugins.get("pancakes.costs", name)()
            except (Exception, SystemExit):  # the constructor of a plug-in may raise anything
                continue
        return costs
