"""Agents in virtual time in a test."""

from __future__ import annotations

from typing import Any, ClassVar

from pancakes.simulation.built_fleet import BuiltFleet
from pancakes.testing.agent_in_test import AgentInTest, assert_sound


class FleetInTest(BuiltFleet[AgentInTest]):
    """Agents in virtual time in a test: what does not come in time fails it, and so does an agent that is unsound.

    See `AgentInTest.may_fail`. The end of its `with` looks at that, unless the test has failed already.
    """

    handle: ClassVar[type[Any]] = AgentInTest

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        if error[0] is None:
            assert_sound(self.started)
