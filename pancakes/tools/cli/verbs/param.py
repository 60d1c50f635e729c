"""`pancakes param ...`: show and change the settings of tasks while they run."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, Final

import click

from pancakes.client import Client
from pancakes.control import Configure, Describe
from pancakes.errors import ControlRefusedError
from pancakes.tools.cli.agent_requests import request, request_result, resolve_fleet, resolve_service, survey_with
from pancakes.tools.cli.exit_codes import OK, REFUSED
from pancakes.tools.cli.help_sections import SectionedGroup
from pancakes.tools.cli.options import Ask, TaskName, a_task, asks_agents, dry_run_option, orders_agents
from pancakes.tools.cli.output import DRY_RUN, Rows, show_text
from pancakes.tools.cli.verbs import param_file
from pancakes.tools.cli.verbs.task_arguments import AgentOrTask, Changes, ParamName, SettingChange, a_task_or_agent
from pancakes.util.text import hint_of, printable_data

COLUMNS = ("agent", "service", "task", "param", "value")
CHANGED = ("agent", "service", "task", "param", "before", "value", "done", "number")
DESCRIBED = ("param", "value", "type", "default", "bounds", "unit", "description")
LOADED = ("agent", "service", "task", "params", "done", "reason")


SECTIONS: Final = {
    "Read": {
        "list": "List settings of tasks.",
        "get": "Show the settings of a task.",
        "describe": "Show what can be set: type, default, bounds, unit.",
    },
    "Change": {
        "set": "Change settings of a running task.",
    },
    "Files": {
        "dump": "Print settings as a file.",
        "load": "Change settings as a file says.",
    },
}


@click.group(cls=SectionedGroup, sections=SECTIONS)
def param() -> None:
    """Read and change the settings of tasks; a device is a task too, with the device's name."""


@param.command("list")
@click.argument("name", metavar="[AGENT[/TASK]]", required=False, type=AgentOrTask())
@asks_agents
def list_(name: TaskName | None, ask: Ask) -> None:
    """List the settings of all tasks, of all tasks of AGENT, or of one task.

    \b
    Example:
        pancakes param list
        pancakes param list agent1/ScanTarget --format json
    """
    with ask.client() as client:
        rows = [row for described in _described(client, name) for row in _rows(described)]
    ask.printer.emit(_picked(rows, COLUMNS), _table(rows, COLUMNS, ("value",)))


@param.command()
@a_task
@click.argument("setting", metavar="[NAME]", default="", type=ParamName())
@asks_agents
def get(name: TaskName, setting: str, ask: Ask) -> None:
    """Show the settings of a task; with NAME, only the value of that setting, as TOML.

    \b
    Example:
        pancakes param get agent1/ScanTarget
        pancakes param get agent1/ScanTarget radius_m
    """
    with ask.client() as client:
        (described,) = _described(client, name)
    known = _known(described, setting)
    rows = [row for row in _rows(described) if not known or row["param"] == known]
    ask.printer.emit(
        _picked(rows, COLUMNS), printable_data(_text(rows[0]["value"])) if known else _table(rows, COLUMNS, ("value",))
    )


@param.command("set")
@a_task
@click.argument("changes", metavar="NAME=VALUE...", nargs=-1, required=True, type=SettingChange())
@dry_run_option
@orders_agents
def set_(name: TaskName, changes: Changes, dry_run: bool, ask: Ask) -> None:
    """Change settings of a running task; if one value is refused, nothing changes.

    A value is read as TOML (5, true, [1, 2], { x = 1 }) if possible, otherwise as a string. For a key in a table, NAME
    has dots: slow.PoseSharing=0.5.

    \b
    Example:
        pancakes param set agent1/ScanTarget radius_m=0.8 speed_mps=0.05
        pancakes param set agent1/ScanTarget radius_m=-1 --dry-run
    """
    with ask.client() as client:
        (described,) = _described(client, name)
        before = described["settings"]
        wanted = param_file.changes_of(before, dict(changes))
        target = f"{described['service']}/{described['task']}"
        reply = request(client, name.agent, Configure(target, wanted, dry_run))
    rows = [
        {
            **_place(described),
            "param": key,
            "before": before.get(key),
            "value": value,
            "done": DRY_RUN if dry_run else "set",
            "number": reply.number,
        }
        for key, value in wanted.items()
    ]
    ask.printer.emit(_picked(rows, CHANGED), _table(rows, CHANGED, ("before", "value")))


