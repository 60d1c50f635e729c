"""`pancakes task recover` with real agents: each kind of trouble is made from outside, and the command ends it.

Two owners are in `test_two_owners.py`, guarded tasks in `test_lost_agents.py`, damaged records in
`test_state_directories.py`, actuators in `test_fence_verb.py`. No test here knows how agents agree with each other.
"""

from __future__ import annotations

import shutil
import signal
from collections.abc import Callable, Iterator

import pytest
from cli.processes import Rig, Running, recovered, troubles
from cli.relay import Relay
from cli.test_births import begun, disk_of, end, states
from cli.test_consent import answered
from cli.test_lost_agents import soon
from cli.test_two_owners import SOURCE, TASK, heard

COUNT = ("[pancakes.tasks]\ncount.Count = plugin_count:Count\n", SOURCE)


@pytest.fixture
def relayed() -> Iterator[Callable[[str], Relay]]:
    """Make relays, and close them in the end."""
    made = []

    def relay(target: str) -> Relay:
        made.append(Relay(target))
        return made[-1]

    yield relay
    for it in made:
        it.close()


def kill(*agents: Running) -> None:
    for agent in agents:
        agent.process.send_signal(signal.SIGKILL)
        agent.process.wait()


def counted(rig: Rig, agent: str) -> int:
    (row,) = rig.listed("task", "info", f"{agent}/Count", "--state")
    return int(row["kept_state"]["n"])


# In order ----------------------------------------------------------------------------------------------------------


def test_recover_leaves_a_running_task_alone(rig: Rig):
    rig.install("count", *COUNT)
    a = rig.ready("a", TASK)
    heard(a, "task_started task=Count")
    assert rig.pancakes("task", "recover").stdout == "no task of a is in trouble\n"
    code, row, _ = recovered(rig, "a/Count")
    assert (code, row["trouble"], row["done"], row["proposal"]["act"]) == (0, "", "", "")
    shown = rig.pancakes("task", "recover", "a/Count")
    assert shown.stdout.startswith("a/Count: in order\na/Count runs on a.\n")
    assert rig.pancakes("task", "recover", "a/Count", "--here", "--yes").returncode == 0
    code, row, _ = recovered(rig, "a/Count", "--not-here", "--yes")
    assert code == 1 and "a has the only copy" in row["proposal"]["text"]
    assert states(rig)["a", "Count"] == ("running", "")


def test_recover_names_what_it_does_not_know(rig: Rig):
    rig.ready("a")
    code, row, _ = recovered(rig, "a/Nothing")
    assert (code, row["trouble"]) == (1, "unknown")
    assert row["what"] == "No agent that answers (a) knows of a task Nothing."
    assert "check its name with pancakes task list" in row["proposal"]["text"]
    code, row, _ = recovered(rig, "x/Nothing", "--here", "--yes")
    assert code == 1 and row["proposal"]["text"].endswith("because x does not answer. These do: a")


def test_recover_tells_tasks_of_one_name_apart(rig: Rig):
    rig.install("count", *COUNT)
    for name in "ab":
        heard(rig.ready(name, TASK), "task_started task=Count")
    rig.ready("c")
    assert troubles(rig) == {}
    assert recovered(rig, "a/Count")[1]["what"] == "a/Count runs on a."
    code, _, said = recovered(rig, "c/Count")
    assert (code, said) == (1, "a/Count and b/Count may be meant: choose one with --birthplace AGENT\n")
    code, row, _ = recovered(rig, "c/Count", "--birthplace", "b")
    assert (code, row["what"]) == (0, "b/Count runs on b.")


def test_recover_mixes_no_tasks_of_one_name(rig: Rig):
    """Robots of a kind have tasks of one name: that of the lost one is not that of another."""
    rig.install("count", *COUNT)
    heard(rig.ready("a", TASK), "task_started task=Count")
    rig.ready("b")
    code, row, _ = recovered(rig, "zz/Count")
    assert (code, row["task_id"], row["trouble"]) == (1, "zz/Count", "lost agent")
    assert row["what"].endswith("knows of zz/Count, only of a/Count.")
    assert recovered(rig, "b/Count")[1]["task_id"] == "a/Count", "it may be the agent that should run it"


