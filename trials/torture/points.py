"""The named points between the effects of a migration at which a real agent can be killed, and how.

From outside, an agent that dies between a write and the next message looks like one whose message was lost; so a proxy
that sees the message kills its sender and loses the message. Before a write, and before a task starts or resumes, a
gate holds the agent (`gates.py`). `traps.py` carries this out.
"""

from __future__ import annotations

from dataclasses import dataclass

from pancakes.durable.register import Standing

_SOLICIT = "migration.solicit"
_BID = "migration.bid"
_ACCEPT = "task.accept"
_PREPARE = "task.prepare"
_PROMISE = "task.promise"
_KNOWN = "task.known"
_RECEIPT = "post.receipt"


@dataclass(frozen=True)
class Point:
    """A moment in the life of one agent.

    Attributes:
        name: its name in docs/protocol.md.
        word: the type of the packet with which it begins; empty: at any time.
        how: `lost`: the word's sender dies, and it does not arrive. `sent`: its sender dies, and it arrives. `write`:
            its receiver dies before its next write. `written`: the same, after it. `start`, `resume`: its receiver
            dies before the task is started there, or goes on.
        standing: where the agent stands with the task by the record that is about to be written.
        lose: a type of packet that is lost until then, so that the agent reaches the point.
        then: a second point, which the agent reaches after its restart.
        lazy: whether to use a task that writes a checkpoint each second, instead of after each packet.
    """

    name: str
    word: str
    how: str
    standing: Standing | None = None
    lose: str = ""
    then: Point | None = None
    lazy: bool = True


POINTS = (
    Point("source: before it sends SOLICIT", _SOLICIT, "lost"),
    Point("source: after it sent SOLICIT", _SOLICIT, "sent"),
    Point("destination: before it sends BID", _BID, "lost"),
    Point("destination: after it sent BID", _BID, "sent"),
    Point("source: task paused, before it writes the offer", _BID, "write", Standing.OFFERED),
    Point("source: offer written, before it sends ACCEPT", _ACCEPT, "lost"),
    Point("source: after it sent ACCEPT", _ACCEPT, "sent"),
    Point("destination: before it writes that it is the heir", _ACCEPT, "write", Standing.HEIR),
    Point("destination: heir, before it sends PREPARE", _PREPARE, "lost"),
    Point("destination: after it sent PREPARE", _PREPARE, "sent"),
    Point("source: before it writes the promise", _PREPARE, "write", Standing.OFFERED),
    Point("source: promise written, before it sends PROMISE", _PROMISE, "lost"),
    Point("source: after it sent PROMISE", _PROMISE, "sent"),
    Point("destination: before it writes that it is the owner", _PROMISE, "write", Standing.OWNER),
    Point("destination: owner, before it starts the task", _PROMISE, "start"),
    Point("destination: owner, before it says so", _KNOWN, "lost"),
    Point("destination: after it said so", _KNOWN, "sent"),
    Point("source: before it writes the tombstone", _KNOWN, "write", Standing.RELEASED),
    Point("source: tombstone written", _KNOWN, "written", Standing.RELEASED),
    Point("source takes back: before it writes that", _PREPARE, "write", Standing.OWNER, _PREPARE),
    Point("source takes back: written, before the task goes on", _PREPARE, "resume", None, _PREPARE),
    Point(
        "source: offer written",
        _ACCEPT,
        "lost",
        then=Point("source comes back with an offer: before it takes it back", "", "write", Standing.OWNER),
    ),
    Point(
        "source: offer written, ACCEPT sent",
        _ACCEPT,
        "sent",
        then=Point("source comes back with an offer: taken back, before it starts the task", "", "start"),
    ),
    Point(
        "source: promise written",
        _PROMISE,
        "lost",
        then=Point("source comes back having promised: before it sends PROMISE again", _PROMISE, "lost"),
    ),
    Point(
        "source: promise written, PROMISE sent",
        _PROMISE,
        "sent",
        then=Point("source comes back having promised: after it sent PROMISE again", _PROMISE, "sent"),
    ),
    Point(
        "destination: heir",
        _PREPARE,
        "lost",
        then=Point("destination comes back as heir: before it sends PREPARE again", _PREPARE, "lost"),
    ),
    Point(
        "destination: owner",
        _PROMISE,
        "start",
        then=Point("destination comes back as owner: before it starts the task", "", "start"),
    ),
    Point("owner: before it writes a checkpoint", "", "write", Standing.OWNER),
    Point("owner: checkpoint written", "", "written", Standing.OWNER),
    Point("owner: checkpoint written, before it acknowledges a packet", _RECEIPT, "lost", lazy=False),
    Point("owner: after it acknowledged a packet", _RECEIPT, "sent", lazy=False),
)
"""All points."""
NAMES = tuple(name for point in POINTS for name in (point.name, point.then.name if point.then else "") if name)
