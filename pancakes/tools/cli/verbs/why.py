"""`pancakes why`: explain the commands to actuators in a recording, and how long each step took."""

from __future__ import annotations

import math
from collections.abc import Iterator
from heapq import heappush, heappushpop
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from pancakes.errors import PancakesError
from pancakes.events import Event
from pancakes.packet import Cause, agent_of
from pancakes.tools.cli.options import Duration, format_option
from pancakes.tools.cli.output import Part, Printer, Rows
from pancakes.tools.cli.streaming import load_packets, say

if TYPE_CHECKING:
    from pancakes.recording.causal_chains import ActuatorCommand
    from pancakes.recording.clock_alignment import MissionTime
    from pancakes.recording.reader import RecordingReader
    from pancakes.recording.records import RecordedPacket
    from pancakes.tools.report.command_latency import Reaction, Reactions

LONGEST: Final = 100
"""At most this many characters of a packet's body are shown on a line."""
MOST_ALIKE: Final = 50
"""At most this many matching commands are shown with their chains; --list shows all."""


@click.command()
@click.argument("path", metavar="FILE|DIR", type=click.Path(path_type=Path))
@click.option("--agent", metavar="AGENT", default="", help="Only commands to this agent's actuators.")
@click.option("--type", "type_", metavar="TYPE", default="", help="Only commands to this actuator, such as motors.")
@click.option("--task", metavar="ID", default="", help="Only commands of this task (BIRTHPLACE/NAME).")
@click.option(
    "--time", "time_s", metavar="TIME", type=Duration(zero=True),
    help="The command of each actuator that was in force at this mission time: 42.5s, 2min.",
)  # fmt: skip
@click.option("--seq", metavar="N", type=click.IntRange(min=1), help="The commands with this number, as in --list.")
@click.option("--slowest", metavar="N", type=click.IntRange(min=1), help="The N commands with the longest latency.")
@click.option("--list", "list_", is_flag=True, help="List all commands, one per line.")
@format_option
def why(path: Path, list_: bool, printer: Printer, **options: Any) -> None:
    """Show what led to the commands to actuators in a recording, and how long that took.

    Without options it shows the kinds of chains that led to commands, with the distribution of the latency from the
    first cause to the command. With --time, --seq or --slowest it shows single commands: the chain of packets back to
    the sensor reading, with the body of each packet, its travel time between agents, and the time in a mailbox and in
    a handler until the next packet was published. Mission time is that of the whole recording, as in its report: it
    does not begin again when an agent is restarted.

    \b
    Example:
        pancakes why runs/encirclement-1-virtual/recording
        pancakes why recordings --agent agent1 --time 42.5s
        pancakes why recordings --type motors --slowest 3
        pancakes why recordings --list --format json
    """
    from pancakes.recording.reader import RecordingReader

    single = [options[name] for name in ("time_s", "seq", "slowest") if options[name] is not None]
    if len(single) + list_ > 1:
        raise click.UsageError("--time, --seq, --slowest and --list exclude each other: use only one of them")
    load_packets()
    reader = RecordingReader(path)
    question = _CommandQuestion(reader, **options)
    if list_:
        with printer.stream(True, _line) as stream:
            for command in question.commands():
                stream.show(_row(command, question.time))
    elif not single:
        _show_kinds(question, printer)
    else:
        _show_chains(question, printer)
    for note in reader.notes():
        say(note)
    if not question.time.known:
        say(f"mission_s is the {question.time.name}, because the missions of its agents did not begin together")
    if not question.found.commands:
        raise PancakesError(question.none_found())


