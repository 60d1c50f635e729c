"""State directories that earlier versions have left: agents of this version go on from them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from kept.conftest import Kept
from kept.make import FILES, plain, started

from pancakes.config import parse
from pancakes.config.checks import check_plugins
from pancakes.control import Create, Describe, Guarding, Migrations
from pancakes.devices import Twist
from pancakes.durable.record import Record
from pancakes.durable.register import Identity, Standing
from pancakes.durable.store import Records
from pancakes.journal import Disk, MemoryJournal, VirtualStore
from pancakes.packet import Fence, Packet
from pancakes.services.log import wanted_recordings
from pancakes.testing import AgentHandle, Fleet
from pancakes.util.plugins import Plugins

KINDS = {"boot", "fence", "identity", "ledger", "record", "recording"}
"""The kinds of entries that a journal has. A new one belongs into what is kept."""
STANDINGS = {Standing.OWNER, Standing.HEIR, Standing.YIELDED, Standing.RELEASED}


@pytest.fixture
def fleet(kept: Kept) -> Iterator[Fleet]:
    """The agents a, b and c, five seconds after their power was back."""
    with started(kept.folder / "fleet") as fleet:
        fleet.run_for(5.0)
        yield fleet


def began(agent: AgentHandle, name: str) -> dict[str, Any]:
    """Returns what a task began with, as JSON can say it."""
    told = agent.ask(Describe(name, state=True, began=True)).result["began"]
    return {key: plain(told[key]) for key in ("settings", "periods_s", "state")}


def records_of(folder: Path) -> Iterable[Record]:
    """Returns what an agent has on disk of tasks."""
    disk = {it.name: it.read_bytes() for it in folder.iterdir()}
    journal = MemoryJournal(disk, "new", folder.name)
    store = VirtualStore(journal, lambda delay_s, function: function())
    return Records(Disk(journal, store, []), Identity(folder.name, journal.uuid), {}).all().values()


def owner(fleet: Fleet, name: str) -> str:
    (found,) = [agent.name for agent in fleet.agents.values() if name in agent.running()]
    return found


def test_kept_disks_have_entries_of_every_kind(kept: Kept):
    """Not a test of the product: it tells that a kind of entry was forgotten when the data were made."""
    files = [*(kept.folder / "fleet").glob("?/*.rec")]
    kinds = {file.name.partition(".")[0] for file in files}
    assert kinds == KINDS if kept.is_new else kinds <= {*KINDS, "guard"}, "an older version may have had other kinds"
    records = [it for name in FILES for it in records_of(kept.folder / "fleet" / name)]
    assert {record.standing for record in records} >= STANDINGS
    assert any(record.removed for record in records) and any(record.guarded for record in records)
    assert (kept.folder / "agent" / "state" / "journal.wal").stat().st_size > 1000


def test_kept_disks_are_read_without_complaint(fleet: Fleet):
    said = [line for agent in fleet.agents.values() for level in ("warning", "error") for line in agent.lines(level)]
    assert [line for line in said if not line.startswith(("a/client/Stopped", "a/client/Moved"))] == []
    for name in fleet.agents:
        assert not [file for file in fleet.disk(name) if file.endswith(".bad")]


@pytest.mark.parametrize("name", ["Count", "Created", "Drive", "Guarded", "Moved", "Receiver"])
def test_kept_tasks_go_on_from_their_state(kept: Kept, fleet: Fleet, name: str):
    """With the settings and rates that were changed while they ran, and where they were moved to."""
    expected = kept.expected["fleet"][name]
    assert owner(fleet, name) == expected.pop("agent")
    assert began(fleet.agents[owner(fleet, name)], name) == expected


def test_kept_tasks_that_were_stopped_or_removed_do_not_run(fleet: Fleet):
    a = fleet.agents["a"]
    assert a.ask(Describe("Stopped")).result["state"] == "stopped"
    assert not a.ask(Describe("Removed")).ok
    assert a.ask(Create("Removed", "kept.Count")).ok and a.task("Removed").state.n < 5


def test_kept_guarded_task_has_its_guardians_and_is_taken_over(kept: Kept, fleet: Fleet):
    n = kept.expected["fleet"]["Guarded"]["state"]["n"]
    (row,) = fleet.agents["a"].ask(Guarding()).result
    assert (row["owner"], row["epoch"], row["guardians"]) == ("a", "0@a", ["a", "b", "c"])
    fleet.crash("a")
    fleet.run_for(10.0)
    assert fleet.agents[owner(fleet, "Guarded")].task("Guarded").state.n > n


def test_kept_letters_of_a_task_under_way_arrive(kept: Kept, fleet: Fleet):
    """Sender was handed over from b to c, with letters that no agent had got, when the power failed."""
    before = kept.expected["fleet"]["Receiver"]["state"]["numbers"]
    sent = kept.expected["fleet"]["Sender"]["state"]["n"]
    assert len(before) < sent
    assert owner(fleet, "Sender") == "c"
    assert fleet.agents["a"].task("Receiver").state.numbers == list(range(1, sent + 1))


def test_kept_fence_refuses_an_earlier_epoch(fleet: Fleet):
    a = fleet.agents["a"]
    earlier = Fence("a/Drive", (-1, "a"))
    a.kernel.stream.publish(Packet("ctrl", "motors", "a/client/Drive", "", 0.0, 1, Twist(0.1, 0.0), None, earlier))
    fleet.run_for(0.5)
    (refused,) = a.events("command_refused")
    assert "epoch -1 of a/Drive has passed" in refused["reason"]


def test_kept_wish_for_a_recording_is_read(kept: Kept):
    disk = {it.name: it.read_bytes() for it in (kept.folder / "fleet" / "c").iterdir()}
    journal = MemoryJournal(disk, "new", "c")
    unread: list[str] = []
    store = VirtualStore(journal, lambda delay_s, function: function())
    wanted = wanted_recordings(Disk(journal, store, unread)).newest["log/Recorder"]
    assert Path(wanted.first).name == "c.mcap" and wanted.settings["path"] == wanted.first and unread == []


def test_kept_accounts_of_moves_are_listed(fleet: Fleet):
    accounts = {agent.name: agent.ask(Migrations()).result for agent in fleet.agents.values()}
    moves = {(it["task_id"], it["boot"]) for rows in accounts.values() for it in rows}
    assert ("a/Moved", 1) in moves


@pytest.mark.parametrize("file", ["agent/alone.toml", *(f"fleet/{name}.toml" for name in FILES), "recording/a.toml"])
def test_kept_configurations_are_sound(kept: Kept, file: str):
    config = parse((kept.folder / file).read_text(), file)
    assert check_plugins(config, Plugins(), must_load=True) == []
