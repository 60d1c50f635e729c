"""What a service and one of its tasks' actors tell each other, so that a change is made in the task's own turn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec

from pancakes.control import Configure, Describe, Reschedule
from pancakes.kernel.component import Component
from pancakes.request import Request


class Change(msgspec.Struct, frozen=True):
    """A task is to change, or to say how it stands.

    Attributes:
        request: the request that asks for it.
        body: what is to be done.
        carry: whether the answer is to say what the task carries after that.
    """

    request: Request
    body: Reschedule | Configure | Describe
    carry: bool = False


class Changed(msgspec.Struct, frozen=True):
    """A task has done so, or refuses.

    Attributes:
        task: the task's actor.
        change: what it was told.
        reason: why it refuses; empty: it is done.
        result: what is to be told of it, as plain values.
        carried: what the task carries after that, a `pancakes.task.Carried`; None: it was not asked, or cannot say.
    """

    task: Component
    change: Change
    reason: str
    result: Mapping[str, Any]
    carried: Any = None
