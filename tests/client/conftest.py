"""What the tests of clients have in common."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from client.counting_agents import CountingAgents


@pytest.fixture(scope="module")
def counting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[CountingAgents]:
    """Agents that all tests of a module use, so that each leaves them as they were."""
    with pytest.MonkeyPatch.context() as patch:
        agents = CountingAgents(tmp_path_factory.mktemp("counting"))
        patch.setenv("PANCAKES_RUNTIME_DIR", str(agents.rig.runtime))
        for name, value in agents.rig.keys.environment.items():
            patch.setenv(name, value)
        try:
            yield agents
        finally:
            agents.rig.close()
