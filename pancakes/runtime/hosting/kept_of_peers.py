"""What an agent keeps on disk of what its peers have brought, beside the bounds: for people."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

from pancakes.mesh.guarding.guardian_core import GuardRegister
from pancakes.mesh.migration.record import Phase, Record
from pancakes.runtime.hosting.arrivals import MOST_IN_DOUBT, MOST_IN_DOUBT_BYTES, MOST_LEFT
from pancakes.runtime.hosting.guardian import MOST_BYTES, MOST_FORGOTTEN, MOST_TASKS

IN_DOUBT = "in doubt"
"""Tasks that a peer has brought and not handed over."""


def kept_of_peers(agent: str, records: Iterable[Record], registers: Iterable[GuardRegister]) -> list[dict[str, Any]]:
    """Returns a row for each peer and kind of thing, with how much of its room is taken, as plain values.

    Args:
        agent: the agent itself, which is no peer.
        records: what it has on disk of tasks.
        registers: what it has on disk as a guardian.
    """
    counts: Counter[tuple[str, str]] = Counter()
    sizes: Counter[tuple[str, str]] = Counter()
    for record in records:
        if record.phase is Phase.PREPARED:
            counts[record.peer, IN_DOUBT] += 1
            sizes[record.peer, IN_DOUBT] += len(record.snapshot)
        elif record.phase is Phase.ABSENT and record.peer:
            counts[record.peer, "taken back"] += 1
    for register in registers:
        kind = "removed" if register.guards.forgotten else "guarded"
        counts[register.promised.minter, kind] += 1
        sizes[register.promised.minter, kind] += len(register.body.snapshot) if register.body is not None else 0
    most = {
        IN_DOUBT: (MOST_IN_DOUBT, MOST_IN_DOUBT_BYTES),
        "taken back": (MOST_LEFT, 0),
        "guarded": (MOST_TASKS, MOST_BYTES),
        "removed": (MOST_FORGOTTEN, 0),
    }
    rows = []
    for (peer, kind), count in sorted(counts.items()):
        most_count, most_bytes = most[kind]
        share = max(count / most_count, sizes[peer, kind] / most_bytes if most_bytes else 0.0)
        if peer not in ("", agent):
            rows.append({"peer": peer, "kind": kind, "count": count, "bytes": sizes[peer, kind], "share": share})
    return rows