class _CommandQuestion:
    """Select the commands that the options ask for, and collect statistics while they are read."""

    def __init__(
        self,
        reader: RecordingReader,
        time_s: float | None,
        seq: int | None,
        slowest: int | None,
        **filters: str,
    ) -> None:
        from pancakes.tools.report.command_latency import Reactions

        self.time_s, self.seq, self.slowest = time_s, seq, slowest
        self.found: Reactions = Reactions()
        self.time = reader.mission_time()
        self._reader = reader
        self._filters = filters
        self.filtered = _FilterEvents()
        self._others: set[str] = set()

    def commands(self) -> Iterator[ActuatorCommand]:
        """Yield the selected commands, oldest first."""
        from pancakes.recording.causal_chains import CommandChains

        chains = CommandChains()
        for entry in self._reader.entries():
            self.filtered.add(entry)
            yield from self._matching(chains.add(entry))
        yield from self._matching(chains.close())

    def none_found(self) -> str:
        """Return a sentence that no command was found, with the commands that exist."""
        if not self._others:
            return f"{self._reader.path} has no command to an actuator"
        return f"{self._reader.path} has no such command. It has commands to {', '.join(sorted(self._others))}"

    def _matching(self, commands: list[ActuatorCommand]) -> Iterator[ActuatorCommand]:
        for command in commands:
            fence = command.packet.fence
            task_id = fence.task_id if fence is not None else ""
            values = {"agent": command.agent, "type_": command.packet.type, "task": task_id}
            if all(wanted in ("", values[name]) for name, wanted in self._filters.items()):
                self.found.add_command(command)
                yield command
            else:
                self._others.add(f"{command.agent} {command.packet.type}" + (f" of {task_id}" if task_id else ""))


class _FilterEvents:
    """Collect what filters of actuators did: their events `command_filtered` on `log`."""

    def __init__(self) -> None:
        self._of: dict[tuple[str, str, str], list[tuple[int, Cause | None, str, str]]] = {}

    def add(self, entry: RecordedPacket) -> None:
        """Take any packet of the recording."""
        packet = entry.packet
        body = packet.body
        if not (isinstance(body, Event) and body.kind == "command_filtered"):
            return
        device, name, doing, reason = (str(body.fields.get(key, "")) for key in ("device", "filter", "doing", "reason"))
        seen = self._of.setdefault((agent_of(packet.source), device, name), [])
        seen.append((entry.time_ns, packet.cause, doing, reason))

    def at(self, command: ActuatorCommand) -> list[dict[str, str]]:
        """Return which filters of the agent changed or held commands when a command came, and why."""
        cause = (command.packet.source, command.packet.seq)
        found = []
        for (agent, device, name), seen in sorted(self._of.items()):
            # What a command itself leads to is recorded after it.
            before = [it for it in seen if it[0] <= command.time_ns or it[1] == cause]
            if agent == command.agent and before and before[-1][2] != "passes":
                found.append({"device": device, "filter": name, "doing": before[-1][2], "reason": before[-1][3]})
        return found


def _show_kinds(question: _CommandQuestion, printer: Printer) -> None:
    for _ in question.commands():
        pass
    found = question.found
    if not found.commands:
        return
    kinds = [_distribution(it) for it in found.reactions()]
    counts = {"commands": found.commands, "uncaused": found.uncaused, "left_out": found.left_out}
    answers = f"{found.uncaused:,} of them answer no packet" if found.uncaused else "each of them answers a packet"
    rows = [{**it, "chain": " → ".join(it["steps"])} for it in kinds]
    printer.emit(
        {**counts, "kinds": kinds},
        f"{found.commands:,} commands; {answers} that was recorded",
        Rows(rows, ("count", "p50_ms", "p90_ms", "p99_ms", "max_ms", "chain")) if rows else "",
        f"{found.left_out:,} more have chains of rarer kinds" if found.left_out else "",
    )


def _show_chains(question: _CommandQuestion, printer: Printer) -> None:
    chosen, more = _choose(question)
    rows = [
        {
            **_row(it, question.time),
            "chain": _steps(it, question.time),
            "alike": _alike(question, it),
            "filtered": question.filtered.at(it),
        }
        for it in chosen
    ]
    printer.emit(rows, *map(_parts, rows))
    if more:
        say(f"{more:,} more match: narrow them with --agent and --type, or see all with --list")
    if question.found.commands and not chosen:
        time_s = question.time_s
        condition = f"before {time_s:g} s of mission time" if time_s is not None else f"with the number {question.seq}"
        if question.slowest is not None:
            condition = "that answers a recorded packet"
        raise PancakesError(f"the recording has no such command {condition}")


