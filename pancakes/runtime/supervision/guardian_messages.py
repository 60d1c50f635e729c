"""What an agent's root and its guardian tell each other: data."""

from __future__ import annotations

from typing import Any, Final

import msgspec

from pancakes.control import Checkpoints, Guarding, Take
from pancakes.runtime.kernel.reference import Reference
from pancakes.runtime.life.request import Request

GUARDIAN: Final = "kernel/Guardian"
"""Where on each agent the guardian is."""


class AskedOfGuardian(msgspec.Struct, frozen=True):
    """The root hands on a request; to be answered by `GuardianAnswers`.

    Attributes:
        body: what is asked.
        request: the request.
        root: the root.
    """

    body: Guarding | Checkpoints | Take
    request: Request
    root: Reference

    @property
    def dry_run(self) -> bool:
        """Whether nothing is to be done."""
        return isinstance(self.body, Take) and self.body.dry_run


class GuardianAnswers(msgspec.Struct, frozen=True):
    """The guardian has done what was asked of it.

    Attributes:
        request: the request.
        reason: why it was not done; empty: it was.
        result: the answer, as plain values.
    """

    request: Request
    reason: str = ""
    result: Any = None