def test_recover_finds_what_another_person_has_recovered(rig: Rig):
    rig.install("count", *COUNT)
    a = rig.ready("a", TASK)
    heard(a, "task_started task=Count")
    assert rig.pancakes("task", "stop", "a/Count").returncode == 0

    def other() -> None:
        assert recovered(rig, "a/Count", "--here", "--yes")[1]["done"] == "started"

    code, shown = answered(rig, "y", "task", "recover", "a/Count", "--here", meanwhile=other)
    assert code == 0 and shown.endswith("It was set right meanwhile: a/Count runs on a."), shown


# Given up ----------------------------------------------------------------------------------------------------------

FRAGILE = """
import os
from dataclasses import dataclass
from pancakes.task import Task, every

class Fragile(Task):
    @dataclass
    class State:
        n: int = 0

    def on_start(self):
        if os.path.exists("broken"):
            raise ValueError("it is broken")

    @every(hz=20)
    def tick(self, tick):
        self.state.n += 1
        if os.path.exists("broken"):
            raise ValueError("it is broken")
"""


def test_recover_starts_a_task_that_was_given_up(rig: Rig):
    rig.install("fragile", "[pancakes.tasks]\nfragile.Fragile = plugin_fragile:Fragile\n", FRAGILE)
    a = rig.ready("a", '[task.Fragile]\ntype = "fragile.Fragile"\nrestart = { at_most = 1, within_s = 60.0 }\n')
    heard(a, "task_started task=Fragile")
    broken = rig.directory / "broken"
    broken.touch()
    heard(a, "it is broken")
    assert soon(lambda: troubles(rig) == {"a/Fragile": "given up"})
    code, row, said = recovered(rig, "a/Fragile")
    assert code == 1 and "it is broken" in row["what"] and row["proposal"]["act"] == "start" and row["done"] == ""
    assert "Lost: nothing. Pass --yes to do it" in said
    code, row, said = recovered(rig, "a/Fragile", "--yes")
    assert code == 1 and "it is broken" in said, "the agent says why it fails again"
    assert soon(lambda: troubles(rig) == {"a/Fragile": "given up"})
    broken.unlink()
    assert recovered(rig, "a/Fragile", "--dry-run")[1]["done"] == "dry run"
    assert troubles(rig) == {"a/Fragile": "given up"}
    code, shown = answered(rig, "n", "task", "recover", "a/Fragile")
    assert code == 1 and shown.endswith("nothing was done")
    code, shown = answered(rig, "y", "task", "recover", "a/Fragile")
    assert code == 0 and "Done: a/Fragile runs on a." in shown
    assert troubles(rig) == {} and states(rig)["a", "Fragile"] == ("running", "")


# A lost disk -------------------------------------------------------------------------------------------------------


def test_recover_leaves_a_task_where_it_runs(rig: Rig):
    a, _, peers = begun(rig)
    assert rig.pancakes("task", "migrate", "a/Count", "--to", "b").returncode == 0
    end(a)
    shutil.rmtree(disk_of(rig))
    a = rig.ready("a", TASK, agent=peers)
    heard(a, "not_born task=Count")
    assert troubles(rig) == {"a/Count": "lost disk"}
    code, row, said = recovered(rig, "a/Count")
    assert code == 1 and "a/Count runs on b." in row["what"] and row["proposal"]["lost"] == ""
    assert "leave it on b" in said
    code, row, _ = recovered(rig, "a/Count", "--yes")
    assert (code, row["done"]) == (0, "left")
    assert troubles(rig) == {}
    found = states(rig)
    assert found["b", "Count"] == ("running", "") and found["a", "Count"][0] == "stopped"
    # It comes back by a migration like any other.
    assert rig.pancakes("task", "migrate", "b/Count", "--to", "a").returncode == 0
    assert states(rig)["a", "Count"] == ("running", "")


def test_recover_begins_what_its_new_agent_lost(rig: Rig):
    """No agent has it, and only the one that it was born on remembers it."""
    rig.install("count", *COUNT)
    b = rig.ready("b")
    address = rig.address(b)
    a = rig.ready("a", TASK, agent=f'peers = ["{address}"]')
    heard(a, "task_started task=Count")
    assert soon(lambda: counted(rig, "a") >= 60)
    assert rig.pancakes("task", "migrate", "a/Count", "--to", "b").returncode == 0
    assert troubles(rig) == {} and rig.pancakes("doctor", "--no-machine").returncode == 0
    kill(b)
    heard(a, "peer_down peer=b")
    shutil.rmtree(disk_of(rig, "b"))
    rig.agent(rig.directory / "b.toml", "--set", f'agent.listen="{address}"')
    heard(a, "peer_up peer=b")
    assert soon(lambda: troubles(rig) == {"a/Count": "lost disk"})
    doctor = rig.pancakes("doctor", "--no-machine")
    assert doctor.returncode == 1 and "a/Count: was given to b" in " ".join(doctor.stdout.split()), doctor.stdout
    for asked in ("a/Count", "b/Count"):
        code, row, _ = recovered(rig, asked)
        assert (code, row["proposal"]["act"], row["proposal"]["agent"]) == (1, "adopt", "a")
    assert row["proposal"]["lost"] == "all of its former state"
    code, row, _ = recovered(rig, "a/Count", "--yes")
    assert (code, row["runs_on"]) == (0, "a") and troubles(rig) == {}
    assert counted(rig, "a") < 60, "as its configuration says"
    assert rig.pancakes("task", "migrate", "a/Count", "--to", "b").returncode == 0


