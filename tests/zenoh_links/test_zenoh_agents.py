"""Agents as processes, on several sites: a router between them, and no port of theirs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cli.processes import READY, Rig, Running
from cli.test_migration_verbs import COUNT, ENTRY_POINTS, SOURCE
from zenoh_links.routers import Router

PEERS = 'listen = "zenoh://{name}:1"\npeers = ["zenoh://a:1"]\n'


@pytest.fixture
def cli_rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    rig.install("count", ENTRY_POINTS, SOURCE)
    yield rig
    rig.close()


def started(rig: Rig, router: Router, name: str, addresses: str, rest: str = "") -> Running:
    """Starts an agent with keys, whose configuration says at which addresses it is, and dials others."""
    rig.keys.of_agent("test", name)
    network = f'[service.network]\nsettings.transports.zenoh.routers = ["{router.address}"]\n'
    path = rig.directory / f"{name}.toml"
    path.write_text(f'schema = 1\n[agent]\nname = "{name}"\nfleet = "test"\n{addresses}\n{network}{rest}\n')
    running = rig.agent(path)
    running.hear(READY)
    rig.entry(running.pid)
    return running


def where(rig: Rig, task: str = "Count") -> list[str]:
    return [row["agent"] for row in rig.listed("task", "list") if row["task"] == task and row["state"] == "running"]


def test_a_task_is_handed_over_through_a_router(cli_rig: Rig, router: Router):
    first = started(cli_rig, router, "a", 'listen = "zenoh://a:1"', COUNT)
    second = started(cli_rig, router, "b", PEERS.format(name="b"))
    third = started(cli_rig, router, "c", PEERS.format(name="c"))
    first.hear("peer_up peer=b")
    third.hear("peer_up peer=b")  # by gossip
    first.hear("counted n=3")
    moved: list[dict[str, Any]] = cli_rig.listed("task", "migrate", "a/Count", "--to", "b")
    assert moved
    second.hear("counted n=")
    assert where(cli_rig) == ["b"]
    cli_rig.listed("task", "migrate", "b/Count", "--to", "c")
    third.hear("counted n=")
    assert where(cli_rig) == ["c"]
    third.process.kill()
    first.hear("its session with the routers has ended")
