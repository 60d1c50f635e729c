"""The JSON Schema of a configuration file, made from the types that read it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from pancakes.config.tables import (
    SCHEMA,
    AccessConfig,
    AgentConfig,
    ChannelConfig,
    ClockConfig,
    DeviceConfig,
    ServiceConfig,
    TaskConfig,
)
from pancakes.errors import PluginError
from pancakes.util.plugins import Plugins
from pancakes.util.schema import schema_of

DRAFT: Final = "https://json-schema.org/draft/2020-12/schema"
NAME: Final = r"^[A-Za-z0-9_][A-Za-z0-9._-]{0,63}$"
"""The pattern of names of agents and of tables such as `[task.NAME]`."""

_SINGLE: Final = {"agent": AgentConfig, "access": AccessConfig, "clock": ClockConfig}
_NAMED: Final = {"channel": ChannelConfig, "device": DeviceConfig, "service": ServiceConfig, "task": TaskConfig}
_PLUGINS: Final = {
    "device": ("driver", "pancakes.drivers"),
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
    for table, cls in _SINGLE.items():
        properties[table] = _table(cls, definitions)
    for table, named in _NAMED.items():
        entry = _table(named, definitions)
        del entry["properties"]["name"]
        if table == "service":
            entry["required"] = []  # the four default services have their name as their type
        entry["required"] = [key for key in entry.get("required", ()) if key != "name"]
        if plugins is not None and table in _PLUGINS:
            _name_plugins(entry, *_PLUGINS[table], plugins)
        properties[table] = named_tables(entry)
    return schema_document("The configuration of an agent", properties, ["schema", "agent"], definitions)


def schema_document(
    title: str, properties: Mapping[str, Any], required: Sequence[str], definitions: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the JSON Schema of a file, given the schemas of its tables."""
    return {
        "$schema": DRAFT,
        "title": title,
        "type": "object",
        "properties": {"schema": {"const": SCHEMA, "description": "the format of the file."}, **properties},
        "required": required,
        "additionalProperties": False,
        "$defs": definitions,
    }


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
