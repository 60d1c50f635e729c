"""Broken variants of the rules for a task that another agent owns too; see `model.hosting_mutants`."""

from __future__ import annotations

from typing import Final

from model.hosting_mutant import HostingMutant

DISPUTES: Final = (
    HostingMutant(
        "a disputed task is given leave",
        "    elif (disputed := disputed_in(step.standing)) is not None:",
        "    elif (disputed := None) is not None:",
    ),
    HostingMutant(
        "a task that waits for leave is stopped, where another owns it",
        "        step.refuse(effect.reason)",
        "        pass",
    ),
    HostingMutant(
        "what a refused task carried is not written down, where another owns it",
        "        if life.state is State.REFUSED:",
        "        if False:",
    ),
    HostingMutant(
        "a task that another owns is refused twice",
        "        if not any(isinstance(event, lifecycle.LeaveRefused) for event, _ in self._lives):\n",
        "        if True:\n",
    ),
    HostingMutant(
        "the adoption of a disputed task that cannot be written down is not answered",
        "    adopted = owner and waits.record.epoch != standing.record.epoch",
        "    adopted = False",
    ),
    HostingMutant(
        "that a disputed task cannot be given up is not answered",
        " or (owner and waits.record.phase is Phase.RELEASED):",
        ":",
    ),
    HostingMutant(
        "an adoption is not answered where a stop comes after it",
        "        if life is None or life.at_rest:",
        "        if False:",
    ),
)
