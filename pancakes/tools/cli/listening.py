"""Listen to channels for as long as a verb is to go on, and say what was missed meanwhile."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import click

from pancakes.client import Client, ReceivedPacket, Subscriber
from pancakes.errors import PancakesError, Unreachable
from pancakes.packet import covers
from pancakes.tools.cli.options import Ask, ChannelName
from pancakes.tools.cli.streaming import say, until_ended
from pancakes.util.text import did_you_mean

LOOK_S = 0.2
"""At least that often `listen` gives its caller a turn."""
MOST_WAITING = 100_000
"""At most this many packets wait for a terminal that is slow."""

Heard = Subscriber[ReceivedPacket[Any]]
"""What comes on a channel."""

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
    """Listen to a channel of an agent, until Ctrl-C at the latest.

    Args:
        name: the channel.
        types: only packets of these types; none: all.
        ask: how to ask.
    """
    with (
        until_ended(),
        ask.client() as client,
        client.subscribe(str(name), *types, foreign=True, max_waiting=MOST_WAITING) as heard,
        telling_losses(client, heard, name.channel),
    ):
        yield client, heard


def listen(
    client: Client, subscriber: Heard, for_s: float | None = None, bounded: bool = False
) -> Iterator[ReceivedPacket[Any] | None]:
    """Yield the packets as they come, and None now and then if none comes.

    Args:
        client: reaches the agents.
        subscriber: what is listened to.
        for_s: ends after this time; None: never.
        bounded: whether the caller will end by itself, so that it should not wait for ever for agents that went away.

    Raises:
        Unreachable: at the end, or for as long as the client's time limit, none of the agents is there.
    """
    now_s = client.now()
    end_s = math.inf if for_s is None else now_s + for_s
    heard_s = now_s
    while now_s < end_s:
        heard = subscriber.take(min(end_s - now_s, LOOK_S))
        yield heard
        now_s = client.now()
        if heard is not None or subscriber.away() != subscriber.agents():
            heard_s = now_s
        elif bounded and now_s - heard_s >= client.timeout_s:
            raise Unreachable(f"{', '.join(subscriber.away())} did not come back within {client.timeout_s:g} s")
    if subscriber.away() == subscriber.agents():
        raise Unreachable(f"{', '.join(subscriber.away())} went away and did not come back")


@contextmanager
def telling_losses(client: Client, subscriber: Heard, channel: str) -> Iterator[None]:
    """Say at the end how many packets were published and did not come to be seen."""
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
        agents = client.survey(*subscriber.agents(), timeout_s=1.0).agents
    except PancakesError:
        return  # an agent that is away cannot be asked
    for agent in agents:
        lost = sum(peer["dropped"].get(channel, 0) for peer in agent["mesh"]["peers"] if client.is_own(peer["name"]))
        if lost:
            say(f"{lost} packets were given up by {agent['agent']}: the way to this terminal was too slow")


def from_any(source: str, addresses: Sequence[str]) -> bool:
    """Return whether a packet comes from one of these addresses, or one below; no addresses: from anywhere."""
    return not addresses or any(covers(address.rstrip("/"), source) for address in addresses)


def doubt_types(types: Sequence[str]) -> None:
    """Name the types that are not installed here. The agents may know them; perhaps the user meant another one."""
    from pancakes.packet import known_types
    from pancakes.util.plugins import Plugins

    if not types:
        return
    Plugins().load_packets()
    known = known_types()
    for name in types:
        if name not in known:
            say(f"no packet type {name!r} is installed here{did_you_mean(name, known)}")
