"""What an agent remembers of the boots of others, so that a backup which was restored is noticed. Pure."""

from __future__ import annotations

from typing import Annotated, Final, NamedTuple

import msgspec

from pancakes.packet import packet_type

MOST_JOURNALS: Final = 4
"""Of so many journals of one agent the boots are remembered, the newest: a disk that was replaced may come back."""


class Boot(NamedTuple):
    """One life of an agent.

    Attributes:
        journal: the id of its journal.
        number: how often that was opened.
        life: drawn anew at each opening.
    """

    journal: str
    number: int
    life: str

    def is_before(self, other: Boot) -> bool:
        """Returns whether a disk that is at this boot lacks what happened in the other one."""
        if self.journal != other.journal:
            return False
        return self.number < other.number or (self.number == other.number and self.life != other.life)


class BootsSeen(msgspec.Struct, frozen=True):
    """What an agent remembers of another one.

    Attributes:
        boots: its latest boot with each journal, the journal that was met last at the end.
    """

    boots: tuple[Boot, ...] = ()

    def after(self, boot: Boot) -> Boot | None:
        """Returns what is remembered and cannot be: that boot has a disk without it. None: there is nothing."""
        return next((known for known in self.boots if boot.is_before(known)), None)

    def with_(self, boot: Boot) -> BootsSeen:
        """Returns what is remembered once that boot was met; of a copy nothing is."""
        if boot in self.boots or self.after(boot) is not None:
            return self
        others = tuple(known for known in self.boots if known.journal != boot.journal)
        return BootsSeen((*others, boot)[-MOST_JOURNALS:])


@packet_type("task.boot")
class BootRemembered(msgspec.Struct, frozen=True):
    """Tells the census of an agent that its disk is an old copy, as the sender remembers a later boot of its journal.

    Attributes:
        journal: the id of that journal.
        number: the latest boot that the sender remembers.
        life: what was drawn at it.
    """

    journal: Annotated[str, msgspec.Meta(max_length=64)]
    number: int
    life: Annotated[str, msgspec.Meta(max_length=64)]

    @property
    def boot(self) -> Boot:
        """The boot that the sender remembers."""
        return Boot(self.journal, self.number, self.life)
