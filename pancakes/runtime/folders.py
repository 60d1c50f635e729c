"""The folders below which a control packet, or a task from elsewhere, may have files written."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import Any

from pancakes.runtime.foundation.user_folders import NoPath, at_home
from pancakes.settings import dotted, paths_in, plain_settings


class Folders:
    """The folders that an agent's configuration names in `[agent] folders`, and the files that its settings name.

    A path that its class has as its default may be set, too: the code that is installed here says so.

    Args:
        agent: the agent's name, for which `{agent}` stands in a path.
        folders: the folders.
        files: the paths of the files.
    """

    def __init__(self, agent: str, folders: Iterable[str] = (), files: Iterable[str] = ()) -> None:
        self._agent = agent
        self._folders = tuple(self._real(folder) for folder in folders)
        self._files = frozenset(self._real(path) for path in files)

    def refusal_of(self, cls: type, settings: Mapping[str, Any]) -> str:
        """Returns why settings of a class may not be set from elsewhere; empty: they may."""
        for key, path in paths_in(cls, settings):
            if path and not self._holds(path) and path != _usual(cls).get(key):
                names = ", ".join(self._folders) or "none"
                return (
                    f"{dotted(key)}: {path!r} lies outside of the folders that the configuration of {self._agent} names"
                    f" ({names}): add its folder to folders in [agent] there"
                )
        return ""

    def _holds(self, path: str) -> bool:
        try:
            real = self._real(path)
        except (ValueError, NoPath):
            return False
        below = (folder for folder in self._folders if real != folder)  # a name may get an end yet: FOLDER.mcap
        return real in self._files or any(os.path.commonpath((real, folder)) == folder for folder in below)

    def _real(self, path: str) -> str:
        return os.path.realpath(at_home(path).replace("{agent}", self._agent))


def _usual(cls: type) -> dict[tuple[str | int, ...], str]:
    """Returns the paths that settings of a class have where nothing is set."""
    try:
        return dict(paths_in(cls, plain_settings(cls())))
    except (Exception, SystemExit):  # something must be set, or the class refuses itself as it is
        return {}
