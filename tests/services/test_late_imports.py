"""A plug-in whose import takes long, or fails: no other part of the agent waits, and neighbours get the reason."""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest
from services.counting import Count

from pancakes.control import Create, Describe, Migrate, Revive
from pancakes.durable.messages import CanGuard, MayGuard
from pancakes.durable.record import TaskId
from pancakes.packet import NETWORK
from pancakes.supervision.messages import GUARDIAN
from pancakes.testing import AgentHandle, Fleet, threaded_agent

INSECURE = "[service.network]\nsettings = { insecure = true }\n"
LATE = "late_in_test.Slow"
IMPORTING, GO_ON, FAILS = threading.Event(), threading.Event(), threading.Event()
THREADS: list[str] = []
SOURCE = f"""
import sys, threading
from pancakes.task import Task
sys.modules[{__name__!r}].THREADS.append(threading.current_thread().name)
sys.modules[{__name__!r}].IMPORTING.set()
assert sys.modules[{__name__!r}].GO_ON.wait(20.0)
assert not sys.modules[{__name__!r}].FAILS.is_set(), "no camera"
class Slow(Task):
    pass
"""


class Pair(NamedTuple):
    """Two linked agents; the second has not imported the class of a task of the first."""

    a: AgentHandle
    b: AgentHandle


@pytest.fixture
def late_plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    information = tmp_path / "late_in_test-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: late-in-test\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(f"[pancakes.tasks]\n{LATE} = late_in_test:Slow\n")
    (tmp_path / "late_in_test.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)


@contextmanager
def pair() -> Iterator[Pair]:
    classes = {"test.Count": Count}
    tasks = {"Slow": {"type": LATE}, "Count": {"type": "test.Count"}}
    FAILS.clear()
    GO_ON.set()
    with threaded_agent("b", INSECURE, classes=classes, listen="tcp://127.0.0.1:0") as b:
        with threaded_agent("a", INSECURE, classes=classes, tasks=tasks, peers=tuple(b.agent.mesh.listen)) as a:
            a.wait_until(lambda: a.agent.mesh.neighbours() == ["b"] and sorted(a.running()) == ["Count", "Slow"])
            GO_ON.clear()
            IMPORTING.clear()
            del sys.modules["late_in_test"]
            try:
                yield Pair(a, b)
            finally:
                GO_ON.set()


@pytest.mark.usefixtures("late_plugin")
def test_a_task_moves_to_an_agent_that_imports_its_class_first() -> None:
    with pair() as (a, b):
        moved = a.publish("sysctrl", Migrate("Slow"))
        assert IMPORTING.wait(20.0)
        assert THREADS[-1] == "b-Importer", "no thread of the pool is held"
        other = a.ask(Migrate("Count", dry_run=True))
        assert other.result["winner"] == "b", "other tasks are bid for meanwhile"
        assert not b.events("migration_bid", task="Slow")
        GO_ON.set()
        reply = a.reply_to(moved)
        assert reply.ok and reply.result["winner"] == "b"
        b.wait_until(lambda: b.running() == ["Slow"])


@pytest.mark.usefixtures("late_plugin")
def test_an_agent_answers_whether_it_would_guard_a_task_once_it_knows_its_class() -> None:
    with pair() as (a, b):
        journal = b.agent.mesh.identity.journal
        a.publish(NETWORK, MayGuard(TaskId("a", "Slow"), LATE, journal), f"b/{GUARDIAN}")
        assert IMPORTING.wait(20.0)
        a.publish(NETWORK, MayGuard(TaskId("a", "Count"), "test.Count", journal), f"b/{GUARDIAN}")
        a.wait_for(CanGuard, lambda told: told.task_id == TaskId("a", "Count") and told.runs_type)
        assert not [it for it in a.probe.packets(CanGuard) if it.body.task_id == TaskId("a", "Slow")]
        GO_ON.set()
        a.wait_for(CanGuard, lambda told: told.task_id == TaskId("a", "Slow") and told.runs_type)


@pytest.mark.parametrize("body", [Create("New", LATE), Revive("z/New", LATE)], ids=lambda it: type(it).__name__)
@pytest.mark.usefixtures("late_plugin")
def test_a_service_that_is_to_begin_a_task_answers_others_while_its_class_is_imported(body: Create | Revive) -> None:
    with pair() as (_, b):
        asked = b.publish("sysctrl", body)
        assert IMPORTING.wait(20.0)
        assert b.ask(Describe("client")).ok and not b.running()
        GO_ON.set()
        assert b.reply_to(asked).ok
        b.wait_until(lambda: b.running() == ["New"])


@pytest.mark.usefixtures("late_plugin")
def test_an_agent_that_is_stopped_meanwhile_does_not_wait_for_the_import() -> None:
    with pair() as (a, b):
        a.publish("sysctrl", Migrate("Slow"))
        assert IMPORTING.wait(20.0)
        b.stop()
        assert not GO_ON.is_set()


@pytest.mark.usefixtures("late_plugin")
def test_an_agent_that_cannot_import_a_class_says_why() -> None:
    with pair() as (a, _):
        FAILS.set()
        GO_ON.set()
        reason = a.ask(Migrate("Slow")).reason
        assert reason.startswith(
            "no neighbour can take Slow: b: the task type 'late_in_test.Slow' of late-in-test 1.0 (late_in_test:Slow)"
            " cannot be loaded: AssertionError: no camera"
        )


@pytest.mark.usefixtures("late_plugin")
def test_no_class_is_imported_for_a_peer_that_may_not_bring_such_tasks() -> None:
    sys.modules.pop("late_in_test", None)
    IMPORTING.clear()
    GO_ON.set()
    with Fleet() as fleet:
        fleet.start("a", '[[access.allow]]\nwho = ["b"]\nmay = ["look", "change", "adopt", "guard"]\n')
        b = fleet.start("b")
        fleet.connect()
        for body in (Create("New", LATE), Revive("z/New", LATE)):
            assert f"New cannot run on a: a does not let b (agent) do this: it lacks the right 'host' on '{LATE}'" in (
                b.ask(body, to="a").reason
            )
        journal = fleet.agents["a"].agent.mesh.identity.journal
        b.publish(NETWORK, MayGuard(TaskId("b", "Slow"), LATE, journal), f"a/{GUARDIAN}")
        b.wait_for(CanGuard, lambda told: "it lacks the right 'host'" in told.refusal and not told.runs_type)
    assert not IMPORTING.is_set()
