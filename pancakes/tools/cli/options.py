"""Arguments and options that verbs share: names of agents and what they have, `--at`, `--fleet`, `--format`.

An agent, task, service or channel is named `AGENT`, `AGENT/TASK`, `AGENT/SERVICE/TASK`, `AGENT/SERVICE` or
`AGENT/CHANNEL`. The fleet may come first (`FLEET/AGENT/TASK`); then the verb talks to that fleet. A name of three
parts means `AGENT/SERVICE/TASK` if such an agent exists (`pancakes.tools.cli.agent_requests.resolve_fleet`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial, wraps
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple, TypeVar, cast

import click

from pancakes.tools.cli.output import Printer, show_text

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

    from pancakes.client import Client, Target


class TaskName(NamedTuple):
    """Name a task.

    Attributes:
        agent: the agent that it is on.
        service: its service; empty if it was not given.
        task: its name.
    """

    agent: str
    service: str
    task: str

    @property
    def target(self) -> str:
        """The name as the agent itself reads it (see `pancakes.control`)."""
        return f"{self.service}/{self.task}" if self.service else self.task

    def __str__(self) -> str:
        return f"{self.agent}/{self.target}"


class ServiceName(NamedTuple):
    """Name a service.

    Attributes:
        agent: the agent that it is on.
        service: its name.
    """

    agent: str
    service: str

    @property
    def target(self) -> str:
        """The name as the agent itself reads it, even if one of its tasks has the same name."""
        return f"{self.service}/"

    def __str__(self) -> str:
        return f"{self.agent}/{self.service}"


class ChannelName(NamedTuple):
    """Name a channel.

    Attributes:
        agent: the agent whose channel it is.
        channel: its name, such as `system`.
    """

    agent: str
    channel: str

    def __str__(self) -> str:
        return f"{self.agent}/{self.channel}"


_FLEET: Final = "pancakes.fleet"
"""The key in the click context for the fleet that precedes one of the command's names."""


def note_fleet(type_: click.ParamType, fleet: str, param: click.Parameter | None, ctx: click.Context | None) -> None:
    """Note the fleet that precedes a name, for `fleet_of_command`; all names of a command must be in one fleet."""
    if ctx is not None and ctx.meta.setdefault(_FLEET, fleet) != fleet:
        type_.fail(f"a command talks to one fleet, not to {ctx.meta[_FLEET]} and {fleet}", param, ctx)


def fleet_of_command(option: str) -> str:
    """Return the fleet of a command, from `--fleet` or from its names; empty: any fleet."""
    named: str = click.get_current_context().meta.get(_FLEET, "")
    if option and named and option != named:
        raise click.UsageError(f"a command talks to one fleet, not to {option} (--fleet) and {named}")
    return option or named


class NameType(click.ParamType):
    """Read a name, with or without its fleet; for arguments and options.

    Args:
        noun: what the name is for: `agent`, `task`, `service` or `channel`.
        name: how the name is written.
        counts: how many parts it may have; with the largest number, the first part is the fleet.
        make: makes the name from its parts, without the fleet.
        how: how to write it, for the message about a malformed name.
    """

    def __init__(self, noun: str, name: str, counts: Sequence[int], make: Callable[..., Any], how: str = "") -> None:
        self.noun = noun
        self.name = name
        self._counts = counts
        self._make = make
        self._how = how or f"write it as {name} or FLEET/{name}"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not isinstance(value, str):
            return value
        parts = value.split("/")
        if len(parts) not in self._counts or (len(parts) > 1 and not all(parts)):
            self.fail(f"{value!r} is not a valid {self.noun} name: {self._how}", param, ctx)
        if len(parts) == max(self._counts):
            note_fleet(self, parts.pop(0), param, ctx)
        return self._make(*parts)

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """See `click.ParamType`."""
        from pancakes.tools.cli.name_completion import names

        return names(self.noun, ctx, param, incomplete)


