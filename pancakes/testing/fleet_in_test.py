"""Agents in virtual time in a test."""

from __future__ import annotations

from typing import Any, ClassVar

from pancakes.simulation.built_fleet import BuiltFleet
from pancakes.testing.agent_in_test import AgentInTest, assert_none_failed


class FleetInTest(BuiltFleet[AgentInTest]):
    """Agents in virtual time in a test: what does not come in time fails it.

    So does an actor of Pancakes' own that fails (see `AgentInTest.may_fail`): the end of the `with` raises an
    `AssertionError` then, unless it ends with another exception.
    """

    handle: ClassVar[type[Any]] = AgentInTest

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        if error[0] is None:
            assert_none_failed(self.started)
