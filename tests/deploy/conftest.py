"""Fixtures for the tests of deployments."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from cli.processes import Rig
from deploy.plugin_wheels import clone_wheel
from deploy.ssh_hosts import SshHosts


@pytest.fixture(scope="session")
def core(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this clone."""
    return clone_wheel(tmp_path_factory.mktemp("wheels"))


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of downloaded libraries."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    try:
        yield rig
    finally:
        rig.close()


@pytest.fixture
def hosts(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> Iterator[SshHosts]:
    """Real SSH servers (`add` adds one), and the ssh that reaches them."""
    made = SshHosts()
    rig.environment["PANCAKES_SSH"] = made.ssh
    monkeypatch.setenv("PANCAKES_SSH", made.ssh)
    yield made
    made.close()
