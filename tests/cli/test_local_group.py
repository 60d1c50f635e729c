"""An agent that lets a group of its machine in, as a service of the system does."""

from __future__ import annotations

import grp
import os
import stat

import pytest
from cli.processes import Rig


@pytest.fixture
def group() -> str:
    """A group of whoever runs the tests."""
    return grp.getgrgid(os.getgid()).gr_name


def test_a_group_finds_the_agent_and_its_socket(rig: Rig, group: str):
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


def test_a_group_that_is_not_there_ends_the_agent_with_a_sentence(rig: Rig):
    agent = rig.agent(rig.config("a", agent='local_group = "pancakers"'))
    agent.hear(
        "cannot listen at local://test/a: there is no group 'pancakers' on this machine,"
        " which [agent] local_group names"
    )
    assert agent.process.wait(10.0) == 1