def test_recover_follows_a_task_to_its_last_agent(rig: Rig):
    """The agent that it was born on knows only of the first move."""
    rig.install("count", *COUNT)
    b, c = rig.ready("b"), rig.ready("c")
    a = rig.ready("a", TASK, agent=f'peers = ["{rig.address(b)}", "{rig.address(c)}"]')
    for what in ("peer_up peer=b", "peer_up peer=c", "task_started task=Count"):
        heard(a, what)
    heard(c, "peer_up peer=b")
    for giver, taker in ("ab", "bc"):
        assert rig.pancakes("task", "migrate", f"{giver}/Count", "--to", taker).returncode == 0
    assert troubles(rig) == {} and rig.pancakes("doctor", "--no-machine").returncode == 0
    kill(c)
    heard(a, "peer_down peer=c")
    heard(b, "peer_down peer=c")
    for asked in ("a/Count", "c/Count"):
        code, row, _ = recovered(rig, asked)
        assert (code, row["task_id"], row["trouble"], row["proposal"]["text"]) == (
            1,
            "a/Count",
            "lost agent",
            "start c",
        )
    assert troubles(rig) == {"a/Count": "lost agent"}
    assert row["choices"][0]["only_if"].startswith("c is off")
    code, row, _ = recovered(rig, "a/Count", "--here", "--yes")
    assert (code, row["runs_on"]) == (0, "a")


def test_recover_begins_a_task_lost_with_both_disks(rig: Rig):
    a, b, peers = begun(rig)
    assert rig.pancakes("task", "migrate", "a/Count", "--to", "b").returncode == 0
    end(a)
    shutil.rmtree(disk_of(rig))
    a = rig.ready("a", TASK, agent=peers)
    heard(a, "not_born task=Count")
    kill(b)
    heard(a, "peer_down peer=b")
    code, row, said = recovered(rig, "a/Count")
    assert (code, row["trouble"], row["proposal"]["act"]) == (1, "lost disk", "adopt")
    assert row["proposal"]["lost"] == "all of its former state"
    assert "Only if no agent that is off or cut off from here still has a/Count" in said
    assert states(rig)["a", "Count"] == ("stopped", "disk lost")
    code, row, _ = recovered(rig, "a/Count", "--yes")
    assert (code, row["runs_on"]) == (0, "a")
    assert states(rig)["a", "Count"] == ("running", "") and troubles(rig) == {}


def test_recover_begins_a_lost_task_on_another_agent(rig: Rig):
    rig.install("count", *COUNT)
    b = rig.ready("b")
    a = rig.ready("a", TASK, agent=f'peers = ["{rig.address(b)}"]')
    heard(a, "task_started task=Count")
    kill(a)
    heard(b, "peer_down peer=a")
    code, row, _ = recovered(rig, "a/Count")
    assert (code, row["trouble"]) == (1, "lost agent") and "--here --config FILE" in row["proposal"]["text"]
    words = ("b/Count", "--here", "--config", str(rig.directory / "a.toml"))
    code, row, said = recovered(rig, *words)
    assert code == 1 and "all of its state" in row["proposal"]["lost"] and "Pass --yes" in said
    assert recovered(rig, *words, "--dry-run")[1]["done"] == "dry run"
    assert ("b", "Count") not in states(rig)
    assert recovered(rig, *words, "--yes")[1]["runs_on"] == "b"
    assert states(rig)["b", "Count"] == ("running", "")
    wrong = rig.pancakes("task", "recover", "b/Nothing", *words[1:])
    assert wrong.returncode == 1 and "has no [task.Nothing]. It has Count" in wrong.stderr


