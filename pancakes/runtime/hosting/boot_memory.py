"""The boots of other agents, as this one remembers them on disk."""

from __future__ import annotations

from typing import Final

from pancakes.mesh.migration.boots import Boot, BootsSeen
from pancakes.runtime.foundation import codecs
from pancakes.runtime.journal import Disk, RecordTable

KIND: Final = "boot"
MOST_AGENTS: Final = 1024
"""The boots of so many agents are remembered; of further ones none."""


class BootMemory:
    """What is remembered of the boots of other agents. One thread at a time.

    It lies on disk, because a fleet whose power has failed, or which is set up from backups, starts all at once: then
    no agent remembers what it has not written down. An agent has one entry, and a new boot costs one write.

    Args:
        disk: what it is kept on.
    """

    def __init__(self, disk: Disk) -> None:
        self._table = RecordTable(disk, KIND, codecs.decoder(BootsSeen), lambda key, why: None)

    def knows_any(self) -> bool:
        """Returns whether there is an agent that this one has ever met."""
        return bool(self._table.newest)

    def met(self, agent: str, boot: Boot) -> Boot | None:
        """Learns of a boot of an agent; returns the later one that is remembered, where its disk is an old copy."""
        known = self._table.newest.get(agent, BootsSeen())
        later = known.after(boot)
        seen = known.with_(boot)
        if seen != known and (agent in self._table.newest or len(self._table.newest) < MOST_AGENTS):
            # What cannot be written is remembered until this agent ends; its journal tells people.
            self._table.write(agent, seen, lambda: None, lambda why: None)
        return later
