"""What the parts of a hosting service need of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from pancakes.mesh.migration.guards import GuardianId
from pancakes.mesh.migration.snapshot import Posted
from pancakes.packet import Packet
from pancakes.runtime.hosting.host_state import HostState
from pancakes.runtime.hosting.machine import AnyEvent
from pancakes.runtime.hosting.place import Place
from pancakes.runtime.hosting.places import Places
from pancakes.runtime.hosting.shared_outbox import SharedOutbox
from pancakes.runtime.kernel.keep import Keep
from pancakes.runtime.kernel.kernel import Kernel
from pancakes.runtime.kernel.reference import Reference
from pancakes.runtime.life.request import Request
from pancakes.runtime.supervision.slot import Slot
from pancakes.runtime.supervision.task_messages import Carried
from pancakes.task import TaskSpec


class HostingService(Reference, Protocol):
    """A service that hosts tasks. All in its actor."""

    kernel: Kernel
    slots: dict[str, Slot]
    places: Places
    residents: frozenset[str]
    outbox: SharedOutbox
    state: HostState
    closing: bool

    def subscribe(
        self, channel: str, body: type | str | None, handler: Callable[[Packet], None], keep: Keep = ...
    ) -> None: ...

    def feed_place(self, place: Place, event: AnyEvent | None) -> None:
        """Feeds an event to a task, and carries out what follows; None: nothing has happened to it."""

    def snapshot(self, slot: Slot, carried: Carried | None, posted: Posted | None = None) -> bytes:
        """Returns a task as data, encoded."""

    def snapshot_at_rest(self, slot: Slot) -> bytes:
        """Returns a task that does not run as data, encoded; empty: what its record has is what counts."""

    def look_after(self, place: Place, request: Request) -> None:
        """Sees to it that a request which waits for the journal is told so in time."""

    def drop_state(self, slot: Slot) -> None: ...

    def admit(self, slot: Slot) -> str: ...

    def first_guardian(self, place: Place, snapshot: bytes = b"") -> GuardianId | None:
        """Returns the first guardian of a task that begins here: this agent; None: the task is not guarded."""

    def connected(self, agent: str) -> bool:
        """Returns whether there is a link to an agent now."""

    def open_slot(self, spec: TaskSpec) -> Slot: ...

    def hold_actuators(self, slot: Slot, reason: str) -> None: ...

    def reply(self, request: Request, reason: str = "", result: Any = None) -> None: ...

    def put_off(self, request: Request, reason: str) -> None: ...

    def waits(self, request: Request) -> bool: ...

    def publish(self, channel: str, body: Any, to: str = "") -> Any: ...

    def log(self, level: str, text: str) -> None: ...

    def event(self, kind: str, /, **fields: Any) -> None: ...

    def call(self, function: Callable[[], None]) -> Any: ...

    def after_host(self, delay_s: float, function: Callable[[], None]) -> Any: ...
