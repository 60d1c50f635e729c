"""The named points between the effects of a hand-off at which a real agent can be killed, and how.

From outside, an agent that dies between a write and the next message looks like one whose message was lost; so a proxy
that sees the message kills its sender and loses the message. Before a write, and before a task starts or resumes, a
gate holds the agent (`gates.py`). `traps.py` carries this out.
"""

from __future__ import annotations

from dataclasses import dataclass

from pancakes.durable.record import Phase

_MIGRATION = "migration."
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
        phase: the phase of the record that is about to be written.
        lose: a type of packet that is lost until then, so that the agent reaches the point.
        then: a second point, which the agent reaches after its restart.
        lazy: whether to use a task that writes a checkpoint each second, instead of after each packet.
    """

    name: str
    word: str
    how: str
    phase: Phase | None = None
    lose: str = ""
    then: Point | None = None
    lazy: bool = True


def _word(name: str) -> str:
    return _MIGRATION + name


POINTS = (
    Point("source: before it sends SOLICIT", _word("solicit"), "lost"),
    Point("source: after it sent SOLICIT", _word("solicit"), "sent"),
    Point("source: before it sends RESERVE", _word("reserve"), "lost"),
    Point("source: after it sent RESERVE", _word("reserve"), "sent"),
    Point("source: task stopped, before it writes FROZEN", _word("reserved"), "write", Phase.FROZEN),
    Point("source: FROZEN written, before it sends TRANSFER", _word("transfer"), "lost"),
    Point("source: after it sent TRANSFER", _word("transfer"), "sent"),
    Point("source: before it writes COMMITTED", _word("prepared"), "write", Phase.COMMITTED),
    Point("source: COMMITTED written, before it sends COMMIT", _word("commit"), "lost"),
    Point("source: after it sent COMMIT", _word("commit"), "sent"),
    Point("source: before it writes RELEASED", _word("activated"), "write", Phase.RELEASED),
    Point("source: RELEASED written", _word("activated"), "written", Phase.RELEASED),
    Point("destination: before it sends BID", _word("bid"), "lost"),
    Point("destination: after it sent BID", _word("bid"), "sent"),
    Point("destination: before it sends RESERVED", _word("reserved"), "lost"),
    Point("destination: after it sent RESERVED", _word("reserved"), "sent"),
    Point("destination: before it writes PREPARED", _word("transfer"), "write", Phase.PREPARED),
    Point("destination: PREPARED written, before it sends PREPARED", _word("prepared"), "lost"),
    Point("destination: after it sent PREPARED", _word("prepared"), "sent"),
    Point("destination: before it writes OWNER", _word("commit"), "write", Phase.OWNER),
    Point("destination: OWNER written, before it starts the task", _word("commit"), "start"),
    Point("destination: task started, before it sends ACTIVATED", _word("activated"), "lost"),
    Point("destination: after it sent ACTIVATED", _word("activated"), "sent"),
    Point("source takes back: before it writes OWNER", _word("prepared"), "write", Phase.OWNER, _word("prepared")),
    Point(
        "source takes back: OWNER written, before the task goes on",
        _word("prepared"),
        "resume",
        None,
        _word("prepared"),
    ),
    Point("source takes back: before it sends ABORT", _word("abort"), "lost", None, _word("prepared")),
    Point("source takes back: after it sent ABORT", _word("abort"), "sent", None, _word("prepared")),
    Point("destination gives up: before it writes ABSENT", _word("abort"), "write", Phase.ABSENT, _word("prepared")),
    Point("destination gives up: ABSENT written", _word("abort"), "written", Phase.ABSENT, _word("prepared")),
    Point(
        "source: FROZEN written",
        _word("transfer"),
        "lost",
        then=Point("source comes back FROZEN: before it writes OWNER", "", "write", Phase.OWNER),
    ),
    Point(
        "source: FROZEN written, TRANSFER sent",
        _word("transfer"),
        "sent",
        then=Point("source comes back FROZEN: OWNER written, before it starts the task", "", "start"),
    ),
    Point(
        "source: COMMITTED written",
        _word("commit"),
        "lost",
        then=Point("source comes back COMMITTED: before it sends COMMIT again", _word("commit"), "lost"),
    ),
    Point(
        "source: COMMITTED written, COMMIT sent",
        _word("commit"),
        "sent",
        then=Point("source comes back COMMITTED: after it sent COMMIT again", _word("commit"), "sent"),
    ),
    Point(
        "destination: PREPARED written",
        _word("prepared"),
        "lost",
        then=Point("destination comes back PREPARED: before it sends PREPARED again", _word("prepared"), "lost"),
    ),
    Point(
        "destination: OWNER written",
        _word("commit"),
        "start",
        then=Point("destination comes back OWNER: before it starts the task", "", "start"),
    ),
    Point("owner: before it writes a checkpoint", "", "write", Phase.OWNER),
    Point("owner: checkpoint written", "", "written", Phase.OWNER),
    Point("owner: checkpoint written, before it acknowledges a packet", _RECEIPT, "lost", lazy=False),
    Point("owner: after it acknowledged a packet", _RECEIPT, "sent", lazy=False),
)
"""All points."""
NAMES = tuple(name for point in POINTS for name in (point.name, point.then.name if point.then else "") if name)
