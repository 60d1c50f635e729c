"""Agents as processes, on several sites: a router between them, and no port of theirs."""

from __future__ import annotations

import json
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
    # As a terminal elsewhere, which is behind the router alone.
    cli_rig.environment.update(PANCAKES_ZENOH=router.address, PANCAKES_RUNTIME_DIR=str(cli_rig.directory / "elsewhere"))
    with cli_rig.keys.offered():
        found = cli_rig.listed("agent", "list", "--at", "zenoh://a:1", "--fleet", "test")
    assert sorted(row["agent"] for row in found) == ["a", "b", "c"]
    third.process.kill()
    first.hear("its session with the routers has ended")


def test_a_task_crosses_a_gateway_from_a_robot_on_tcp_to_one_behind_routers(cli_rig: Rig, router: Router):
    gateway = started(cli_rig, router, "g", 'listen = ["tcp://127.0.0.1:0", "zenoh://g:1"]')
    at = next(it for it in cli_rig.addresses(gateway) if it.startswith("tcp://"))
    wheeled = started(cli_rig, router, "t", f'listen = "tcp://127.0.0.1:0"\npeers = ["{at}"]', COUNT)
    flying = started(cli_rig, router, "z", 'listen = "zenoh://z:1"\npeers = ["zenoh://g:1"]')
    gateway.hear("peer_up peer=t")
    flying.hear("peer_up peer=g")
    wheeled.hear("counted n=3")
    cli_rig.listed("task", "migrate", "t/Count", "--to", "g")
    gateway.hear("counted n=")
    cli_rig.listed("task", "migrate", "g/Count", "--to", "z")
    count = int(flying.hear("counted n=").rpartition("n=")[2])
    assert count > 3, "with its state"
    assert where(cli_rig) == ["z"]
    doctor = cli_rig.pancakes("doctor")
    assert "1 link through routers" in doctor.stdout, doctor.stdout + doctor.stderr
    for agent, foreign in (("t", "zenoh://z"), ("z", "tcp://")):
        told = cli_rig.pancakes("agent", "info", agent, "--format", "json")
        (found,) = json.loads(told.stdout)
        assert found["neighbours"] == ["g"], told.stderr
        mesh = found["mesh"]
        known = [it["address"] for it in mesh["addresses"]] + [at for it in mesh["peers"] for at in it["addresses"]]
        assert not [it for it in known if it.startswith(foreign)], "none is told of what it cannot dial"