@param.command()
@a_task
@click.argument("setting", metavar="[NAME]", default="", type=ParamName())
@asks_agents
def describe(name: TaskName, setting: str, ask: Ask) -> None:
    """Describe the settings of a task: type, default, bounds, unit and meaning.

    \b
    Example:
        pancakes param describe agent1/ScanTarget
        pancakes param describe agent1/ScanTarget radius_m --format json
    """
    from pancakes.tools.schema_rows import rows_of

    with ask.client() as client:
        (described,) = _described(client, name)
    known = _known(described, setting)
    rows = [
        {**_place(described), **row, "value": described["settings"].get(row["param"])}
        for row in rows_of(described["settings_schema"])
        if not setting or row["param"] == known or row["param"].startswith(f"{known}.")
    ]
    picked = _picked(rows, ("agent", "service", "task", *DESCRIBED, "required"))
    ask.printer.emit(picked, _table(rows, DESCRIBED, ("value", "default")))


@param.command()
@a_task_or_agent
@asks_agents
def dump(name: TaskName, ask: Ask) -> None:
    """Print the settings of a task, or of all tasks that the configuration of AGENT names, as TOML.

    `pancakes param load` reads the output, and you can paste it into the agent's configuration.

    \b
    Example:
        pancakes param dump agent1 > agent1-settings.toml
        pancakes param dump agent1/ScanTarget
    """
    with ask.client() as client:
        rows = [row for row in _described(client, name) if row["settings"] and (name.task or not row["own"])]
    plain = [{**_place(row), "settings": row["settings"]} for row in rows]
    ask.printer.emit(plain, printable_data(param_file.dumped(rows)))


@param.command()
@a_task_or_agent
@click.argument("file", metavar="FILE", type=click.Path(path_type=Path, allow_dash=True))
@dry_run_option
@orders_agents
def load(name: TaskName, file: Path, dry_run: bool, ask: Ask) -> None:
    """Change the settings of a running task, or of several tasks of AGENT, to those in FILE (- is standard input).

    FILE is the output of `pancakes param dump`, or a whole configuration, of which only the settings are read. If a
    task refuses one value, none of its settings change; the task is named, and the exit code is 1.

    \b
    Example:
        pancakes param load agent1 agent1-settings.toml --dry-run
        pancakes param load agent1/ScanTarget agent1-settings.toml
    """
    settings = param_file.read(file)
    if name.task:
        if name.task not in settings:
            raise ControlRefusedError(f"{file} has no settings of {name.task!r}. It has those of {', '.join(settings)}")
        settings = {name.task: settings[name.task]}
    rows = []
    with ask.client() as client:
        name = resolve_fleet(client, name)
        for task, values in settings.items():
            row = {"agent": name.agent, "service": name.service, "task": task, "params": list(values)}
            try:
                found = resolve_service(client, TaskName(name.agent, name.service, task))
                row["service"] = found.service
                request_result(client, name.agent, Configure(found.target, values, dry_run))
                rows.append({**row, "done": DRY_RUN if dry_run else "set", "reason": ""})
            except ControlRefusedError as error:
                rows.append({**row, "done": "refused", "reason": str(error)})
    for row in rows:
        if row["reason"]:
            show_text(f"{name.agent}/{row['task']}: {row['reason']}", err=True)
    ask.printer.table(rows, LOADED)
    sys.exit(REFUSED if any(row["reason"] for row in rows) else OK)


def _described(client: Client, name: TaskName | None) -> list[dict[str, Any]]:
    """Describe a task, all tasks of an agent, or the tasks of all agents; print the agents that do not answer."""
    if name is not None and name.task:
        name = resolve_service(client, name)
        return [request_result(client, name.agent, Describe(name.target))]
    described = []
    for agent in survey_with(client, name.agent if name is not None else ""):
        for task in agent["tasks"]:
            try:
                described.append(request_result(client, agent["agent"], Describe(f"{task['service']}/{task['task']}")))
            except ControlRefusedError as error:  # the task may have migrated meanwhile
                show_text(str(error), err=True)
    return described


def _known(described: dict[str, Any], setting: str) -> str:
    """Return the name of a setting if the task has it; an empty string stays empty.

    Raises:
        ControlRefusedError: the task has no setting of this name.
    """
    names = list(described["settings_schema"].get("properties", described["settings"]))
    if setting and setting not in names:
        hint = hint_of(setting, names)
        raise ControlRefusedError(f"{described['agent']}/{described['task']} has no setting {setting!r}{hint}")
    return setting


def _rows(described: dict[str, Any]) -> list[dict[str, Any]]:
    return [{**_place(described), "param": key, "value": value} for key, value in described["settings"].items()]


def _place(described: dict[str, Any]) -> dict[str, Any]:
    return {key: described[key] for key in ("agent", "service", "task")}


def _picked(rows: list[dict[str, Any]], columns: tuple[str, ...]) -> list[dict[str, Any]]:
    return [{column: row[column] for column in columns} for row in rows]


def _table(rows: list[dict[str, Any]], columns: tuple[str, ...], values: tuple[str, ...]) -> Rows:
    """Return a table with values in TOML, so that text and numbers look different."""
    return Rows([{**row, **{key: _text(row[key]) for key in values}} for row in rows], columns)


def _text(value: Any) -> str:
    from pancakes.config.toml_writer import value_text

    return "-" if value is None else value_text(value)
