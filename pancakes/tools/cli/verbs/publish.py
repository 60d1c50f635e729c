"""`pancakes channel pub`: publish packets on a channel of an agent, with bodies made of JSON that a person writes."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from inspect import get_annotations
from itertools import count
from typing import Any, Final

import click
import msgspec

from pancakes.client import Client, ReceivedPacket, Subscriber
from pancakes.control import CONTROLS, Channels
from pancakes.errors import PancakesError
from pancakes.events import Event
from pancakes.packet import (
    CTRL,
    LOG,
    NEIGHBOURS,
    SYSCTRL,
    TO_TASK,
    agent_of,
    body_class,
    covers,
    field_names,
    join,
    known_types,
    type_name,
)
from pancakes.tools.cli.agent_requests import request_result
from pancakes.tools.cli.exit_codes import REFUSED
from pancakes.tools.cli.options import Ask, ChannelName, FiniteRange, a_channel, dry_run_option, orders_agents
from pancakes.tools.cli.streaming import say, until_ended
from pancakes.util import codecs
from pancakes.util.codecs import MALFORMED, why_malformed
from pancakes.util.text import hint_of


class BadBody(PancakesError):
    """What was written is no body of a packet."""


def body_of(kind: str, text: str) -> Any:
    """Return the body of a packet of the type `kind`, from JSON. The types have to be loaded (`load_packets`).

    Raises:
        BadBody: there is no such type, or the text does not fit it; the sentence names the field.
    """
    cls = body_class(kind)
    if cls is None:
        raise BadBody(f"no packet type {kind!r} is installed here{hint_of(kind, known_types())}")
    try:
        given: Any = codecs.json_decoder()(text)
    except MALFORMED as error:
        why = why_malformed(error).removeprefix("JSON is malformed: ")
        raise BadBody(f"the body is no JSON: {_lower(why)}") from None
    if not isinstance(given, Mapping):
        raise BadBody(f"the body must be a JSON object with the fields of {kind}: {_fields(cls)}")
    try:
        body: Any = codecs.convert(given, cls)
    except msgspec.ValidationError as error:
        raise BadBody(f"{_sentence(kind, str(error))}; its fields are {_fields(cls)}") from None
    for path, names in _unknown(given, msgspec.to_builtins(body)):
        name = path.rpartition(".")[2]
        whole = f"{kind}.{path.rpartition('.')[0]}".rstrip(".")
        raise BadBody(f"{whole} has no field {name!r}{hint_of(name, names) or ', only none at all'}")
    return body


def _sentence(kind: str, error: str) -> str:
    """Return what msgspec says, such as "Expected `float`, got `str` - at `$.x_m`", with the field first."""
    what, _, where = error.partition(" - at `$")
    field = f"{kind}{where.rstrip('`')}" if where else kind
    return f"{field}: {_lower(what)}"


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:]


def _fields(cls: type) -> str:
    """Return the fields of a body, each with the type that it must be of."""
    kinds = {name: kind for base in reversed(cls.__mro__) for name, kind in get_annotations(base).items()}
    named = ((name, kinds.get(name, "")) for name in field_names(cls))
    return ", ".join(f"{name} ({getattr(kind, '__name__', kind)})" for name, kind in named) or "none"


def _unknown(given: Any, taken: Any, path: str = "") -> Iterator[tuple[str, list[str]]]:
    """Yield the paths of what was given and not taken, each with the names that there are."""
    if isinstance(given, Mapping) and isinstance(taken, Mapping):
        for name, item in given.items():
            if name not in taken:
                yield f"{path}{name}", list(taken)
            else:
                yield from _unknown(item, taken[name], f"{path}{name}.")
    elif isinstance(given, list) and isinstance(taken, (list, tuple)):
        for index, (one, other) in enumerate(zip(given, taken, strict=False)):
            yield from _unknown(one, other, f"{path}{index}.")


COLUMNS: Final = ("agent", "channel", "type", "to", "packets", "subscribers", "refused")
RATE_HZ: Final = 1.0
"""How often packets are published if their number is said and their rate is not."""
REFUSAL_S: Final = 0.5
"""After the last command, an actuator that has not refused it for so long has taken it."""


@click.command()
@a_channel
@click.argument("kind", metavar="TYPE")
@click.argument("body", metavar="[BODY]", default="{}")
@click.option("--to", metavar="DEST", default="", help="Only to this service or task of the agent: SERVICE/TASK.")
@click.option(
    "--rate",
    "rate_hz",
    metavar="HZ",
    type=FiniteRange(min=0.0, min_open=True, max=1000.0),
    help="So many a second, until Ctrl-C or --count; without, one.",
)
@click.option("--count", "most", metavar="N", type=click.IntRange(min=1), help="N packets, at --rate or one a second.")
@dry_run_option
@orders_agents
def pub(
    name: ChannelName, kind: str, body: str, to: str, rate_hz: float | None, most: int | None, dry_run: bool, ask: Ask
) -> None:
    """Publish a packet of the type TYPE on a channel.

    BODY is a JSON object with the type's fields, which are checked before anything is sent; a field that has a default
    may be left out. A packet without a subscriber on the agent is sent all the same, and a line says so.
    An actuator that a task holds takes commands from that task only. What an actuator or its driver refuses is shown,
    and the exit code is then 1. A control packet on sysctrl, such as stop or reschedule, is answered as it is to a
    task, and refused likewise.

    \b
    Example:
        pancakes channel pub agent1/system motion '{"detected": true, "range_m": 0.4}'
        pancakes channel pub agent1/system battery '{"voltage_v": 6.9, "level": 0.1}' --rate 2 --count 10
        pancakes channel pub agent1/system pose '{"x_m": 0, "y_m": 0, "theta_rad": 0}' --to device/pose --dry-run
    """
    from pancakes.util.plugins import Plugins

    Plugins().load_packets()
    try:
        made = body_of(kind, body)
    except BadBody as error:
        raise click.UsageError(str(error)) from None
    destination = _destination(name.agent, to)
    with until_ended(), ask.client() as client:
        sender = Sender(client, name, made, destination)
        if not sender.subscribers:
            say(f"no component of {name.agent} subscribes to {kind} on {name.channel}" + (f" at {to}" if to else ""))
        row: dict[str, Any] = {**name._asdict(), "type": kind, "to": destination, "packets": 0}
        row |= {"subscribers": sender.subscribers, "refused": []}
        if not dry_run:
            packets = most if most is not None or rate_hz is not None else 1
            with Refusals(client, name) as refusals:
                try:
                    for _ in sender.send(packets, rate_hz or RATE_HZ):
                        row["packets"] += 1
                except KeyboardInterrupt:
                    sender.settle()
                row["refused"] = refusals.of(sender.subscribers)
        ask.printer.table([row], COLUMNS)
    for refusal in row["refused"]:
        say(f"refused by {refusal}")
    if row["refused"]:
        sys.exit(REFUSED)


def _destination(agent: str, to: str) -> str:
    """Return the address that is to get the packets."""
    if not to:
        return agent
    if to == NEIGHBOURS or to.startswith(TO_TASK):
        raise click.BadParameter(
            f"{to!r} is no service or task of {agent}: write it as SERVICE/TASK", param_hint="--to"
        )
    address = to if agent_of(to) == agent else join(agent, to)
    if address.count("/") > 2 or not all(address.split("/")):
        raise click.BadParameter(f"{to!r} names no service or task: write it as SERVICE/TASK", param_hint="--to")
    return address


class Sender:
    """Publish one packet again and again, as from the agent itself.

    Args:
        client: reaches the agent.
        name: the channel.
        body: the packet's body.
        destination: an address on the agent, or the agent's own name.

    Attributes:
        subscribers: the addresses that will get it.

    Raises:
        ControlRefused: the agent has no such channel.
        Unreachable: the agent does not answer.
    """

    def __init__(self, client: Client, name: ChannelName, body: Any, destination: str) -> None:
        self._client = client
        self._name = name
        self._body = body
        self._destination = destination
        self.subscribers = self._look()

    def send(self, most: int | None, rate_hz: float) -> Iterator[None]:
        """Publish so many packets (None: without end) at a rate, and yield after each.

        Raises:
            ControlRefused: it asked for something that the agent refuses.
            Unreachable: the agent went away.
        """
        began_s = self._client.now()
        for number in count() if most is None else range(most):
            time.sleep(max(0.0, began_s + number / rate_hz - self._client.now()))
            self._send_one()
            yield
        self.settle()

    def settle(self) -> None:
        """Wait until the agent has got all that was sent."""
        self._client.settle()

    def _send_one(self) -> None:
        if self._name.channel == SYSCTRL and type(self._body) in CONTROLS:
            request_result(self._client, self._name.agent, self._body)  # it is answered, and the answer is what counts
            return
        to = self._destination if self._destination != self._name.agent else ""
        self._client.publish(str(self._name), self._body, to=to)

    def _look(self) -> list[str]:
        """Return the addresses that would get the packets now."""
        (found,) = request_result(self._client, self._name.agent, Channels(self._name.channel))
        kind = type_name(self._body)
        named = self._destination != self._name.agent
        return [
            reader["address"]
            for reader in found["subscribers"]
            if covers(self._destination, reader["address"])
            and _takes(reader["types"] if named else reader["open_types"], kind)
        ]


class Refusals:
    """Hear which actuators refuse the commands of this program, and why. On other channels nothing is refused.

    Args:
        client: reaches the agent.
        name: the channel.
    """

    def __init__(self, client: Client, name: ChannelName) -> None:
        self._client = client
        self._agent = name.agent
        self._stack = ExitStack()
        self._log: Subscriber[ReceivedPacket[Event]] | None = None
        if name.channel == CTRL:
            self._log = self._stack.enter_context(client.subscribe(join(name.agent, LOG), Event))

    def __enter__(self) -> Refusals:
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def of(self, actuators: list[str]) -> list[str]:
        """Return a sentence for each of these actuators that has refused, or does so soon after the last command."""
        found: dict[str, str] = {}
        until_s = self._client.now() + REFUSAL_S
        while self._log is not None and len(found) < len(actuators):
            heard = self._log.take(max(0.0, until_s - self._client.now()))
            if heard is None:
                break
            event = heard.body
            asked_by = agent_of(str(event.fields.get("by", "")))
            if event.kind == "command_refused" and self._client.is_own(asked_by):
                found[heard.source] = f"{heard.source}: {event.fields.get('reason', '')}"
        return list(found.values())


def _takes(types: list[str] | None, kind: str) -> bool:
    return types is None or kind in types
