"""How many tasks of one peer an agent keeps, and how many bytes: no peer fills the disk of another one. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any, Final

from pancakes.durable.record import Record
from pancakes.durable.register import Standing

IN_DOUBT: Final = "in doubt"
GUARDED: Final = "guarded"
MOST_OFFERED: Final = 64
"""Most tasks of one peer that it has offered and not given away."""
MOST_GUARDED: Final = 1024
"""Most tasks of one peer that are guarded for it."""
MOST_BYTES: Final = 64 * 1024 * 1024
"""Most bytes of the tasks of one peer of either kind; one task may always be kept."""
MOST_LEFT: Final = 16_384
"""Most tasks of one peer of which a tombstone is kept; no new ones are taken in then."""


def _kind_of(record: Record) -> str:
    if record.removed:
        return "removed"
    match record.standing:
        case Standing.HEIR:
            return IN_DOUBT
        case Standing.MEMBER:
            return GUARDED
        case Standing.RELEASED | Standing.NONE:
            return "taken back"
        case _:
            return ""


def _kept(records: Iterable[Record]) -> tuple[Counter[tuple[str, str]], Counter[tuple[str, str]]]:
    """Return how many tasks of each peer and kind there are, and how many bytes they have."""
    counts: Counter[tuple[str, str]] = Counter()
    sizes: Counter[tuple[str, str]] = Counter()
    for record in records:
        if kind := _kind_of(record):
            counts[record.seen.minter.agent, kind] += 1
            sizes[record.seen.minter.agent, kind] += len(record.snapshot)
    return counts, sizes


def fault_of_room(peer: str, kind: str, others: Iterable[Record], size: int) -> str:
    """Return why a task of a peer is not kept, as a clause; empty: there is room for it.

    Args:
        peer: the peer.
        kind: `IN_DOUBT` or `GUARDED`.
        others: the records of all other tasks.
        size: how many bytes of it would be kept.
    """
    # An owner says many times a second that it has a task, and only what is of the same peer counts.
    counts, sizes = _kept(record for record in others if record.seen.minter.agent == peer)
    count, held = counts[peer, kind], sizes[peer, kind]
    if count >= (MOST_OFFERED if kind == IN_DOUBT else MOST_GUARDED) or (count and held + size > MOST_BYTES):
        if kind == IN_DOUBT:
            return f"keeps {count} tasks that {peer} has brought and not handed over ({held} bytes), and no more"
        return f"guards {count} tasks of {peer} already ({held} bytes), and no more"
    left = counts[peer, "taken back"] + counts[peer, "removed"]
    return f"remembers {left} tasks of {peer}, and no more" if left >= MOST_LEFT else ""


def kept_of_peers(agent: str, records: Iterable[Record]) -> list[dict[str, Any]]:
    """Return a row for each peer and kind of thing, with how much of its room is taken, as plain values.

    Args:
        agent: the agent itself, which is no peer.
        records: what it has on disk of tasks.
    """
    most = {IN_DOUBT: MOST_OFFERED, GUARDED: MOST_GUARDED}
    counts, sizes = _kept(records)
    rows = []
    for (peer, kind), count in sorted(counts.items()):
        size = sizes[peer, kind]
        share = max(count / most[kind], size / MOST_BYTES) if kind in most else count / MOST_LEFT
        if peer not in ("", agent):
            rows.append({"peer": peer, "kind": kind, "count": count, "bytes": size, "share": share})
    return rows
