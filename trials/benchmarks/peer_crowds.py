"""Eight processes that send to one, and eight of which each sends to all others, beside zenoh.

With zenoh each receiver may have a key of its own, to which all others publish, or each sender, to which all others
subscribe. A task publishes to all neighbours at once, which is measured beside both, or names one after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from benchmarks import crowd
from benchmarks.crowd import ALL_TO_ALL, ALL_TO_EACH, EIGHT_TO_ONE, Shape
from benchmarks.environments import ZENOH, PeerMissing, python_of
from benchmarks.figure import Figure, Missing, Plan, Side, in_turns_of_all
from benchmarks.peer_runs import zenoh_crowd

TITLE = "many agents at once, packets that arrive, beside zenoh; bound to no core"
BESIDE = "zenoh"
SIZE = 64
_SIDES = ("at the receiver", "at a sender")


def measure(plan: Plan) -> Iterator[Figure | Missing]:
    """Measures everything."""
    try:
        python = python_of(ZENOH)
    except PeerMissing as error:
        yield Missing(ZENOH.name, str(error))
        return

    def ours(shape: Shape) -> Callable[[], list[float]]:
        packets = plan.share(shape.packets)
        return lambda: [crowd.rate(shape, packets, crowd.pancakes(shape, packets, SIZE))]

    def theirs(shape: Shape) -> Callable[[], list[float]]:
        packets = plan.share(shape.packets)
        return lambda: [crowd.rate(shape, packets, zenoh_crowd(python, shape, packets, SIZE))]

    to_one = Figure("8 agents to 1, 64 B", "1/s", "min", 1.0)
    at_receiver, at_senders = (Figure(f"the same: CPU of a packet, {it}", "µs", least=True) for it in _SIDES)

    def ours_to_one() -> list[float]:
        packets = plan.share(EIGHT_TO_ONE.packets)
        reports = crowd.pancakes(EIGHT_TO_ONE, packets, SIZE)
        return [crowd.rate(EIGHT_TO_ONE, packets, reports), *crowd.cpu_us(EIGHT_TO_ONE, packets, reports)]

    sides: list[Side] = [
        (ours_to_one, [to_one.runs, at_receiver.runs, at_senders.runs]),
        (theirs(EIGHT_TO_ONE), [to_one.bare_runs]),
    ]
    yield from in_turns_of_all(plan, sides, [to_one, at_receiver, at_senders])

    key_each = Figure("all to all of 8, 64 B; a key a receiver", "1/s", "min", 1.0)
    key_all = Figure("all to all of 8, 64 B; a key a sender", "1/s", "min", 1.0, runs=key_each.runs)
    named = Figure("each receiver named; a key a receiver", "1/s", "min", bare_runs=key_each.bare_runs)
    sides = [
        (ours(ALL_TO_ALL), [key_each.runs]),
        (theirs(ALL_TO_EACH), [key_each.bare_runs]),
        (ours(ALL_TO_EACH), [named.runs]),
        (theirs(ALL_TO_ALL), [key_all.bare_runs]),
    ]
    yield from in_turns_of_all(plan, sides, [key_each, key_all, named])