def _task_name(agent: str, *rest: str) -> TaskName:
    *service, task = rest
    return TaskName(agent, "".join(service), task)


AGENT_NAME: Final = NameType("agent", "AGENT", (1, 2), str)
TASK_NAME: Final = NameType(
    "task",
    "AGENT/TASK",
    (2, 3, 4),
    _task_name,
    "write it as AGENT/TASK or AGENT/SERVICE/TASK, with FLEET/ before it if needed",
)
SERVICE_NAME: Final = NameType("service", "AGENT/SERVICE", (2, 3), ServiceName)
CHANNEL_NAME: Final = NameType("channel", "AGENT/CHANNEL", (2, 3), ChannelName)

an_agent = click.argument("agent", metavar="[AGENT]", default="", type=AGENT_NAME)
"""The argument `agent` of a verb about all agents or one of them; a string, empty if omitted."""
the_agent = click.argument("agent", metavar="AGENT", type=AGENT_NAME)
"""The argument `agent` of a verb about one agent; a string."""
agents = click.argument("agents", metavar="[AGENT]...", nargs=-1, type=AGENT_NAME)
"""The argument `agents` of a verb about all agents or those named; a tuple of strings."""
a_channel = click.argument("name", metavar="AGENT/CHANNEL", type=CHANNEL_NAME)
"""The argument `name` of a verb about one channel, a `ChannelName`."""
a_task = click.argument("name", metavar="AGENT/TASK", type=TASK_NAME)
"""The argument `name` of a verb about one task, a `TaskName`."""
a_service = click.argument("name", metavar="AGENT/SERVICE", type=SERVICE_NAME)
"""The argument `name` of a verb about one service, a `ServiceName`."""


_F = TypeVar("_F", bound=Callable[..., Any])


class AgentAddress(click.ParamType):
    """`HOST`, `HOST:PORT` or `tcp://HOST:PORT`, without a port 7401; `mdns:` means all that announce themselves."""

    name = "address"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        from pancakes.mesh.address import MDNS, dialled

        try:
            return MDNS if value == MDNS else dialled(str(value))
        except ValueError as error:
            self.fail(str(error), param, ctx)


NO_FILE: Final = "'' names nothing: is a variable of the shell empty? The folder here is ."


class FileOrFolder(click.Path):
    """A path, of a file or a folder. An empty one, as of an unset variable of a shell, is not the working directory."""

    def __init__(self) -> None:
        from pathlib import Path

        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not str(value):
            self.fail(NO_FILE, param, ctx)
        return super().convert(value, param, ctx)


class Duration(click.ParamType):
    """A time such as `30s`, `500ms`, `2min` or `1h`, converted to seconds; a plain number means seconds.

    Args:
        least_s: the shortest time.
        most_s: the longest time.
        zero: whether 0 is allowed: as a moment it is one, as a duration it rarely makes sense.
    """

    name = "duration"

    _UNITS_S: ClassVar = {"": 1.0, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}

    def __init__(self, least_s: float = 0.0, most_s: float = math.inf, *, zero: bool = False) -> None:
        self._least_s = least_s
        self._most_s = most_s
        self._zero = zero

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        if isinstance(value, float):
            return value
        found = re.fullmatch(r"([0-9]+\.?[0-9]*|\.[0-9]+)\s*(|ms|s|min|h)", str(value).strip())
        if found is None:
            self.fail(f"{value!r} is not a time: write it as 30s, 500ms, 2min or 1h", param, ctx)
        if float(found[1]) == 0.0 and not self._zero:
            self.fail(f"{value!r} is too short: the time must be more than 0s", param, ctx)
        duration_s = float(found[1]) * self._UNITS_S[found[2]]
        if duration_s < self._least_s:
            self.fail(f"{value!r} is less than {self._least_s:g}s", param, ctx)
        if duration_s > self._most_s:
            self.fail(f"{value!r} is more than {self._most_s:g}s", param, ctx)
        return duration_s


