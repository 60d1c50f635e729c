"""A task as data: what is written down of it and sent with it, and what becomes of that where it begins again."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

import msgspec
from msgspec.structs import asdict

from pancakes.errors import MigrationError
from pancakes.mesh.migration.guard_rule import GuardRule
from pancakes.mesh.migration.record import TaskId
from pancakes.mesh.migration.rule import MigrationRule
from pancakes.mesh.migration.snapshot import Posted, Snapshot
from pancakes.runtime.foundation import codecs
from pancakes.runtime.foundation.arrays import alike
from pancakes.runtime.installed import Installed
from pancakes.runtime.life.restart import RestartSpec
from pancakes.runtime.supervision.task_messages import Carried
from pancakes.settings import plain_value
from pancakes.task import TaskSpec


def snapshot_of(
    spec: TaskSpec,
    task_id: TaskId,
    service: str,
    carried: Carried | None,
    posted: Posted | None = None,
) -> Snapshot:
    """Returns a task as data.

    Args:
        spec: how it is started.
        task_id: its identity for life.
        service: the service that looks after it.
        carried: what it carries; None: it has not begun yet.
        posted: what it has sent to other tasks and is not acknowledged; only of one that moves.
    """
    carried = carried or Carried(spec.settings, {})
    return Snapshot(
        task_id=task_id,
        type=spec.type,
        version=spec.version,
        service=service,
        requires=spec.cls.requires,
        settings=_set_of(spec, carried.settings),
        configured=dict(spec.settings),
        state=dict(carried.state),
        periods_s=dict(carried.periods_s),
        posted=posted,
        heard=dict(carried.heard),
        restart=asdict(spec.restart),
        durability=spec.durability,
        migrate=asdict(spec.rule) if spec.rule is not None else None,
        guard=asdict(spec.guard) if spec.guard is not None else None,
        rate_hz=spec.rate_hz,
        created=spec.created,
        offers=spec.cls.offers,
    )


def _set_of(spec: TaskSpec, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the settings that were set, by its configuration or since: a new version may have other defaults."""
    defaults = _defaults_of(spec.cls.Settings)
    return {
        name: value
        for name, value in settings.items()
        if name in spec.settings or name not in defaults or not alike(value, defaults[name])
    }


@cache
def _defaults_of(cls: type) -> dict[str, Any]:
    """Returns the defaults of the fields of a class of settings, as plain values."""
    info = codecs.type_info(cls)
    if not isinstance(info, msgspec.inspect.DataclassType | msgspec.inspect.StructType):
        return {}
    defaults: dict[str, Any] = {}
    for field in info.fields:
        if field.default is not msgspec.NODEFAULT:
            defaults[field.name] = plain_value(field.default)
        elif field.default_factory is not msgspec.NODEFAULT:
            defaults[field.name] = plain_value(field.default_factory())
    return defaults


def spec_of(snapshot: Snapshot, catalogue: Installed) -> TaskSpec:
    """Returns how to start a task of which nothing is known here but its snapshot.

    Raises:
        PancakesError: its class is not installed here.
        msgspec.ValidationError: its rules of restart or migration are none.
    """
    cls, version = catalogue.find(snapshot.type)
    return TaskSpec(
        name=snapshot.task_id.name,
        cls=cls,
        type=snapshot.type,
        version=version,
        settings=snapshot.configured,
        start=False,
        restart=codecs.convert(snapshot.restart, RestartSpec) if snapshot.restart else RestartSpec(),
        durability=snapshot.durability,
        rule=codecs.convert(snapshot.migrate, MigrationRule) if snapshot.migrate is not None else None,
        guard=codecs.convert(snapshot.guard, GuardRule) if snapshot.guard is not None else None,
        rate_hz=snapshot.rate_hz,
        created=snapshot.created,
    )


class Rules(NamedTuple):
    """How a task moves and is guarded.

    Attributes:
        move: when it moves by itself; None: it does not.
        guard: how it is guarded; None: it is not.
    """

    move: MigrationRule | None
    guard: GuardRule | None


def rules_of(encoded: bytes, task_id: TaskId) -> tuple[Snapshot, Rules]:
    """Reads a snapshot that another agent has kept, and what it says of its task.

    Raises:
        MigrationError: it cannot be read, or is of another task.
    """
    snapshot = Snapshot.decode(encoded)
    if snapshot.task_id != task_id:
        raise MigrationError(f"the snapshot is of {snapshot.task_id}, not of {task_id}")
    try:
        move = codecs.convert(snapshot.migrate, MigrationRule) if snapshot.migrate is not None else None
        guard = codecs.convert(snapshot.guard, GuardRule) if snapshot.guard is not None else None
        if snapshot.restart:
            codecs.convert(snapshot.restart, RestartSpec)
    except msgspec.ValidationError as error:
        raise MigrationError(f"the snapshot of {task_id} is malformed: {error}") from None
    return snapshot, Rules(move, guard)


def carried_of(snapshot: Snapshot) -> Carried:
    """Returns what a task that begins from a snapshot carries."""
    return Carried(snapshot.settings, snapshot.state, snapshot.periods_s, snapshot.heard)


def settings_now(snapshot: Snapshot, configured: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Returns a task's own settings with what its configuration has changed since, and the names of that."""
    settings, before = dict(snapshot.settings), snapshot.configured
    changed = [key for key in configured if key not in before or not alike(before[key], configured[key])]
    settings.update((key, configured[key]) for key in changed)
    removed = [key for key in before if key not in configured]
    for key in removed:
        settings.pop(key, None)
    return settings, [*changed, *removed]
