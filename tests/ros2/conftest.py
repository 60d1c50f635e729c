"""What the tests with a real ROS 2 have in common."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import pytest
from ros2.environments import MAKING_S
from ros2.ros_rig import RosAgent, RosPeer

_DOMAINS = count()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The test that is the first on a new machine makes the environments: any of them may be it."""
    for item in items:
        if item.path.parent == Path(__file__).parent and item.get_closest_marker("timeout") is None:
            item.add_marker(pytest.mark.timeout(2 * MAKING_S))


@pytest.fixture(scope="session")
def domains() -> Callable[[], int]:
    """Gives out DDS domains of which no other test of this machine should know: 1 to 101 are safe on Linux."""
    worker = int("".join(filter(str.isdigit, os.environ.get("PYTEST_XDIST_WORKER", "gw0"))) or 0)
    first = os.getpid() % 40
    return lambda: 1 + (first + 37 * worker + next(_DOMAINS)) % 100


@pytest.fixture
def domain(domains: Callable[[], int]) -> int:
    """A DDS domain for one test."""
    return domains()


@pytest.fixture
def peer(domain: int) -> Iterator[RosPeer]:
    """A node of the other release."""
    made = RosPeer(domain)
    yield made
    made.close()


@pytest.fixture
def start_agent(domain: int, tmp_path: Path) -> Iterator[Callable[[str, str], RosAgent]]:
    """Starts an agent with a configuration, besides its name; it ends with the test."""
    agents: list[RosAgent] = []

    def start(name: str, text: str) -> RosAgent:
        agents.append(RosAgent(tmp_path / name, domain, name, text))
        return agents[-1]

    yield start
    for agent in agents:
        agent.stop()
