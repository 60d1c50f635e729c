"""Control packets for tasks that no configuration file names; `pancakes.control` has all others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from pancakes.packet import packet_type


@packet_type("create")
class Create(msgspec.Struct, frozen=True):
    """Makes a task that no configuration file names, and starts it; the answer comes once it runs.

    From then on it is like one that a file names: it outlives its agent's end, is moved and guarded, until `Remove`
    asks for its end. The asker needs the right `host` on its type too. The reply's `result` is a mapping: `task_id`,
    `epoch`, and `silent`, the agents that were asked in vain whether they know of such a task.

    Attributes:
        target: its name, or `service/name`; without a service, it is the Client Service's.
        type: name of its class, such as `encirclement.ScanTarget`.
        settings: plain values for its settings.
        rate_hz: the rate of its first timer; None: as its class says.
        keys: the other keys that its table `[task.NAME]` would have in a file, such as `guard` and `restart`.
        dry_run: only says whether it would be done, and changes nothing.
    """

    target: str
    type: str
    settings: Mapping[str, Any] = {}
    rate_hz: float | None = None
    keys: Mapping[str, Any] = {}
    dry_run: bool = False


@packet_type("remove")
class Remove(msgspec.Struct, frozen=True):
    """Ends a task that no configuration file names, for good: it stops, and what was known of it is forgotten.

    The answer comes once that is on disk. A later task of its name begins without its state.

    Attributes:
        target: the task.
        dry_run: only says whether it would be done, and changes nothing.
    """

    target: str
    dry_run: bool = False
