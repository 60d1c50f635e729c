"""An assertion about what has been published, which says what there was instead."""

from __future__ import annotations

from collections.abc import Sequence

from pancakes.packet import Packet, type_name
from pancakes.simulation.probe import BodyTest, Probe
from pancakes.testing.agent_in_test import PATIENCE_S, AgentInTest

MOST_SHOWN = 20


def assert_published(
    probe: Probe | AgentInTest,
    body: type,
    where: BodyTest | None = None,
    *,
    channel: str = "",
    source: str = "",
    times: int | None = None,
    within_s: float | None = None,
) -> Packet:
    """Asserts that a packet is published, and returns the last one that fits.

    Without `times` it waits for the first packet that fits, if there is none yet. With `times` it looks at what there
    is at the end of `within_s`: all that has been heard so far counts.

    Args:
        probe: the probe that listens, or the agent that has it.
        body: its type.
        where: says yes to its body.
        channel: where it is published.
        source: the address of its publisher.
        times: how many there must be, neither more nor fewer; None: one or more.
        within_s: how long to wait, in virtual time or, on threads, in seconds of the host; None: 10 s, and with
            `times` not at all.

    Returns:
        The packet; one without a body where `times` is 0.

    Raises:
        AssertionError: names what was published instead.
    """
    listener = probe.probe if isinstance(probe, AgentInTest) else probe

    def found() -> list[Packet]:
        return listener.packets(body, where, channel=channel, source=source)

    limit_s = within_s if within_s is not None else PATIENCE_S if times is None else 0.0
    if times is None:
        listener.wait(lambda: bool(found()), limit_s)
    elif limit_s > 0.0:
        listener.wait(lambda: len(found()) > times, limit_s)
    fitting = found()
    if (times is None and fitting) or len(fitting) == times:
        return fitting[-1] if fitting else Packet("", "", "", "", 0.0, 0, None)
    wanted = "at least one" if times is None else str(times)
    name = type_name(body)
    fits = "packet of the type {!r} fits" if len(fitting) == 1 else "packets of the type {!r} fit"
    limits = [f"on {channel}"] * bool(channel) + [f"of {source}"] * bool(source) + ["that `where` takes"] * bool(where)
    waited = f"within {limit_s:g} s " if limit_s > 0.0 else ""
    raise AssertionError(
        f"{len(fitting)} {fits.format(name)}, {wanted} wanted {waited}on {listener.agent}"
        + (f" ({', '.join(limits)})" if limits else "")
        + f"; {_instead(listener, name, listener.packets(body))}"
    )


def _instead(listener: Probe, name: str, same: Sequence[Packet]) -> str:
    """Says what was published instead: packets of the same type, or else what there was of each type."""
    if same:
        first = f"of the type {name!r} there were {len(same)}, the last of them:\n"
        return first + "\n".join(_document(listener.agent, packet) for packet in same[-MOST_SHOWN:])
    by_type: dict[tuple[str, str, str], list[Packet]] = {}
    for packet in listener.packets():
        by_type.setdefault((packet.type, packet.channel, packet.source), []).append(packet)
    if not by_type:
        return "nothing at all was published"
    shown = [
        _document(listener.agent, packets[-1], f"the last of {len(packets)} ")
        for packets in list(by_type.values())[:MOST_SHOWN]
    ]
    more = f"\nand {len(by_type) - MOST_SHOWN} more" if len(by_type) > MOST_SHOWN else ""
    return "none of this type; what was published instead:\n" + "\n".join(shown) + more


def _document(agent: str, packet: Packet, before: str = "") -> str:
    """Returns a packet as `pancakes channel echo` shows it, under a line that says where it went."""
    from pancakes.tools.cli.verbs.echo import record_of, text_of  # only where something went wrong

    to = f" to {packet.destination}" if packet.destination else ""
    try:
        text = text_of(record_of(agent, packet))
    except (TypeError, ValueError):  # what is published on one agent alone may contain anything
        text = f"type: {packet.type}\nsource: {packet.source}\nstamp: {packet.stamp:.9g}\nbody: {packet.body!r}\n---"
    return f"# {before}on {packet.channel}{to}\n{text}"
