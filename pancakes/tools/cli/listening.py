"""Listen to channels for a verb, and report the packets that were missed."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import click

from pancakes.client import Client, ReceivedPacket, Subscriber
from pancakes.errors import PancakesError, UnreachableError
from pancakes.packet import covers
from pancakes.tools.cli.options import Ask, ChannelName
from pancakes.tools.cli.streaming import say, until_ended
from pancakes.util.text import did_you_mean

LOOK_S = 0.2
"""The longest time, in seconds, before `listen` yields to its caller."""
MOST_WAITING = 100_000
"""At most this many packets wait for a terminal that is slow."""

Heard = Subscriber[ReceivedPacket[Any]]
"""The packets of a channel."""

types_option = click.option(
    "--type", "types", metavar="TYPE", multiple=True, help="Only packets of this type. Repeatable."
)
"""The option `--type`; see `doubt_types`."""

from_option = click.option(
    "--from", "sources", metavar="ADDRESS", multiple=True, help="Only from this agent, service or task. Repeatable."
)
"""The option `--from`; see `from_any`."""


@contextmanager
def listening_to(name: ChannelName, types: Sequence[str], ask: Ask) -> Iterator[tuple[Client, Heard]]:
    """Listen to a channel of an agent, at most until Ctrl-C.

    Args:
        name: the channel.
        types: only packets of these types; empty: all.
        ask: how to ask.
    """
    with (
        until_ended(),
        ask.client() as client,
        client.subscribe(str(name), *types, include_remote=True, max_waiting=MOST_WAITING) as heard,
        telling_losses(client, heard, name.channel),
    ):
        yield client, heard


def listen(
    client: Client, subscriber: Heard, for_s: float | None = None, bounded: bool = False
) -> Iterator[ReceivedPacket[Any] | None]:
    """Yield the packets as they come, and None at least every `LOOK_S` if none comes.

    Args:
        client: reaches the agents.
        subscriber: the subscription.
        for_s: end after this time; None: never.
        bounded: whether the caller ends by itself. Then it should not wait for ever for agents that went away.

    Raises:
        UnreachableError: no agent was connected at the end, or for as long as the client's time limit.
    """
    now_s = client.now()
    end_s = math.inf if for_s is None else now_s + for_s
    connected_s = now_s
    while now_s < end_s:
        packet = subscriber.take(min(end_s - now_s, LOOK_S))
        yield packet
        now_s = client.now()
        if packet is not None or subscriber.away() != subscriber.agents():
            connected_s = now_s
        elif bounded and now_s - connected_s >= client.timeout_s:
            raise UnreachableError(f"{', '.join(subscriber.away())} did not come back within {client.timeout_s:g} s")
    if subscriber.away() == subscriber.agents():
        raise UnreachableError(f"{', '.join(subscriber.away())} went away and did not come back")


@contextmanager
def telling_losses(client: Client, subscriber: Heard, channel: str) -> Iterator[None]:
    """Print at the end how many published packets were not shown."""
    try:
        yield
    except KeyboardInterrupt:
        _tell_losses(client, subscriber, channel)
        raise
    _tell_losses(client, subscriber, channel)


def _tell_losses(client: Client, subscriber: Heard, channel: str) -> None:
    if subscriber.missed:
        say(f"{subscriber.missed} packets were missed: this command could not keep up")
    try:
        agents = client.describe(*subscriber.agents(), timeout_s=1.0).agents
    except PancakesError:
        return  # an agent that is away cannot be asked
    for agent in agents:
        lost = sum(peer["dropped"].get(channel, 0) for peer in agent["mesh"]["peers"] if client.is_own(peer["name"]))
        if lost:
            say(f"{lost} packets were dropped by {agent['agent']}: its link to this terminal was too slow")


def from_any(source: str, addresses: Sequence[str]) -> bool:
    """Return whether a packet comes from one of these addresses or below; without addresses, always True."""
    return not addresses or any(covers(address.rstrip("/"), source) for address in addresses)


def doubt_types(types: Sequence[str]) -> None:
    """Warn of types that are not installed here: the agents may know them, or the user mistyped one."""
    from pancakes.packet import known_types
    from pancakes.util.plugins import Plugins

    if not types:
        return
    Plugins().load_packets()
    known = known_types()
    for name in types:
        if name not in known:
            say(f"no packet type {name!r} is installed here{did_you_mean(name, known)}")
