"""Agents at `local://`: who may connect, and what happens if the socket cannot be made."""

from __future__ import annotations

import grp
import os
import stat

import pytest
from cli.processes import Rig


@pytest.fixture
def group() -> str:
    """Return a group of the user who runs the tests."""
    return grp.getgrgid(os.getgid()).gr_name


def test_local_address_is_open_to_a_group(rig: Rig, group: str):
    agent = rig.ready("a", agent=f'local_group = "{group}"')

    modes = {
        str(path.relative_to(rig.runtime)): stat.S_IMODE(path.stat().st_mode)
        for path in [rig.runtime, *rig.runtime.rglob("*")]
    }
    assert modes == {
        ".": 0o750,
        f"a.{agent.pid}.json": 0o640,
        "local": 0o750,
        "local/test": 0o750,
        "local/test/a.sock": 0o660,
    }
    assert [row["agent"] for row in rig.listed("agent", "list")] == ["a"]
    assert [row["agent"] for row in rig.listed("agent", "list", "--at", "local://test/a", "--fleet", "test")] == ["a"]
    assert [row["agent"] for row in rig.listed("agent", "list", "--at", "local://a", "--fleet", "test")] == ["a"]


def test_local_address_in_an_open_directory_is_refused(rig: Rig):
    rig.runtime.mkdir(mode=0o777)
    rig.runtime.chmod(0o777)
    agent = rig.agent(rig.config("a"))
    agent.hear("a/kernel: ready")
    agent.hear("a cannot be reached at local://test/a: the runtime directory")


def test_local_address_for_an_unknown_group_ends_the_agent(rig: Rig):
    agent = rig.agent(rig.config("a", agent='local_group = "pancakers"'))
    agent.hear(
        "cannot listen at local://test/a: the group 'pancakers' of [agent] local_group does not exist on this machine"
    )
    assert agent.process.wait(10.0) == 1
