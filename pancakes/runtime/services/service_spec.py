"""A service as data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from pancakes.runtime.life.restart import RestartSpec
from pancakes.service import Service
from pancakes.task import TaskSpec


class ServiceSpec(msgspec.Struct, frozen=True):
    """All that the kernel's root needs to start a service, as data.

    Attributes:
        name: its name.
        cls: its class.
        settings: its settings, as plain values.
        tasks: its tasks, in the order in which they start.
        restart: what happens when it ends by itself.
        arguments: what else its class wants.
    """

    name: str
    cls: type[Service]
    settings: Mapping[str, Any]
    tasks: tuple[TaskSpec, ...]
    restart: RestartSpec
    arguments: Mapping[str, Any]
