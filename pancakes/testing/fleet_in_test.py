"""Agents in virtual time in a test."""

from __future__ import annotations

from typing import Any, ClassVar

from pancakes.simulation.built_fleet import BuiltFleet
from pancakes.testing.agent_in_test import AgentInTest


class FleetInTest(BuiltFleet[AgentInTest]):
    """Agents in virtual time in a test: what does not come in time fails it."""

    handle: ClassVar[type[Any]] = AgentInTest