def _choose(question: _CommandQuestion) -> tuple[list[ActuatorCommand], int]:
    """Return the commands to show, and how many more match."""
    time_s, slowest = question.time_s, question.slowest
    if slowest is not None:
        heap: list[tuple[float, int, ActuatorCommand]] = []
        for number, command in enumerate(question.commands()):
            item = (command.chain.latency_s, -number, command)
            if command.caused:
                (heappush if len(heap) < slowest else heappushpop)(heap, item)
        return [command for *_, command in sorted(heap, key=lambda it: (-it[0], -it[1]))], 0
    newest: dict[tuple[str, str], ActuatorCommand] = {}
    matching: list[ActuatorCommand] = []
    more = 0
    for command in question.commands():
        if time_s is not None and question.time.at(command.time_ns) <= time_s:
            newest[command.agent, command.packet.type] = command
        elif question.seq in (command.packet.seq, command.packet.number):
            matching = [*matching, command][:MOST_ALIKE]
            more += 1
    return [command for _, command in sorted(newest.items())] + matching, more - len(matching)


def _row(command: ActuatorCommand, time: MissionTime) -> dict[str, Any]:
    packet = command.packet
    return {
        "mission_s": round(time.at(command.time_ns), 6),
        "agent": command.agent,
        "type": packet.type,
        "source": packet.source,
        "seq": packet.seq,
        "number": packet.number,
        "task_id": packet.fence.task_id if packet.fence is not None else "",
        "steps": len(command.chain.steps),
        "latency_ms": _ms(command.chain.latency_s) if command.caused else None,
        "cause": command.chain.steps[0].name if command.caused else None,
    }


def _line(row: dict[str, Any]) -> str:
    cause = f"{row['latency_ms']:9.3f} ms after {row['cause']}" if row["cause"] else "answers no packet"
    return f"{row['mission_s']:9.3f} s  {row['agent']} {row['type']}  from {row['source']} #{row['number']}  {cause}"


def _steps(command: ActuatorCommand, time: MissionTime) -> list[dict[str, Any]]:
    from pancakes.packet import body_to_plain
    from pancakes.recording.causal_chains import chain_rows

    return [
        {
            **row,
            "mission_s": round(time.at(step.time_ns), 6),
            "seen_ns": step.time_ns,
            "body": body_to_plain(step.packet.body),
        }
        for row, step in zip(chain_rows(command.chain), command.chain.steps, strict=True)
    ]


def _alike(question: _CommandQuestion, command: ActuatorCommand) -> dict[str, Any] | None:
    reaction = question.found.alike(command.chain) if command.caused else None
    return _distribution(reaction) if reaction is not None else None


def _distribution(reaction: Reaction) -> dict[str, Any]:
    shares = {f"{name}_ms": _ms(value_s) for name, value_s in reaction.latency_s.quantiles().items()}
    largest_s = reaction.latency_s.largest
    return {
        "count": reaction.count,
        **shares,
        "max_ms": _ms(largest_s) if math.isfinite(largest_s) else None,
        "step_means_ms": [_ms(mean) for mean in reaction.step_means_s],
        "steps": list(reaction.steps),
    }


def _parts(row: dict[str, Any]) -> Iterator[Part]:
    from pancakes.recording.causal_chains import body_text

    of = f" for {row['task_id']}" if row["task_id"] else ""
    yield f"{row['agent']} {row['type']} at {row['mission_s']:.3f} s, from {row['source']}{of} (#{row['number']})"
    for it in row["filtered"]:
        yield f"the filter {it['filter']} of {it['device']} {it['doing']} commands at this moment: {it['reason']}"
    if row["cause"] is None:
        yield "it answers no recorded packet: a timer led to it, or its cause is not in the recording"
    last = len(row["chain"]) - 1
    steps = [
        {
            "at ms": step["at_ms"],
            "packet": f"{step['source']} {step['type']} #{step['number']}",
            "travel ms": step["travel_ms"] if place < last else None,
            "handling ms": step["handling_ms"] if place < last else None,
            "body": body_text(step["body"], LONGEST),
        }
        for place, step in enumerate(row["chain"])
    ]
    yield Rows(steps, list(steps[0]))
    if any(step["travel_ms"] is None for step in row["chain"]):
        yield "an empty `travel ms` means that no agent recorded when the packet left: the whole chain took longer"
    alike = row["alike"]
    if alike is not None:
        yield (
            f"{row['latency_ms']:g} ms from the first cause to the command. Of {alike['count']:,} commands with such a"
            f" chain: p50 {alike['p50_ms']:g}, p90 {alike['p90_ms']:g}, p99 {alike['p99_ms']:g}, longest"
            f" {alike['max_ms']:g} ms"
        )
    yield "\n"


def _ms(seconds: float) -> float:
    return round(1e3 * seconds, 3)
