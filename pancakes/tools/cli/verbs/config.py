"""`pancakes config ...`: check and show configuration files."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import click

from pancakes.control import Describe
from pancakes.errors import ConfigError, ControlRefusedError, Fault, NoAnswerError, UnreachableError
from pancakes.tools.cli.agent_requests import request_result
from pancakes.tools.cli.exit_codes import BAD_CONFIGURATION, OK
from pancakes.tools.cli.help_sections import SectionedGroup
from pancakes.tools.cli.options import AGENT_NAME, Ask, asks_agents, format_option, format_option_of
from pancakes.tools.cli.output import Part, Printer, Rows, show_text
from pancakes.util.text import printable_data

SCHEMA_COLUMNS = ("table", "key", "type", "default", "bounds", "description")


Origin = Callable[[tuple[str, ...]], str]
"""Returns where the value of a key comes from."""


class FileOrAgent(click.ParamType):
    """A file, or the name of an agent if the text has no suffix and no such file exists.

    A folder may have the name of an agent, such as the folder of its distribution.
    """

    name = "FILE|AGENT"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path | str:
        path = Path(value)
        if isinstance(value, Path) or path.suffix or (path.exists() and not path.is_dir()):
            return path
        name: str = AGENT_NAME.convert(value, param, ctx)
        return name


SECTIONS: Final = {
    "Commands": {
        "check": "Check configuration files before a robot reads them.",
        "show": "Show what configuration an agent runs with.",
        "schema": "Print the JSON Schema of a configuration, for editors.",
    },
}


@click.group(cls=SectionedGroup, sections=SECTIONS)
def config() -> None:
    """Check and show configuration files."""


@config.command()
@click.argument("paths", metavar="FILE|DIR...", nargs=-1, required=True, type=click.Path(path_type=Path))
@format_option
def check(paths: tuple[Path, ...], printer: Printer) -> None:
    """Check configuration files of agents, fleet files, and folders that `pancakes up` accepts.

    Each fault is printed with file, line and key; the exit code is then 4. A plug-in that a file names and that cannot
    be imported is a fault, although an agent would run without it. What would keep an agent from starting on this
    machine, such as missing keys, is a warning, because the file may be for another machine. For an agent that has a
    host in a fleet file, the keys of plug-ins that are not installed here are not checked, and the output names them.

    \b
    Example:
        pancakes config check configs/encirclement robot.toml
        pancakes config check robot.toml --format json
    """
    from pancakes.tools.cli.start_checks import machine_doubts
    from pancakes.tools.launch.fleet_file import make_fleet, unlinked
    from pancakes.util.plugins import Plugins

    plugins = Plugins()
    rows: list[dict[str, Any]] = []
    for path in paths:
        try:
            members = make_fleet([path], (), None, plugins, must_load=True, check_hosts=True)
            alone = unlinked(members)
            for member in members:
                fleet = member.config.agent.fleet
                # Paths and host names may mean something else on another machine.
                doubts = [] if member.host else [it._asdict() for it in machine_doubts(member.config, plugins)]
                if member.name in alone:
                    text = "no other agent of this fleet is named here, and none names this one: it will not be linked"
                    doubts.append(Fault(str(member.path), "[agent] peers", text)._asdict())
                row: dict[str, Any] = {"file": str(member.path), "agent": member.name, "fleet": fleet}
                rows.append({**row, "faults": [], "warnings": doubts, "unchecked": list(member.unchecked)})
        except ConfigError as error:
            faults = [fault._asdict() for fault in error.faults]
            rows.append(
                {"file": str(path), "agent": None, "fleet": None, "faults": faults, "warnings": [], "unchecked": []}
            )
            if not printer.is_json:
                show_text(str(error), err=True)
    reported = {fault["problem"] for row in rows for fault in row["faults"]}
    for problem in plugins.problems():
        if str(problem) not in reported:
            show_text(f"warning: {problem}", err=True)
    printer.emit(rows, *map(_checked, rows))
    sys.exit(BAD_CONFIGURATION if any(row["faults"] for row in rows) else OK)


def _checked(row: Mapping[str, Any]) -> Iterator[Part]:
    for doubt in row["warnings"]:
        show_text(f"warning: {Fault(**doubt)}", err=True)
    if not row["faults"]:
        unchecked = ", ".join(row["unchecked"])
        but = f", except {unchecked} (not installed here, so not checked)" if unchecked else ""
        yield f"{row['file']} is sound{but}: the agent {row['agent']} of the fleet {row['fleet']}"


@config.command("show")
@click.argument("file", metavar="FILE|AGENT", type=FileOrAgent())
@click.option("--set", "sets", metavar="KEY=VALUE", multiple=True, help="Override a key of the file with VALUE.")
@asks_agents
def show_(file: Path | str, sets: tuple[str, ...], ask: Ask) -> None:
    """Show the effective configuration of an agent: with all defaults, and where each value comes from.

    For a running AGENT it is the configuration that the agent has read, plus the tasks that were created on it, with
    their present settings, ready to be saved in a file.

    The output is a valid configuration. JSON is a list of keys.

    \b
    Example:
        pancakes config show configs/single.toml
        pancakes config show configs/single.toml --set clock.speed=5 --format json
        pancakes config show agent1
    """
    if isinstance(file, str):
        if sets:
            raise click.UsageError("--set overrides keys of a file, and no file of that name exists")
        _show(*_of_agent(file, ask), ask.printer)
    else:
        _show(*_of_file(file, sets), ask.printer)


def _of_file(file: Path, sets: tuple[str, ...]) -> tuple[dict[str, Any], Origin]:
    from pancakes.config import load
    from pancakes.config.effective import effective, origin
    from pancakes.util.plugins import Plugins

    plugins = Plugins()
    found = load(file, sets, plugins)
    for problem in plugins.problems():
        show_text(f"warning: {problem}", err=True)
    return effective(found, plugins), lambda keys: origin(found, keys)


def _of_agent(agent: str, ask: Ask) -> tuple[dict[str, Any], Origin]:
    from pancakes.config.effective import DEFAULT
    from pancakes.config.toml_writer import key_text

    with ask.client() as client:
        try:
            found = request_result(client, agent, Describe(config=True))
        except NoAnswerError:
            raise
        except UnreachableError as error:
            no_file = f"{agent!r} is a folder" if Path(agent).is_dir() else f"the file {agent!r} does not exist either"
            raise UnreachableError(f"{error}\n{no_file}") from None
        except ControlRefusedError as error:
            raise ControlRefusedError(
                f"{error}; pancakes task info {agent}/TASK shows the settings of one task"
            ) from None

    def origin(keys: tuple[str, ...]) -> str:
        of_task = keys[0] == "task" and len(keys) > 1 and keys[1] in found["created"]
        return f"created on {agent}" if of_task else str(found["said"].get(key_text(keys), DEFAULT))

    return found["config"], origin


def _show(tables: dict[str, Any], origin: Origin, printer: Printer) -> None:
    from pancakes.config.toml_writer import document_text, key_text, leaves

    tables = {table: value for table, value in tables.items() if value != {}}
    rows = [
        {"key": key_text(keys), "value": value, "from": origin(keys)}
        for keys, value in leaves(tables)
        if value is not None
    ]
    printer.emit(rows, printable_data(document_text(tables, origin)))


@config.command()
@click.option("--fleet", is_flag=True, help="Print the schema of a fleet file of `pancakes up` instead.")
@click.option("--plugins", "with_plugins", is_flag=True, help="Include the settings of all installed plug-ins.")
@format_option_of("json", "A JSON Schema, or a table of all keys.")
def schema(fleet: bool, with_plugins: bool, printer: Printer) -> None:
    """Print the JSON Schema of an agent's configuration, for editors that validate and complete.

    \b
    Example:
        pancakes config schema --plugins > agent.schema.json
        pancakes config schema --format table
    """
    from pancakes.config.schema import allowing_variables, config_schema
    from pancakes.util.plugins import Plugins

    if fleet and with_plugins:
        raise click.UsageError("--fleet and --plugins exclude each other: a fleet file has no plug-in settings")
    if fleet:
        from pancakes.tools.launch.fleet_file import fleet_schema

        found = fleet_schema()
    else:
        found = config_schema(Plugins() if with_plugins else None)
    printer.emit(allowing_variables(found), Rows(list(_schema_rows(found)), SCHEMA_COLUMNS))


def _schema_rows(schema: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield a row for each key, with its table."""
    from pancakes.config.toml_writer import value_text
    from pancakes.tools.schema_rows import rows_of

    for table, part in schema["properties"].items():
        inner = part.get("additionalProperties")
        named = isinstance(inner, Mapping)
        if named or "properties" in part:
            needed = schema["then"]["properties"].get(table, {})
            entry = {**inner, **needed.get("additionalProperties", {})} if named else {**part, **needed}
            for row in rows_of(entry, definitions=schema["$defs"]):
                default = "-" if row["default"] is None else value_text(row["default"])
                default = "required" if row["required"] else default
                yield {
                    **row,
                    "table": f"[{table}.NAME]" if named else f"[{table}]",
                    "key": row["param"],
                    "default": default,
                }
        else:
            yield {
                "table": "",
                "key": table,
                "type": value_text(part["const"]) if "const" in part else {"string": "text"}.get(part["type"], "table"),
                "default": "required" if table in schema["required"] else "-",
                "bounds": "",
                "description": part["description"],
            }
