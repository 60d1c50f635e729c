"""`pancakes log`: show the log lines and the events of agents."""

from __future__ import annotations

import os
import re
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import click

from pancakes.client import Client
from pancakes.control import History
from pancakes.errors import ControlRefusedError, PancakesError
from pancakes.events import LEVELS, SAID_IN_A_LINE, line_of, record_of
from pancakes.packet import LOG
from pancakes.services.log import REMEMBERED
from pancakes.tools.cli.agent_requests import request_result, survey_with
from pancakes.tools.cli.listening import MOST_WAITING, from_any, from_option, listen, telling_losses
from pancakes.tools.cli.options import Ask, Duration, asks_agents
from pancakes.tools.cli.options import agents as some_agents
from pancakes.tools.cli.streaming import say, until_ended
from pancakes.util.text import printable, printable_line

COLOURS: Final = {"debug": "bright_black", "info": "", "warning": "yellow", "error": "red"}

Record = Mapping[str, Any]


class Pattern(click.ParamType):
    """A regular expression."""

    name = "regex"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> re.Pattern[str]:
        try:
            return re.compile(value)
        except re.error as error:
            self.fail(f"{value!r} is not a regular expression: {error}", param, ctx)


@click.command()
@some_agents
@click.option("-f", "--follow", is_flag=True, help="Continue with new lines and events, until Ctrl-C.")
@click.option(
    "--level",
    type=click.Choice(LEVELS),
    default="info",
    show_default=True,
    help="Only lines of this level and above; events count as info, or as debug if a log line repeats them.",
)
@from_option
@click.option(
    "--since", "since_s", metavar="TIME", type=Duration(), help="Only the lines of this last time, such as 30s."
)
@click.option("--grep", metavar="REGEX", type=Pattern(), help="Only lines that match this regular expression.")
@click.option("--traceback", is_flag=True, help="Show failures with their whole tracebacks.")
@asks_agents
def log(
    agents: tuple[str, ...],
    follow: bool,
    level: str,
    sources: tuple[str, ...],
    since_s: float | None,
    grep: re.Pattern[str] | None,
    traceback: bool,
    ask: Ask,
) -> None:
    """Show the log lines and events of all agents, or only of those named.

    The Log Service of each agent remembers its last 2,000 lines and events. They are shown in the order in which they
    happened. The time before each is the agent's mission time in seconds, and --since is in mission time, too.
    With --follow, agents that start or come back meanwhile are included, with all lines that they remember.
    JSON is a list, or with --follow one object per line; it has the traceback of each failure.

    \b
    Example:
        pancakes log --since 30s --level warning
        pancakes log -f agent1 --from agent1/client/ScanTarget
        pancakes log --level debug --grep 'task_(failed|given_up)' --format json
    """
    show = with_traceback if traceback else text_of
    with until_ended(), ask.client() as client, ask.printer.stream(not follow, show, colour_of) as stream:
        records = _followed(client, agents, since_s) if follow else _history(client, agents, since_s)
        for record in records:
            if wants(record, level, sources, grep):
                stream.show(record)


def wants(record: Record, level: str, sources: Sequence[str], grep: re.Pattern[str] | None) -> bool:
    """Return whether a user wants to see a record.

    Args:
        record: the record.
        level: lines of this level and above.
        sources: only from these addresses; empty: from all.
        grep: only records that it matches.
    """
    record_level = level_of(record)
    return (
        (record_level not in LEVELS or LEVELS.index(record_level) >= LEVELS.index(level))
        and from_any(record["source"], sources)
        and (grep is None or grep.search(f"{record['source']}: {words_of(record)}") is not None)
    )


def level_of(record: Record) -> str:
    """Return the level of a record; an event counts as `info`, or as `debug` if a log line repeats it."""
    if "level" in record and record["kind"] == "line":
        return str(record["level"])
    return "debug" if record["kind"] in SAID_IN_A_LINE else "info"


def words_of(record: Record) -> str:
    """Return the text of a record, on one line."""
    if "text" in record and record["kind"] == "line":
        return str(record["text"])
    fields = [(key, value) for key, value in record.items() if key not in ("t_s", "agent", "source", "kind")]
    return " ".join([record["kind"], *(f"{key}={value}" for key, value in fields if value not in (None, ""))])


def text_of(record: Record) -> str:
    """Return a record as a line for people."""
    return printable_line(f"{record['t_s']:9.3f} {level_of(record):<7} {record['source']}: {words_of(record)}")


def colour_of(record: Record) -> str | None:
    """Return the colour of a record's line; None if it has none, or if NO_COLOR is set."""
    return COLOURS.get(level_of(record)) if "NO_COLOR" not in os.environ else None


