"""`pancakes channel ...`: the channels of agents, and the packets on them."""

from __future__ import annotations

from typing import Any

import click

from pancakes.control import Channels
from pancakes.packet import agent_of
from pancakes.tools.cli.asking import ask_each, order
from pancakes.tools.cli.listening import MOST_WAITING, listen
from pancakes.tools.cli.name_types import ChannelName, a_channel, an_agent
from pancakes.tools.cli.options import Ask, Duration, asks_agents
from pancakes.tools.cli.output import show, show_json, show_text
from pancakes.tools.cli.verbs.channel_rates import bw, hz
from pancakes.tools.cli.verbs.echo import echo
from pancakes.tools.cli.verbs.publish import pub
from pancakes.tools.cli.verbs.throughput import Throughput, size_of

LISTED = ("agent", "channel", "core", "subscribers", "waiting", "dropped", "followers")
SUBSCRIBERS = ("subscriber", "types", "keep", "limit", "waiting", "dropped")
PUBLISHERS = ("publisher", "type", "packets", "rate_hz", "bytes_per_s")


@click.group()
def channel() -> None:
    """Channels that agents have, and the packets on them."""


for verb in (echo, hz, bw, pub):
    channel.add_command(verb)


@channel.command("list")
@an_agent
@asks_agents
def list_(agent: str, ask: Ask) -> None:
    """List the channels of all agents, or of AGENT.

    For each: how many components subscribe to it, how many packets wait for those and how many they have lost, and how
    many terminals and other agents follow it from elsewhere.

    \b
    Example:
        pancakes channel list
        pancakes channel list agent1 --format json
    """
    rows = [
        {
            **found,
            "subscribers": len(found["subscribers"]),
            "waiting": sum(reader["waiting"] for reader in found["subscribers"]),
            "dropped": sum(reader["dropped"] for reader in found["subscribers"]),
            "followers": len(found["followers"]),
        }
        for _, result in ask_each(ask, Channels(), agent)
        for found in result
    ]
    ask.show(rows, LISTED)


@channel.command()
@a_channel
@click.option(
    "--for",
    "for_s",
    metavar="TIME",
    type=Duration(),
    default="1s",
    show_default=True,
    help="How long to listen for publishers.",
)
@asks_agents
def info(name: ChannelName, for_s: float, ask: Ask) -> None:
    """Show which components subscribe to a channel, which clients follow it, and which sources publish on it.

    No component declares what it will publish, so this command listens; a rare publisher may need a longer --for.
    Rates are packets for each second of the publisher's mission time, bytes are for each second here.

    \b
    Example:
        pancakes channel info agent1/system
        pancakes channel info agent1/ctrl --for 10s --format json
    """
    with ask.client() as client:
        (found,) = order(client, name.agent, Channels(name.channel))
        heard = Throughput(client.now())
        with client.subscribe(str(name), foreign=True, most=MOST_WAITING) as subscriber:
            for packet in listen(client, subscriber, for_s):
                if packet is not None:
                    heard.add(packet.packet, packet.at_s, size_of(packet.packet))
        publishers = [row for row in heard.rows(client.now()) if not client.is_own(agent_of(row["source"]))]
    row = {**found, "publishers": publishers, "heard_s": for_s}
    if ask.format_ == "json":
        show_json([row])
    else:
        _show(row)


def _show(row: dict[str, Any]) -> None:
    kind = "a core channel" if row["core"] else "a channel"
    show_text(f"{row['agent']}/{row['channel']} is {kind}")
    subscribers = [
        {**it, "subscriber": it["address"], "types": _types(it["types"], it["open_types"])} for it in row["subscribers"]
    ]
    if subscribers:
        show(subscribers, SUBSCRIBERS, "table")
    else:
        show_text("\nNo component of this agent subscribes to it.")
    show_text("Followed from elsewhere by " + (", ".join(row["followers"]) or "none") + ".")
    if row["publishers"]:
        show([{**it, "publisher": it["source"]} for it in row["publishers"]], PUBLISHERS, "table")
    else:
        show_text(f"No packet was published on it within {row['heard_s']:g} s.")


def _types(types: list[str] | None, open_types: list[str] | None) -> str:
    """Returns which types a subscriber gets; those in brackets only where a packet is addressed to it."""
    if types is None:
        return "all" if open_types is None else ", ".join([*open_types, "(all)"])
    return ", ".join(name if open_types is None or name in open_types else f"({name})" for name in types)
