"""`pancakes channel pub`: publish packets on a channel of an agent, with bodies from JSON."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from inspect import get_annotations
from itertools import count
from types import NoneType, UnionType
from typing import Any, Final, Literal, Union, get_args, get_origin, get_type_hints

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


class BadBodyError(PancakesError):
    """A text is not a valid body of a packet."""


def body_of(kind: str, text: str) -> Any:
    """Return the body of a packet of the type `kind`, from JSON. The types must be loaded (`load_packets`).

    Raises:
        BadBodyError: the type does not exist, or the text does not fit it; the sentence names the field.
    """
    cls = body_class(kind)
    if cls is None:
        raise BadBodyError(f"no packet type {kind!r} is installed here{hint_of(kind, known_types())}")
    try:
        given: Any = codecs.json_decoder()(text)
    except MALFORMED as error:
        why = why_malformed(error).removeprefix("JSON is malformed: ")
        raise BadBodyError(f"the body is not JSON: {_lower(why)}") from None
    if not isinstance(given, Mapping):
        raise BadBodyError(f"the body must be a JSON object with the fields of {kind}: {_fields(cls)}")
    try:
        body: Any = codecs.convert(given, cls)
    except msgspec.ValidationError as error:
        raise BadBodyError(f"{_sentence(kind, str(error))}; its fields are {_fields(cls)}") from None
    for path, names in _unknown(given, msgspec.to_builtins(body)):
        name = path.rpartition(".")[2]
        whole = f"{kind}.{path.rpartition('.')[0]}".rstrip(".")
        if not names:
            raise BadBodyError(f"{whole} takes no fields (got {name!r})")
        raise BadBodyError(f"{whole} has no field {name!r}{hint_of(name, names)}")
    return body


def _sentence(kind: str, error: str) -> str:
    """Return an error of msgspec, such as "Expected `float`, got `str` - at `$.x_m`", with the field first."""
    what, _, where = error.partition(" - at `$")
    field = f"{kind}{where.rstrip('`')}" if where else kind
    return f"{field}: {_lower(what)}"


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:]


def _fields(cls: type) -> str:
    """Return the fields of a body, each with its type."""
    try:
        kinds = get_type_hints(cls)  # without what `Annotated` adds
    except (NameError, TypeError):  # an annotation that cannot be evaluated here is shown as it stands in the source
        kinds = {name: kind for base in reversed(cls.__mro__) for name, kind in get_annotations(base).items()}
    named = ((name, kinds.get(name, "")) for name in field_names(cls))
    return ", ".join(f"{name} ({_kind_text(kind)})" for name, kind in named) or "none"


def _kind_text(kind: Any) -> str:
    """Return a type as its author may have written it, without modules."""
    if get_origin(kind) in (Union, UnionType):
        return " | ".join(map(_kind_text, get_args(kind)))
    if get_origin(kind) is Literal:
        return f"Literal[{', '.join(map(repr, get_args(kind)))}]"
    name = str(getattr(kind, "__name__", kind))
    if kind is NoneType:
        return "None"
    inside = ", ".join("..." if one is Ellipsis else _kind_text(one) for one in get_args(kind))
    return f"{name}[{inside}]" if inside else name


def _unknown(given: Any, taken: Any, path: str = "") -> Iterator[tuple[str, list[str]]]:
    """Yield the paths of given fields that the body does not have, each with the names that exist there."""
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
"""The default rate if `--count` is given without `--rate`."""
REFUSAL_S: Final = 0.5
"""How long to wait after the last command for a refusal; after that, the actuator has accepted the command."""


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
    help="Publish HZ packets per second, until Ctrl-C or --count. Without it, publish one packet.",
)
@click.option(
    "--count", "most", metavar="N", type=click.IntRange(min=1), help="Publish N packets, at --rate or one per second."
)
@dry_run_option
@orders_agents
def pub(
    name: ChannelName, kind: str, body: str, to: str, rate_hz: float | None, most: int | None, dry_run: bool, ask: Ask
) -> None:
    """Publish a packet of the type TYPE on a channel.

    BODY is a JSON object with the type's fields; fields with a default may be left out. It is checked before anything
    is sent. If no component of the agent subscribes to the packet, it is sent anyway, with a warning.
    An actuator that a task holds accepts commands only from that task. If an actuator or its driver refuses a command,
    the reason is shown, and the exit code is 1. A control packet on sysctrl, such as stop or reschedule, is answered
    or refused as if a task had sent it.

    \b
    Example:
        pancakes channel pub agent1/system motion '{"detected": true, "range_m": 0.4}'
        pancakes channel pub agent1/system battery '{"voltage_v": 6.9, "level": 0.1}' --rate 2 --count 10
        pancakes channel pub agent1/system pose '{"x_m": 0, "y_m": 0, "theta_rad": 0}' --to device/pose --dry-run
    """
    from pancakes.util.plugins import Plugins

    Plugins().load_packets()
    try:
        packet_body = body_of(kind, body)
    except BadBodyError as error:
        raise click.UsageError(str(error)) from None
    destination = _destination(name.agent, to)
    with until_ended(), ask.client() as client:
        sender = Sender(client, name, packet_body, destination)
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
    """Return the destination of the packets."""
    if not to:
        return agent
    if to == NEIGHBOURS or to.startswith(TO_TASK):
        raise click.BadParameter(
            f"{to!r} is not a service or task of {agent}: write it as SERVICE/TASK", param_hint="--to"
        )
    address = to if agent_of(to) == agent else join(agent, to)
    if address.count("/") > 2 or not all(address.split("/")):
        raise click.BadParameter(f"{to!r} is not a service or task: write it as SERVICE/TASK", param_hint="--to")
    return address


class Sender:
    """Publish one packet repeatedly, in the name of the agent.

    Args:
        client: reaches the agent.
        name: the channel.
        body: the packet's body.
        destination: an address on the agent, or the agent's own name.

    Attributes:
        subscribers: the addresses that get it.

    Raises:
        ControlRefusedError: the agent has no such channel.
        UnreachableError: the agent does not answer.
    """

    def __init__(self, client: Client, name: ChannelName, body: Any, destination: str) -> None:
        self._client = client
        self._name = name
        self._body = body
        self._destination = destination
        self.subscribers = self._find_subscribers()

    def send(self, most: int | None, rate_hz: float) -> Iterator[None]:
        """Publish at most `most` packets (None: endlessly) at a rate, and yield after each.

        Raises:
            ControlRefusedError: the agent refuses a control packet.
            UnreachableError: the agent went away.
        """
        began_s = self._client.now()
        for number in count() if most is None else range(most):
            time.sleep(max(0.0, began_s + number / rate_hz - self._client.now()))
            self._send_one()
            yield
        self.settle()

    def settle(self) -> None:
        """Wait until the agent has received all packets."""
        self._client.settle()

    def _send_one(self) -> None:
        if self._name.channel == SYSCTRL and type(self._body) in CONTROLS:
            request_result(self._client, self._name.agent, self._body)  # raises if the agent refuses
            return
        to = self._destination if self._destination != self._name.agent else ""
        self._client.publish(str(self._name), self._body, to=to)

    def _find_subscribers(self) -> list[str]:
        """Return the addresses that would get the packets now."""
        (found,) = request_result(self._client, self._name.agent, Channels(self._name.channel))
        kind = type_name(self._body)
        is_addressed = self._destination != self._name.agent
        return [
            reader["address"]
            for reader in found["subscribers"]
            if covers(self._destination, reader["address"])
            and _takes(reader["types"] if is_addressed else reader["open_types"], kind)
        ]


class Refusals:
    """Collect the refusals of actuators to commands of this program. Only packets on `ctrl` are refused.

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
        """Return a sentence for each of these actuators that refuses, at most `REFUSAL_S` after the last command."""
        found: dict[str, str] = {}
        until_s = self._client.now() + REFUSAL_S
        while self._log is not None and len(found) < len(actuators):
            received = self._log.take(max(0.0, until_s - self._client.now()))
            if received is None:
                break
            event = received.body
            commanded_by = agent_of(str(event.fields.get("by", "")))
            if event.kind == "command_refused" and self._client.is_own(commanded_by):
                found[received.source] = f"{received.source}: {event.fields.get('reason', '')}"
        return list(found.values())


def _takes(types: list[str] | None, kind: str) -> bool:
    return types is None or kind in types