def with_traceback(record: Record) -> str:
    """Return a record as `text_of` does, followed by the traceback of its failure."""
    rows = str(record.get("traceback", "")).splitlines() if record["kind"] == "line" else []
    return "\n".join([text_of(record), *(printable(f"          {row}") for row in rows)])


# Where it comes from ------------------------------------------------------------------------------------------


def _history(client: Client, agents: Sequence[str], since_s: float | None) -> Iterator[Record]:
    """Yield the records of the past, in their order."""
    yield from (record for _, record in _merged(client, survey_with(client, *agents), since_s))


def _merged(client: Client, described: Sequence[Mapping[str, Any]], since_s: float | None) -> list[tuple[str, Record]]:
    """Return the remembered records of agents, each with the agent that remembers it, in order of time.

    An agent also remembers what others published to its `log`. The clocks of agents differ, so records are ordered by
    how long ago they were made, on the clock of the agent that remembers them.
    """
    dated: list[tuple[float, str, Record]] = []
    refusals = []
    for agent in described:
        try:
            records = _remembered(client, agent["agent"], since_s)
        except ControlRefusedError as error:
            refusals.append(f"{agent['agent']} refuses to show its log: {error}")
        else:
            # Its mission time is nearly the present one, because all agents have just been asked.
            now_s, speed, name = agent["mission_s"], agent["speed"], agent["agent"]
            dated.extend(((record["t_s"] - now_s) / speed, name, record) for record in records)
    if refusals and len(refusals) == len(described):
        raise ControlRefusedError("\n".join(refusals))
    for refusal in refusals:
        say(refusal)
    return [(name, record) for _, name, record in sorted(dated, key=lambda it: it[0])]


def _remembered(client: Client, agent: str, since_s: float | None) -> list[Record]:
    """Return all that the Log Service of an agent remembers, page by page."""
    records: list[Record] = []
    after = 0
    while page := request_result(client, agent, History(since_s, after)):
        after = page[-1]["entry"]
        records.extend({key: value for key, value in record.items() if key != "entry"} for record in page)
    return records


def _followed(client: Client, agents: Sequence[str], since_s: float | None) -> Iterator[Record]:
    """Yield the records of the past, then new ones as they come.

    It first subscribes to an agent's log and then asks for its past, so that no record is lost between the two. It asks
    again when an agent comes back. A record that comes both ways is yielded once.
    """
    resubscribed: list[str] = []
    known: dict[str, Known] = {}
    began_s = client.now()
    with (
        client.subscribe(
            LOG, agents=agents, max_waiting=MOST_WAITING, on_resubscribe=resubscribed.append
        ) as subscriber,
        telling_losses(client, subscriber, LOG),
    ):

        def remembered(described: Sequence[Mapping[str, Any]]) -> Iterator[Record]:
            speed = max((agent["speed"] for agent in described), default=1.0)
            back_s = None if since_s is None else since_s + (client.now() - began_s) * speed
            records = _merged(client, described, back_s)
            for agent in described:
                of_agent = [record for name, record in records if name == agent["agent"]]
                known.setdefault(agent["agent"], Known()).ask(of_agent)
            return (record for name, record in records if known[name].is_new(record))

        yield from remembered(client.describe(*agents).agents)
        for received in listen(client, subscriber):
            while resubscribed:
                try:
                    yield from remembered(client.describe(resubscribed.pop()).agents)
                except PancakesError as error:
                    say(str(error))
            if received is not None:
                record = record_of(received.packet)
                if known.setdefault(received.agent, Known()).comes(record):
                    yield record


class Known:
    """Remember which records of one agent have been shown, so that a record that comes twice is shown once."""

    def __init__(self) -> None:
        self._shown: deque[str] = deque(maxlen=2 * REMEMBERED)
        self._not_new: Counter[str] = Counter()
        self._to_come: Counter[str] = Counter()

    def ask(self, remembered: Sequence[Record]) -> None:
        """Take all records that the agent remembers."""
        self._not_new = Counter(self._shown)
        self._to_come = Counter(line_of(dict(record)) for record in remembered)

    def is_new(self, record: Record) -> bool:
        """Return whether to show a remembered record: it was not shown before."""
        return self._show(record, self._not_new)

    def comes(self, record: Record) -> bool:
        """Return whether to show a new record: it was not among the remembered ones."""
        return self._show(record, self._to_come)

    def _show(self, record: Record, known: Counter[str]) -> bool:
        line = line_of(dict(record))
        if known[line]:
            known[line] -= 1
            return False
        self._shown.append(line)
        return True
