"""The JSON Schema of a configuration file, made from the types that read it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from pancakes.config.tables import (
    SCHEMA,
    AccessConfig,
    AgentConfig,
    ChannelConfig,
    ClockConfig,
    DeviceConfig,
    FilterConfig,
    RecordConfig,
    ServiceConfig,
    TaskConfig,
)
from pancakes.config.variables import NAME as VARIABLE
from pancakes.errors import PluginError
from pancakes.util.plugins import Plugins
from pancakes.util.schema import schema_of

DRAFT: Final = "https://json-schema.org/draft/2020-12/schema"
NAME: Final = r"^[A-Za-z0-9_][A-Za-z0-9._-]{0,63}$"
"""The pattern of names of agents and of tables such as `[task.NAME]`."""

_SINGLE: Final = {"agent": AgentConfig, "access": AccessConfig, "clock": ClockConfig, "record": RecordConfig}
_NAMED: Final = {
    "channel": ChannelConfig,
    "device": DeviceConfig,
    "filter": FilterConfig,
    "service": ServiceConfig,
    "task": TaskConfig,
}
_PLUGINS: Final = {
    "device": ("driver", "pancakes.drivers"),
    "filter": ("type", "pancakes.filters"),
    "service": ("type", "pancakes.services"),
    "task": ("type", "pancakes.tasks"),
}


def config_schema(plugins: Plugins | None = None) -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of an agent's configuration file.

    Some rules are checked only when the file is read: whether a task's service exists, whether an address is valid.

    Args:
        plugins: with these, only their drivers, services and tasks are valid, and their settings are described; those
            that cannot be imported are left out.
    """
    definitions: dict[str, Any] = {}
    properties: dict[str, Any] = {}
    required: dict[str, Any] = {}  # in a file that extends none; otherwise the other file may have these keys
    for table, cls in _SINGLE.items():
        properties[table] = _table(cls, definitions)
        required[table] = {"required": properties[table].pop("required", [])}
    listen = properties["agent"]["properties"]["listen"]  # a single address need not be a list
    several = {key: listen.pop(key) for key in [*listen] if key not in ("description", "default")}
    listen["anyOf"] = [{"type": "string"}, several]
    for table, named in _NAMED.items():
        entry = _table(named, definitions)
        del entry["properties"]["name"]
        keys = [key for key in entry.pop("required", ()) if key != "name"]
        if table != "service":  # the four default services have their name as their type
            required[table] = {"additionalProperties": {"required": keys}}
        if plugins is not None and table in _PLUGINS:
            _name_plugins(entry, *_PLUGINS[table], plugins)
        properties[table] = named_tables(entry)
    return schema_document(
        "The configuration of an agent", properties, {"required": ["agent"], "properties": required}, definitions
    )


def schema_document(
    title: str, properties: Mapping[str, Any], otherwise: Mapping[str, Any], definitions: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the JSON Schema of a file.

    Args:
        title: what it is.
        properties: the schemas of its tables.
        otherwise: what else holds for a file that extends no other one.
        definitions: the schemas that those refer to.
    """
    head = {
        "schema": {"const": SCHEMA, "description": "the format of the file."},
        "extends": {
            "type": "string",
            "minLength": 1,
            "description": "a file with further tables and keys, relative to the folder of this one.",
        },
        "vars": {
            "type": "object",
            "propertyNames": {"pattern": f"^{VARIABLE}$"},
            "description": "the values of variables, which are written ${NAME}.",
        },
    }
    return {
        "$schema": DRAFT,
        "title": title,
        "type": "object",
        "properties": {**head, **properties},
        "required": ["schema"],
        "if": {"not": {"required": ["extends"]}},
        "then": otherwise,
        "additionalProperties": False,
        "$defs": definitions,
    }


def allowing_variables(schema: Mapping[str, Any]) -> dict[str, Any]:
    """Return the JSON Schema of a file in which a variable (`${NAME}`) may stand for each value in its tables."""
    tables = {name: _allowing(part) for name, part in schema["properties"].items()}
    return {**_allowing(schema), "properties": tables}


def _allowing(schema: Any) -> Any:
    if isinstance(schema, list):
        return [_allowing(part) for part in schema]
    if not isinstance(schema, Mapping):
        return schema
    found = {key: _allowing(part) for key, part in schema.items() if key not in ("if", "const", "default")}
    found |= {key: schema[key] for key in ("if", "const", "default") if key in schema}
    for key in ("items", "additionalProperties"):
        if isinstance(found.get(key), Mapping) and "properties" not in found[key]:
            found[key] = _or_variable(found[key])
    if isinstance(found.get("properties"), Mapping):
        found["properties"] = {
            name: _or_variable(part) if isinstance(part, Mapping) else part
            for name, part in found["properties"].items()
        }
    return found


def _or_variable(part: Mapping[str, Any]) -> Mapping[str, Any]:
    plain_text = part.get("type") == "string" and not {"enum", "pattern", "maxLength"} & set(part)
    if plain_text or not {"type", "enum", "anyOf", "$ref"} & set(part):
        return part
    notes = {key: part[key] for key in ("description", "default", "title") if key in part}
    rest = {key: value for key, value in part.items() if key not in notes}
    return {**notes, "anyOf": [rest, {"type": "string", "pattern": r"\$\{"}]}


def named_tables(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the schema of tables `[table.NAME]`, given that of one."""
    return {"type": "object", "propertyNames": {"pattern": NAME}, "additionalProperties": entry}


def closed(schema: Any) -> Any:
    """Return a schema whose objects allow only the keys that they name."""
    if isinstance(schema, list):
        return [closed(part) for part in schema]
    if not isinstance(schema, Mapping):
        return schema
    found = {key: closed(part) for key, part in schema.items()}
    if isinstance(schema.get("properties"), Mapping) and schema.get("type") == "object":
        found.setdefault("additionalProperties", False)
    return found


def _table(cls: type, definitions: dict[str, Any]) -> dict[str, Any]:
    schema: dict[str, Any] = closed(schema_of(cls))
    definitions.update(schema.pop("$defs", {}))
    return schema


def _name_plugins(entry: dict[str, Any], key: str, group: str, plugins: Plugins) -> None:
    """Require that an entry has an installed type, and settings that fit it."""
    names = plugins.names(group)
    entry["properties"][key] = {**entry["properties"][key], "enum": names}
    rules = []
    for name in names:
        try:
            settings = closed(schema_of(plugins.get(group, name).Settings))
        except (PluginError, TypeError, AttributeError):
            continue
        # It needs an `$id`, so that its references lead to its own `$defs`, not to those of other plug-ins.
        settings = {"$id": f"{group}/{name}", **settings}
        rule = {"if": {"properties": {key: {"const": name}}, "required": [key]}}
        rules.append({**rule, "then": {"properties": {"settings": settings}}})
    if rules:
        entry["allOf"] = rules
