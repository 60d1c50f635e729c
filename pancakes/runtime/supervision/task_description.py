"""What is to be known about a task, as plain values."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Final

import msgspec

from pancakes.runtime.foundation.schema import schema_of
from pancakes.runtime.kernel.kernel import Kernel
from pancakes.runtime.kernel.task_table import TaskEntry
from pancakes.runtime.life.life import State
from pancakes.runtime.supervision.slot import Slot
from pancakes.runtime.supervision.task_messages import Carried
from pancakes.settings import SettingsError, make_settings, plain_settings

STANDS_STILL: Final = "stands still"
"""How a guarded task rests that has no permit, and that goes on once it has one."""

SILENT: Final = "silent"
"""How a device is that runs, and has had no reading for too long."""


def describe_task(kernel: Kernel, entry: TaskEntry) -> dict[str, Any]:
    """Returns what is to be known about each task. Any thread.

    Args:
        kernel: the kernel that it runs on.
        entry: what its service has entered of it.
    """
    life = entry.life
    timers = kernel.task_timers.of(entry.address)
    first = timers[0] if timers else None
    told: dict[str, Any] = {
        "agent": kernel.agent,
        "service": entry.service,
        "task": entry.name,
        "type": entry.type,
        "state": life.word,
        # It is wanted, and starts by itself once it can: what it lacks is in `reason`.
        "waits": life.state is State.REFUSED,
        "rest": entry.rest,
        "rate_hz": first.rate_hz if first is not None else None,
        "incarnation": life.incarnation,
        "reason": life.reason,
        **life.restarts.describe(kernel.host.now()),
        "ticks": first.ticks if first is not None else 0,
        "lateness_sum_s": first.lateness_sum_s if first is not None else 0.0,
        "missed": sum(timer.missed_total for timer in timers),
        "lateness_max_s": max((timer.lateness_max_s for timer in timers), default=0.0),
        "dropped": entry.mailbox.dropped(),
    }
    note = kernel.guard_notes.of(entry.address)
    if note is not None:
        told["guarding"] = note.plain(kernel.host.now(), kernel.permits.left_s(note.right))
        if not told["guarding"]["permit_s"] and (life.state is State.RUNNING or told["guarding"]["copied"]):
            told["rest"] = STANDS_STILL
    if not entry.device:
        return told
    holder = kernel.registry.holder(entry.name)
    if (readings := kernel.registry.readings(entry.name)) is not None:
        told["readings"] = readings.describe(kernel.mission.now())
        if told["readings"]["silent_s"] is not None and life.state is State.RUNNING:
            told["rest"] = SILENT
    return {**told, "device": entry.device, **({"holder": holder} if holder else {})}


def describe_in_detail(kernel: Kernel, slot: Slot, settings_class: type, carried: Carried) -> dict[str, Any]:
    """Returns what else is to be known about one task, its settings among it.

    Args:
        kernel: the kernel that it runs on.
        slot: its place.
        settings_class: the dataclass of its settings.
        carried: what it would begin with where it does not run.
    """
    spec = slot.spec
    return {
        # No configuration names it: it comes with its service, whose settings are where its own come from.
        "own": not spec.type,
        # No configuration names it either: it was asked for by `Create`.
        "created": spec.created,
        "requires": list(spec.cls.requires),
        "timers": [timer.describe() for timer in kernel.task_timers.of(slot.address)],
        "reads": kernel.stream.readings(slot.address),
        "settings": settings_of(kernel, slot, settings_class, carried),
        "settings_schema": _schema_of_settings(settings_class),
        "durability": spec.durability,
        "guard": msgspec.structs.asdict(spec.guard) if spec.guard is not None else None,
        "restart": msgspec.structs.asdict(spec.restart),
        "failure": msgspec.to_builtins(slot.failure),
        "fence": {"task_id": slot.fence.task_id, "epoch": slot.fence.epoch[0]} if slot.fence is not None else None,
    }


def settings_of(kernel: Kernel, slot: Slot, settings_class: type, carried: Carried) -> dict[str, Any]:
    """Returns the settings of a task, or those that it would begin with; arguments as in `describe_in_detail`."""
    try:
        note = kernel.tasks.settings_of(slot.address) if slot.task is not None else None
        settings = note.settings if note is not None else make_settings(settings_class, carried.settings)
    except SettingsError:  # it cannot start with them, and the person who asks wants to see why
        return dict(carried.settings)
    try:
        return plain_settings(settings)
    except TypeError as error:  # what its author put there may be anything
        return {"error": f"the settings of {slot.address} cannot be told: {error}"}


def _schema_of_settings(cls: type) -> dict[str, Any]:
    """Returns the JSON Schema of a task's settings; empty where they have a type that cannot be checked."""
    try:
        return _schema_of(cls)
    except TypeError:
        return {}


@lru_cache(maxsize=256)
def _schema_of(cls: type) -> dict[str, Any]:
    """As `schema_of`, which takes milliseconds, once for each class: pages ask again and again. Not to be changed."""
    return schema_of(cls)