class FiniteRange(click.FloatRange):
    """A number within bounds; unlike click's own, it refuses NaN, infinity, and `1_0` for 10."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        number: float = super().convert(value, param, ctx)
        if "_" in str(value):
            self.fail(f"{value!r} is not a number", param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number", param, ctx)
        return number


class TakesNumbers(click.Command):
    """A command with a number among its arguments: `-1` is read as a number, not as an option."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if any(re.fullmatch(r"-\.?\d.*", it) for it in args):
            ctx.ignore_unknown_options = True
        return super().parse_args(ctx, args)


def format_option_of(default: str, help_: str) -> Callable[[_F], _F]:
    """Return the option `--format`; its parameter is `printer`."""
    return click.option(
        "--format",
        "printer",
        type=click.Choice(["table", "json"]),
        default=default,
        show_default=True,
        callback=lambda context, option, value: Printer(value),
        help=help_,
    )


format_option = format_option_of("table", "How to print the answer.")
"""The option `--format` of most verbs; its parameter is `printer`."""


@dataclass(frozen=True, slots=True)
class Ask:
    """How a verb asks agents and prints their answers, from its options `--at`, `--fleet` and so on.

    Attributes:
        where: the addresses and the fleet; the fleet may also come from a name (see this module).
        timeout_s: how long to wait for answers.
        printer: prints the answers.
    """

    where: Target
    timeout_s: float
    printer: Printer

    def client(self) -> Client:
        """Return a new client."""
        from pancakes.client import Client

        return Client(self.where, self.timeout_s, partial(show_text, err=True))


def asks_agents_for(timeout_s: float, *, formats: bool = True) -> Callable[[_F], _F]:
    """Give a verb the options `--at`, `--fleet`, `--timeout` and `--format`.

    Its parameter is `ask`.

    Args:
        timeout_s: the default of `--timeout`.
        formats: whether it has `--format`.
    """
    options = (
        *((format_option,) if formats else ()),
        click.option(
            "--at",
            metavar="HOST[:PORT]",
            type=AgentAddress(),
            multiple=True,
            help="Ask the agent at this address and its fleet, not the agents of this machine; mdns: asks those that"
            " announce themselves on its networks. Repeatable.",
        ),
        click.option("--fleet", metavar="NAME", default="", help="Only agents of this fleet."),
        click.option(
            "--timeout",
            metavar="TIME",
            type=Duration(most_s=3600.0),
            default=f"{timeout_s:g}s",
            show_default=True,
            help="How long to wait for answers.",
        ),
    )

    def decorate(function: _F) -> _F:
        @wraps(function)
        def asking(
            at: tuple[str, ...], fleet: str, timeout: float, printer: Printer | None = None, **others: Any
        ) -> Any:
            from pancakes.client import Target

            ask = Ask(Target(at, fleet_of_command(fleet)), timeout, printer or Printer("table"))
            return function(ask=ask, **others)

        decorated: Any = asking
        for option in reversed(options):
            decorated = option(decorated)
        return cast(_F, decorated)

    return decorate


asks_agents = asks_agents_for(3.0)
"""For verbs that only read."""
orders_agents = asks_agents_for(10.0)
"""For verbs that change something: a task may be busy before it can stop."""

dry_run_option = click.option("--dry-run", is_flag=True, help="Check whether it would be done, but change nothing.")
"""The option `dry_run` of every verb that changes something; the agent itself makes its checks."""


def keep_state_option(help_: str) -> Callable[[_F], _F]:
    """Return the option `--keep-state/--drop-state`; its parameter is `keep_state`."""
    return click.option("--keep-state/--drop-state", default=True, show_default=True, help=help_)


agent_sets_option = click.option(
    "--set",
    "sets",
    multiple=True,
    metavar="[AGENT:]KEY=VALUE",
    help="Override a configuration key of one agent, or of all agents. Repeatable.",
)
"""The option `--set` of the verbs that start agents; its parameter is `sets`."""
