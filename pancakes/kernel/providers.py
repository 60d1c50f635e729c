"""What an agent gives its kernel: the kernel knows neither the mesh nor the guards of tasks, only these interfaces."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from pancakes.packet import Fence, LocalTime
from pancakes.util.timebase import Timebase


class PeerClock(Protocol):
    """What is known of the clocks of another agent."""

    def local_time(self, stamp_s: float, own: Timebase) -> LocalTime | None:
        """Return a stamp of that agent on this agent's mission clock; None: not known, or a mission is held.

        Args:
            stamp_s: mission time there, in seconds.
            own: this agent's mission.
        """
        ...


class PeerRights(Protocol):
    """What other agents and terminals may do at this agent."""

    def fault(self, peer: str, right: Any, *on: str) -> str:
        """Return why a peer may not do something, as a sentence; empty: it may. Any thread.

        Args:
            peer: the name of the peer; the agent itself may do everything.
            right: the right that it needs, such as `control`.
            on: what for; if that has several names, one of them is enough.
        """
        ...

    @property
    def bearer_of(self) -> Callable[[str], tuple[Any, bool] | None]:
        """Takes the name of a peer; returns its bearer, and whether that is certified; None: it has no link."""


class NoPeers:
    """The rights of peers at an agent that has none."""

    def fault(self, peer: str, right: Any, *on: str) -> str:
        """See `PeerRights`: nobody is refused."""
        return ""

    def bearer_of(self, peer: str) -> None:
        """See `PeerRights`: nobody is known."""


class HaltNote:
    """Whether the actuators of an agent have to stand. Any thread reads it; the agent sets it.

    Attributes:
        why: why, as a clause: `halted by alice: a child on the field`; empty: they need not.
    """

    why: str = ""


class GuardNote(Protocol):
    """How a task is guarded, as its owner knows it."""

    @property
    def right(self) -> Fence:
        """The right under which it acts."""

    def plain(self, now_s: float, permit_s: float | None) -> dict[str, Any]:
        """Return it as plain values.

        Args:
            now_s: host time.
            permit_s: for how long the task may act yet; None or 0: it is paused.
        """
        ...


class GuardNotes:
    """The notes on guarded tasks that this agent owns, by address. Any thread; each task's service enters its own."""

    def __init__(self) -> None:
        self._notes: dict[str, GuardNote] = {}

    def enter(self, address: str, note: GuardNote) -> None:
        """Add what is known now."""
        self._notes[address] = note

    def drop(self, address: str) -> None:
        """Forget a task: it is not guarded any more, or not here."""
        self._notes.pop(address, None)

    def of(self, address: str) -> GuardNote | None:
        """Return what is known of a task; None: it is not guarded, or not owned here."""
        return self._notes.get(address)

    def all(self) -> Mapping[str, GuardNote]:
        """Return all notes, by address."""
        return dict(self._notes)
