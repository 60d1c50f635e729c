"""`pancakes log`: what agents say and do."""

from __future__ import annotations

import os
import re
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import click

from pancakes.client import Client
from pancakes.control import History
from pancakes.errors import ControlRefused, PancakesError
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
            self.fail(f"{value!r} is no regular expression: {error}", param, ctx)


@click.command()
@some_agents
@click.option("-f", "--follow", is_flag=True, help="Go on with what is said from now on, until Ctrl-C.")
@click.option(
    "--level",
    type=click.Choice(LEVELS),
    default="info",
    show_default=True,
    help="Only lines of this level and above; events count as info, or as debug if a line says the same.",
)
@from_option
@click.option("--since", "since_s", metavar="TIME", type=Duration(), help="Only what was said in the last 30s.")
@click.option("--grep", metavar="REGEX", type=Pattern(), help="Only lines in which this regular expression is found.")
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
    """Show what all agents, or only those named, have said and done.

    The Log Service of each agent remembers its last 2,000 lines and events. They are shown in the order in which they
    happened; the time before each is its agent's mission time, in seconds, and so are those of --since.
    With --follow, agents that are started meanwhile or come back are taken in, with all they have said by then.
    JSON is a list, with --follow one object a line; it has the traceback of each failure.

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
        sources: only from these addresses; none: from all.
        grep: only what it is found in.
    """
    own = level_of(record)
    return (
        (own not in LEVELS or LEVELS.index(own) >= LEVELS.index(level))
        and from_any(record["source"], sources)
        and (grep is None or grep.search(f"{record['source']}: {words_of(record)}") is not None)
    )


def level_of(record: Record) -> str:
    """Return the level of a record; an event counts as `info`, or as `debug` where a line says the same."""
    if "level" in record and record["kind"] == "line":
        return str(record["level"])
    return "debug" if record["kind"] in SAID_IN_A_LINE else "info"


def words_of(record: Record) -> str:
    """Return what a record says, in one line."""
    if "text" in record and record["kind"] == "line":
        return str(record["text"])
    fields = [(key, value) for key, value in record.items() if key not in ("t_s", "agent", "source", "kind")]
    return " ".join([record["kind"], *(f"{key}={value}" for key, value in fields if value not in (None, ""))])


def text_of(record: Record) -> str:
    """Return a record as a line for people."""
    return printable_line(f"{record['t_s']:9.3f} {level_of(record):<7} {record['source']}: {words_of(record)}")


def colour_of(record: Record) -> str | None:
    """Return the colour of its line; it stays only if it can be seen."""
    return COLOURS.get(level_of(record)) if "NO_COLOR" not in os.environ else None


def with_traceback(record: Record) -> str:
    """Return a record as `text_of` does, and below it the traceback of the failure that it tells of."""
    rows = str(record.get("traceback", "")).splitlines() if record["kind"] == "line" else []
    return "\n".join([text_of(record), *(printable(f"          {row}") for row in rows)])


# Where it comes from ------------------------------------------------------------------------------------------


def _history(client: Client, agents: Sequence[str], since_s: float | None) -> Iterator[Record]:
    """Yield what was said until now, in its order."""
    yield from (record for _, record in _merged(client, survey_with(client, *agents), since_s))


def _merged(client: Client, described: Sequence[Mapping[str, Any]], since_s: float | None) -> list[tuple[str, Record]]:
    """Return what agents remember, each with the agent that does, by the time at which it was said.

    That is not always the agent that has said it: who publishes on `log` to another is remembered there. The clocks of
    two agents differ, so it counts how long ago something was said, on the clock of its own agent.
    """
    dated: list[tuple[float, str, Record]] = []
    refusals = []
    for agent in described:
        try:
            records = _remembered(client, agent["agent"], since_s)
        except ControlRefused as error:
            refusals.append(f"{agent['agent']} does not tell what was said: {error}")
        else:
            # Its mission time is of about now: all agents have just been asked.
            now_s, speed, name = agent["mission_s"], agent["speed"], agent["agent"]
            dated.extend(((record["t_s"] - now_s) / speed, name, record) for record in records)
    if refusals and len(refusals) == len(described):
        raise ControlRefused("\n".join(refusals))
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
    """Yield what was said until now, then what is said.

    What an agent says is followed first and asked for then, so that nothing falls between the two; and asked for again
    when it comes back. What is in both is left out once.
    """
    anew: list[str] = []
    known: dict[str, Known] = {}
    began_s = client.now()
    with (
        client.subscribe(LOG, agents=agents, max_waiting=MOST_WAITING, on_resubscribe=anew.append) as subscriber,
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

        yield from remembered(client.survey(*agents).agents)
        for heard in listen(client, subscriber):
            while anew:
                try:
                    yield from remembered(client.survey(anew.pop()).agents)
                except PancakesError as error:
                    say(str(error))
            if heard is not None:
                record = record_of(heard.packet)
                if known.setdefault(heard.agent, Known()).comes(record):
                    yield record


class Known:
    """Which records of one agent have been shown, so that none is shown twice if it comes in two ways."""

    def __init__(self) -> None:
        self._shown: deque[str] = deque(maxlen=2 * REMEMBERED)
        self._not_new: Counter[str] = Counter()
        self._to_come: Counter[str] = Counter()

    def ask(self, remembered: Sequence[Record]) -> None:
        """Take all that the agent remembers."""
        self._not_new = Counter(self._shown)
        self._to_come = Counter(line_of(dict(record)) for record in remembered)

    def is_new(self, record: Record) -> bool:
        """Return whether one of these is to be shown: it was not before."""
        return self._show(record, self._not_new)

    def comes(self, record: Record) -> bool:
        """Return whether a record that comes as it is said is to be shown: it was not among what was remembered."""
        return self._show(record, self._to_come)

    def _show(self, record: Record, known: Counter[str]) -> bool:
        line = line_of(dict(record))
        if known[line]:
            known[line] -= 1
            return False
        self._shown.append(line)
        return True