# A restored backup -------------------------------------------------------------------------------------------------


def test_recover_has_nothing_to_do_for_a_restored_backup_if_the_others_know_of_no_later_owner(rig: Rig):
    """What waits until they have told is in tests/services/test_old_copies.py: here they tell at once."""
    rig.install("count", *COUNT)
    others = [rig.ready(name) for name in "bc"]
    peers = ", ".join(f'"{rig.address(it)}"' for it in others)

    def started() -> Running:
        return rig.ready("a", TASK, agent=f"peers = [{peers}]")

    def met(agent: Running) -> Running:
        for name in "bc":
            heard(agent, f"peer_up peer={name}")
        heard(agent, "task_started task=Count")
        return agent

    end(met(started()))
    backup, disk = rig.directory / "backup", disk_of(rig)
    shutil.copytree(disk, backup)
    for _ in range(2):
        end(met(started()))
    shutil.rmtree(disk)
    shutil.copytree(backup, disk)
    a = started()
    heard(a, "old_copy")
    heard(a, "task_started task=Count")
    assert states(rig)["a", "Count"] == ("running", "") and troubles(rig) == {}


# In doubt ----------------------------------------------------------------------------------------------------------


def cut_migration(rig: Rig, relayed: Callable[[str], Relay], name: str, pieces: int) -> Running:
    """Migrate Count from a to a new agent, which is killed, with its link, when it has answered in so many pieces.

    Returns:
        Agent a, started again with the new agent as its peer.
    """
    other = rig.ready(name)
    address = rig.address(other)
    relay = relayed(address)
    a = rig.ready("a", TASK, agent=f'peers = ["{relay.address}"]')
    heard(a, f"peer_up peer={name}")
    heard(a, "task_started task=Count")
    left = [pieces]

    def may_pass(data: bytes) -> bool:
        left[0] -= 1
        if left[0] <= 0:
            kill(other)
        return left[0] > 0

    relay.answered = may_pass
    rig.pancakes("task", "migrate", "a/Count", "--to", name, "--timeout", "3s")
    kill(other)
    heard(a, f"peer_down peer={name}")
    if troubles(rig) == {"a/Count": "lost agent"}:  # it was handed over before the cut: bring it back
        relay.answered = lambda data: True
        back = rig.agent(rig.directory / f"{name}.toml", "--set", f'agent.listen="{address}"')
        a.hear(f"peer_up peer={name}")
        heard(back, "task_started task=Count")
        assert rig.pancakes("task", "migrate", f"{name}/Count", "--to", "a").returncode == 0
        end(back)
    return a


def in_doubt(rig: Rig, relayed: Callable[[str], Relay]) -> tuple[Running, int]:
    """Cut migrations from a, first where the new agent has just taken the task, until one is in doubt.

    On a busy machine heartbeats come between the pieces of a migration.

    Returns:
        Agent a, and what the task had counted at least when the migration began.
    """
    a = rig.ready("a", TASK)
    heard(a, "task_started task=Count")
    n = soon(lambda: counted(rig, "a"))
    for tried in range(60):
        end(a)
        a = cut_migration(rig, relayed, f"b{tried}", 1 + (tried + 3) % 20)
        if found := troubles(rig):
            assert found == {"a/Count": "in doubt"}
            return a, n
    raise AssertionError("no migration was in doubt")


def test_recover_runs_a_task_that_is_in_doubt(rig: Rig, relayed: Callable[[str], Relay]):
    rig.install("count", *COUNT)
    a, n = in_doubt(rig, relayed)
    code, row, said = recovered(rig, "a/Count")
    assert (code, row["trouble"], row["proposal"]["act"], row["proposal"]["agent"]) == (1, "in doubt", "adopt", "a")
    assert "never comes back with its present disk" in said and states(rig)["a", "Count"][0] != "running"
    shown = rig.pancakes("task", "recover", "a/Count").stdout
    assert "was cut off" in shown and "only if" in shown
    assert recovered(rig, "a/Count", "--dry-run")[1]["done"] == "dry run"
    code, row, _ = recovered(rig, "a/Count", "--yes")
    assert (code, row["done"], row["runs_on"]) == (0, "runs here", "a")
    assert states(rig)["a", "Count"] == ("running", "") and troubles(rig) == {}
    assert counted(rig, "a") >= n, "it goes on with the state that it had"
    end(a)
    rig.ready("a", TASK)
    assert soon(lambda: states(rig)["a", "Count"] == ("running", "")), "the decision outlives a restart"
