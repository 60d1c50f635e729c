"""What tests of links through routers need."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from net.conftest import Agent, Ear
from zenoh_links.routers import Router, ZenohRig


@pytest.fixture(scope="session")
def shared_router() -> Iterator[Router]:
    """A router that runs, and that no test ends."""
    made = Router()
    made.start()
    yield made
    made.end()


@pytest.fixture
def router() -> Iterator[Router]:
    """A router of the test's own, which runs."""
    made = Router()
    made.start()
    yield made
    made.end()


@pytest.fixture(params=["open", "keyed"])
def rig(request: pytest.FixtureRequest, shared_router: Router, tmp_path: Path) -> Iterator[ZenohRig]:
    made = ZenohRig(tmp_path, shared_router, keyed=request.param == "keyed")
    yield made
    made.close()


@pytest.fixture
def tcp_rig(rig: ZenohRig) -> ZenohRig:
    """The contract's name for real bytes on their way, which here go through a router."""
    return rig


@pytest.fixture
def ear(rig: ZenohRig) -> Callable[[], Ear]:
    return rig.ear


@pytest.fixture
def agent(rig: ZenohRig) -> Callable[..., Agent]:
    return rig.agent
