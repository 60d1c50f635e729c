"""What the tests of deployments have in common."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from cli.processes import Rig
from deploy.ssh_hosts import SshHosts


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    try:
        yield rig
    finally:
        rig.close()


@pytest.fixture
def hosts(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> Iterator[SshHosts]:
    """Real SSH servers, to which `add` adds one, and the ssh that reaches them."""
    made = SshHosts()
    rig.environment["PANCAKES_SSH"] = made.ssh
    monkeypatch.setenv("PANCAKES_SSH", made.ssh)
    yield made
    made.close()
