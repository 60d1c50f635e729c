"""Behaviour trees as tasks: a tree goes on where it was after a migration, a take-over and a restart."""

import uuid
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, ClassVar

import msgspec
import py_trees
import pytest
from py_trees.behaviours import CheckBlackboardVariableValue, SetBlackboardVariable, StatusQueue, TickCounter
from py_trees.blackboard import Blackboard
from py_trees.common import ComparisonExpression, ParallelPolicy, Status
from py_trees.composites import Parallel, Selector, Sequence

from pancakes.control import Migrate, Stop
from pancakes.errors import ClassError
from pancakes.packet import SYSTEM, packet_type
from pancakes.request import Answer, Request, answers
from pancakes.task import Task, Tick, every, on
from pancakes.testing import Fleet, threaded_agent
from pancakes.trees import TaskBehaviour, Timeout, Timer, TreeState, TreeTask


@packet_type("trees_in_test.step")
class Step(msgspec.Struct, frozen=True):
    by: str
    number: int


@packet_type("trees_in_test.goal")
class Goal(msgspec.Struct, frozen=True):
    steps: int


class Walk(TaskBehaviour):
    """Take some steps, one a tick, and publish each."""

    keeps = ("steps",)

    def __init__(self, name: str, wanted: int) -> None:
        super().__init__(name)
        self.wanted = wanted
        self.steps = 0

    def initialise(self) -> None:
        self.steps = 0

    def update(self) -> Status:
        self.steps += 1
        self.feedback_message = f"{self.steps} of {self.wanted}"
        self.task.publish(SYSTEM, Step(self.name, self.steps))
        return Status.SUCCESS if self.steps == self.wanted else Status.RUNNING


class Deliver(TreeTask):
    """Walk there, wait 2 s, walk back; then stay at the end."""

    def make_tree(self) -> py_trees.behaviour.Behaviour:
        steps = [Walk("there", 4), Timer("load", 2.0), Walk("back", 4)]
        return Sequence("deliver", memory=True, children=steps)

    def on_end(self, status: Status) -> None:
        self.reschedule(0.0, "tick_tree")


def steps_of(agent: Any) -> list[tuple[str, int]]:
    return [(it.body.by, it.body.number) for it in agent.probe.packets(body=Step)]


def statuses(task: Any) -> dict[str, str]:
    return {node.name: node.status for node in task.state.nodes}


CALLS: list[str] = []
ALL_STEPS = [(name, number) for name in ("there", "back") for number in (1, 2, 3, 4)]


def moved(cls: type, at_s: float, until_s: float) -> tuple[Any, Any, Fleet]:
    """Run a task at 2 Hz, and migrate it in between; return both agents' handles, and the fleet."""
    fleet = Fleet()
    a = fleet.start("a", tasks={"T": {"type": cls, "rate_hz": 2}})
    b = fleet.start("b", classes={"T": cls})
    fleet.connect()
    fleet.run_to(at_s)
    reply = a.ask(Migrate("T", to="b"))
    assert reply.ok, reply.reason
    fleet.run_to(until_s)
    return a, b, fleet


@pytest.mark.parametrize("at_s", [1.2, 2.2, 3.2, 5.2])
def test_a_sequence_goes_on_where_it_was_after_a_migration(at_s: float):
    a, b, fleet = moved(Deliver, at_s, 12.0)
    with fleet:
        assert steps_of(a) + steps_of(b) == ALL_STEPS
        assert set(statuses(b.task("T")).values()) == {"SUCCESS"}


def test_a_tree_goes_on_where_it_was_after_its_robot_is_lost():
    guard = {"copies": 3, "lease_s": 2.0, "checkpoint_s": 0.5}
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"T": {"type": Deliver, "rate_hz": 1, "guard": guard}})
        others = [fleet.start(name, classes={"T": Deliver}) for name in ("b", "c")]
        fleet.connect()
        fleet.run_until(lambda: statuses(a.task("T")).get("there") == "SUCCESS")
        fleet.run_for(1.5)  # so that a checkpoint has it
        before = steps_of(a)
        fleet.crash("a")
        assert fleet.run_until(lambda: any(it.running() for it in others))
        fleet.run_for(10.0)
        (heir,) = [it for it in others if it.running()]
        assert statuses(heir.task("T"))["deliver"] == "SUCCESS"
    assert before == [("there", 1), ("there", 2), ("there", 3), ("there", 4)]
    assert steps_of(heir) == [("back", 1), ("back", 2), ("back", 3), ("back", 4)]


def test_a_tree_goes_on_where_it_was_after_a_restart_of_its_agent():
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"T": {"type": Deliver, "rate_hz": 2}})
        fleet.run_until(lambda: len(steps_of(a)) == 3)
        before = steps_of(a)
        fleet.stop("a")
        a = fleet.restart("a")
        fleet.run_for(12.0)
        assert before + steps_of(a) == ALL_STEPS


def test_the_same_seed_gives_the_same_run_with_a_migration():
    runs = []
    for _ in range(2):
        a, b, fleet = moved(Deliver, 2.2, 12.0)
        with fleet:
            runs.append([str(packet) for agent in (a, b) for packet in agent.probe.packets()])
    assert runs[0] == runs[1]


@pytest.mark.parametrize(
    "make", [lambda: Timer("t", 2.0), lambda: Timeout("t", py_trees.behaviours.Running("on"), 2.0)]
)
def test_what_is_left_of_a_time_is_left_where_the_mission_began_anew(make: Any):
    """An agent that restarts by itself begins its mission at 0."""
    node, times_s = make(), iter((100.0, 101.5, 0.0, 0.4, 0.6))
    node.task = SimpleNamespace(now=lambda: next(times_s))
    node.tick_once()
    kept, there = {name: getattr(node, name) for name in node.keeps}, make()
    there.task, there.status = node.task, Status.RUNNING
    for name, value in kept.items():
        setattr(there, name, value)
    seen = []
    for _ in range(3):
        there.tick_once()
        seen.append(there.status is Status.RUNNING)
    assert seen == [True, True, False]


# What the nodes of py_trees remember --------------------------------------------------------------------------------

OK, BAD, ON = Status.SUCCESS, Status.FAILURE, Status.RUNNING


def queue(name: str, *results: Status) -> py_trees.behaviour.Behaviour:
    return StatusQueue(name, list(results), eventually=None)


def guarded() -> py_trees.behaviour.Behaviour:
    there = ComparisonExpression("seen", 2, lambda value, wanted: value >= wanted)
    check = CheckBlackboardVariableValue("is it seen", there)
    look = SetBlackboardVariable("look", "seen", 2, overwrite=True)
    return Selector("guarded", memory=False, children=[Sequence("go", False, [check, TickCounter("on", 9, OK)]), look])


def either(namespace: str | None) -> py_trees.behaviour.Behaviour:
    wanted = [ComparisonExpression("way", way, lambda value, wanted: value == wanted) for way in (1, 2)]
    ways = [queue("left", ON, OK), queue("right", *[ON] * 3, OK)]
    choose = py_trees.idioms.either_or(conditions=wanted, subtrees=ways, name="either", namespace=namespace)
    return Sequence("way", memory=True, children=[SetBlackboardVariable("right", "way", 2, overwrite=True), choose])


TREES: dict[str, Any] = {
    "selector": lambda: Selector("s", memory=True, children=[queue("p", ON, BAD), queue("q", ON, ON, OK)]),
    "parallel": lambda: Parallel(
        "p", ParallelPolicy.SuccessOnAll(synchronise=True), [queue("p", OK, ON, ON), queue("q", ON, ON, ON, OK)]
    ),
    "repeat": lambda: py_trees.decorators.Repeat("r", queue("p", ON, OK), 3),
    "retry": lambda: py_trees.decorators.Retry("r", queue("p", BAD, ON), 4),
    "one shot": lambda: py_trees.decorators.OneShot(
        "o", queue("p", ON, OK, BAD, BAD), py_trees.common.OneShotPolicy.ON_COMPLETION
    ),
    "count": lambda: py_trees.decorators.Count("c", queue("p", ON, OK, BAD)),
    "periodic": lambda: py_trees.behaviours.Periodic("p", 2),
    "every n": lambda: py_trees.behaviours.SuccessEveryN("n", 3),
    "status": lambda: py_trees.decorators.StatusToBlackboard("s", queue("p", ON, OK), "result"),
    "guarded": guarded,
    "one after the other": lambda: py_trees.idioms.pick_up_where_you_left_off(
        "p", [queue("p", ON, OK), queue("q", ON, OK)]
    ),
    "either": lambda: either("ns"),
    "timeout": lambda: Timeout("t", py_trees.behaviours.Running("on"), 1.7),
}


class Watched(TreeTask):
    """Notes the statuses of its nodes after each tick."""

    kind: ClassVar[str] = ""

    @dataclass
    class State(TreeState):
        seen: list[dict[str, str]] = field(default_factory=list)

    def make_tree(self) -> py_trees.behaviour.Behaviour:
        tree: py_trees.behaviour.Behaviour = TREES[self.kind]()
        return tree

    @every(hz=2)
    def tick_tree(self, tick: Tick) -> None:
        super().tick_tree(tick)
        self.state.seen.append(statuses(self))


@pytest.mark.parametrize("kind", TREES)
def test_nodes_of_py_trees_end_as_without_a_migration(kind: str):
    cls = type("Watched", (Watched,), {"kind": kind})
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"T": {"type": cls}, "Stays": {"type": cls}})
        b = fleet.start("b", classes={"T": cls})
        fleet.connect()
        fleet.run_to(1.2)
        for agent, to in ((a, "b"), (b, "a"), (a, "b")):
            assert agent.ask(Migrate("T", to=to)).ok
            fleet.run_for(1.0)
        fleet.run_to(8.2)
        there, here = b.task("T").state, a.task("Stays").state
        assert len(there.seen) == len(here.seen) == 16
        assert (there.seen, there.nodes, there.blackboard) == (here.seen, here.nodes, here.blackboard)


@pytest.mark.parametrize(
    ("node", "instead"),
    [
        (lambda: py_trees.timers.Timer("bad", 1.0), "use pancakes.trees.Timer"),
        (lambda: py_trees.decorators.Timeout("bad", py_trees.behaviours.Running("on"), 1.0), "pancakes.trees.Timeout"),
        (lambda: py_trees.behaviours.ProbabilisticBehaviour("bad"), "self.task.random"),
    ],
)
def test_a_node_that_does_not_carry_over_is_refused_with_what_to_use(node: Any, instead: str):
    assert instead in refusal_of(lambda self: Selector("root", memory=False, children=[node()]))


# Trees that cannot work ---------------------------------------------------------------------------------------------


def refusal_of(make_tree: Any, for_s: float = 0.0) -> str:
    """Return why a task with a tree is given up."""
    cls = type("Wrong", (TreeTask,), {"make_tree": make_tree})
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"T": cls})
        fleet.run_for(for_s)
        (news,) = a.events("task_given_up")
        assert len(a.events("task_failed")) == 1, "it is not tried again"
        return str(news["error"])


def twice(node: Any) -> py_trees.behaviour.Behaviour:
    return Sequence("s", True, [py_trees.decorators.Inverter(name, node) for name in ("p", "q")])


@pytest.mark.parametrize(
    ("make_tree", "why"),
    [
        (lambda self: Sequence("s", True, [Walk("w", 1), Walk("w", 2)]), "two children named 'w'"),
        (lambda self: twice(Walk("w", 1)), "s > q > w is in the tree twice"),
        (lambda self: py_trees.trees.BehaviourTree(Walk("w", 1)), "return the root of the tree"),
        (lambda self: either(None), "give `either_or` a namespace"),
        (lambda self: Walk(str(uuid.uuid4()), 1), "has a random part in its name"),
        (lambda self: type("W", (Walk,), {"keeps": ("typo",)})("w", 1), "'typo', which its __init__ does not set"),
        (lambda self: type("W", (Walk,), {"keeps": "steps"})("w", 1), "no tuple of names"),
    ],
)
def test_a_tree_that_cannot_work_is_refused_with_the_reason(make_tree: Any, why: str):
    assert why in refusal_of(make_tree)


class Adds(TaskBehaviour):
    """Adds a node to the tree that it is in."""

    def update(self) -> Status:
        self.parent.add_child(Walk("more", 1))
        return Status.RUNNING


def test_a_tree_that_changes_while_it_runs_is_refused():
    assert "has changed since it was made" in refusal_of(lambda self: Sequence("s", True, [Adds("adds")]), for_s=1.0)


def test_nodes_are_not_shared_between_tasks():
    shared = Walk("one", 9)
    cls = type("Shares", (TreeTask,), {"make_tree": lambda self: shared})
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"T": cls, "U": cls})
        (news,) = a.events("task_given_up")
        assert "make_tree makes new nodes each time" in news["error"]


def test_a_class_whose_state_is_no_state_of_a_tree_is_refused():
    with pytest.raises(ClassError, match="TreeState"):

        class Wrong(TreeTask):
            @dataclass
            class State:
                count: int = 0


def test_a_class_cannot_replace_a_name_of_a_tree_task():
    with pytest.raises(ClassError, match="blackboard"):

        class Wrong(TreeTask):
            blackboard = None  # type: ignore[assignment]


class Opens(TaskBehaviour):
    """Holds something that is open from its `setup` to its `shutdown`; one of them fails in the third tick."""

    fails_in: ClassVar[str] = ""

    def setup(self, **kwargs: Any) -> None:
        if (self.name, self.fails_in) == ("q", "setup"):
            raise OSError("no camera")
        CALLS.append(f"open {self.name}")

    def update(self) -> Status:
        if (self.name, self.fails_in) == ("q", "update"):
            raise OSError("the camera has gone")
        return Status.SUCCESS

    def shutdown(self) -> None:
        CALLS.append(f"close {self.name}")
        if self.fails_in == "update":
            raise OSError("the camera has gone")


@pytest.mark.parametrize(
    ("fails_in", "calls"),
    [("setup", ["open p", "close p"]), ("update", ["open p", "open q", "close p", "close q"])],
)
def test_what_a_behaviour_opened_is_closed_if_the_task_fails(fails_in: str, calls: list[str]):
    CALLS.clear()
    cls = type("Opens", (Opens,), {"fails_in": fails_in})
    tree = type("T", (TreeTask,), {"make_tree": lambda self: Sequence("s", True, [cls("p"), cls("q")])})
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"T": {"type": tree, "restart": {"policy": "no"}}})
        fleet.run_for(1.0)
        (news,) = a.events("task_failed")
        assert "camera" in news["error"]
    assert calls == CALLS


# A later version ----------------------------------------------------------------------------------------------------


class Changed(Deliver):
    """Is of another version on b."""

    def make_tree(self) -> py_trees.behaviour.Behaviour:
        between = Timer("load", 2.0) if self.agent == "a" else Walk("knock", 1)
        return Sequence("deliver", memory=True, children=[Walk("there", 4), between, Walk("back", 4)])


def test_a_tree_of_another_shape_begins_at_its_root_with_its_blackboard():
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"T": {"type": Changed, "rate_hz": 2}})
        b = fleet.start("b", classes={"T": Changed})
        fleet.connect()
        fleet.run_to(2.2)
        a.task("T").blackboard["goal"] = [1.5, None]
        assert a.ask(Migrate("T", to="b")).ok
        fleet.run_for(10.0)
        (line,) = b.lines("warning")
        assert "begins at its root" in line
        assert "its node 3 was Timer 'load' and is Walk 'knock'" in line
        assert steps_of(b) == [("there", n) for n in (1, 2, 3, 4)] + [("knock", 1)] + [
            ("back", n) for n in (1, 2, 3, 4)
        ]
        assert b.task("T").blackboard["goal"] == [1.5, None]


# The blackboard -----------------------------------------------------------------------------------------------------


class Note(TaskBehaviour):
    """Write the agent and the task on the blackboard, by a client of py_trees, and read them again."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.client = self.attach_blackboard_client()
        self.client.register_key("who", access=py_trees.common.Access.EXCLUSIVE_WRITE)

    def update(self) -> Status:
        self.client.who = self.task.address
        return Status.SUCCESS if self.client.who == self.task.address else Status.FAILURE


class Notes(TreeTask):
    def make_tree(self) -> py_trees.behaviour.Behaviour:
        return Note("note")

    def on_end(self, status: Status) -> None:
        assert status is Status.SUCCESS


def test_each_task_has_a_blackboard_of_its_own():
    before = dict(Blackboard.storage)
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"T": Notes, "U": Notes})
        b = fleet.start("b", tasks={"T": Notes})
        fleet.run_for(1.0)
        found = [it.blackboard["who"] for it in (a.task("T"), a.task("U"), b.task("T"))]
    assert found == ["a/client/T", "a/client/U", "b/client/T"]
    assert dict(Blackboard.storage) == before


def test_trees_that_threads_tick_at_once_do_not_share_a_blackboard():
    tasks = {name: {"type": Notes, "rate_hz": 500} for name in ("T", "U", "V")}
    with threaded_agent("a", tasks=tasks) as a:
        a.wait_until(lambda: all(row["ticks"] > 50 for row in a.tasks() if row["service"] == "client"))
        assert [a.task(name).blackboard["who"] for name in "TUV"] == [f"a/client/{name}" for name in "TUV"]


def test_a_program_that_clears_the_blackboard_of_py_trees_does_not_make_tasks_share_one(
    monkeypatch: pytest.MonkeyPatch,
):
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"T": Notes, "U": Notes})
        fleet.run_for(1.0)
        own = {"/mine": 1}
        for name, table in (("storage", own), ("metadata", {}), ("clients", {})):
            monkeypatch.setattr(Blackboard, name, table)
        fleet.run_for(1.0)
        found = [a.task(name).blackboard["who"] for name in "TU"]
        assert found == ["a/client/T", "a/client/U"]
        assert dict(Blackboard.storage) == own == {"/mine": 1}
        assert not a.events("task_failed")


class Hears(TreeTask):
    """Keeps what it hears on the blackboard."""

    value: ClassVar[Any] = None

    def make_tree(self) -> py_trees.behaviour.Behaviour:
        return py_trees.behaviours.Running("on")

    @on(SYSTEM)
    def heard(self, goal: Goal) -> None:
        self.blackboard["goal"] = goal.steps
        if goal.steps < 0:
            self.blackboard["bad"] = [{"deep": type(self).value}]


def test_what_a_handler_writes_on_the_blackboard_moves():
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"T": {"type": Hears, "rate_hz": 0}})
        b = fleet.start("b", classes={"T": Hears})
        fleet.connect()
        a.publish(SYSTEM, Goal(7))
        fleet.run_for(1.0)
        assert a.ask(Migrate("T", to="b")).ok
        assert dict(b.task("T").blackboard) == {"goal": 7}
        del b.task("T").blackboard["goal"]
        assert b.task("T").state.blackboard == {}


@pytest.mark.parametrize("value", [Goal(1), {1: 2}, {2}, 2**70, [[[[1]]]], b"x", Step, 1j])
def test_what_cannot_travel_is_refused_with_the_name_of_the_key(value: Any):
    cls = type("Hears", (Hears,), {"value": value})
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"T": {"type": cls, "restart": {"policy": "no"}}})
        a.publish(SYSTEM, Goal(-1))
        fleet.run_for(1.0)
        (news,) = a.events("task_failed")
        assert "the value of the blackboard key 'bad' of T " in news["error"]


def test_a_status_on_the_blackboard_moves_as_one():
    _, b, fleet = moved(type("Watched", (Watched,), {"kind": "status"}), 1.2, 1.4)
    with fleet:
        assert b.task("T").blackboard["result"] is Status.SUCCESS


class Grows(TreeTask):
    """Changes a list on its blackboard in place."""

    add: ClassVar[Any] = 1

    def make_tree(self) -> py_trees.behaviour.Behaviour:
        self.blackboard.setdefault("list", [])
        return py_trees.behaviours.Running("on")

    @every(hz=2)
    def grow(self, tick: Tick) -> None:
        self.blackboard["list"].append(type(self).add)


def test_a_value_that_was_changed_in_place_moves_and_is_checked_at_the_next_tick():
    _, b, fleet = moved(Grows, 1.7, 3.2)
    with fleet:
        assert b.task("T").blackboard["list"] == [1] * 6
    bad = type("Grows", (Grows,), {"add": Goal(1)})
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"T": {"type": bad, "restart": {"policy": "no"}}})
        fleet.run_for(2.0)
        (news,) = a.events("task_failed")
        assert "'list'" in news["error"]


# The life of behaviours ---------------------------------------------------------------------------------------------


class Told(TaskBehaviour):
    """Notes which of its methods are called."""

    def setup(self, **kwargs: Any) -> None:
        CALLS.append(f"setup on {self.task.agent}")

    def initialise(self) -> None:
        CALLS.append("initialise")

    def update(self) -> Status:
        return Status.RUNNING

    def terminate(self, new_status: Status) -> None:
        CALLS.append("terminate")

    def shutdown(self) -> None:
        CALLS.append(f"shutdown on {self.task.agent}")


class Tells(TreeTask):
    def make_tree(self) -> py_trees.behaviour.Behaviour:
        return Told("told")


def test_a_running_behaviour_is_set_up_where_it_arrives_and_neither_begun_again_nor_interrupted():
    CALLS.clear()
    _, b, fleet = moved(Tells, 1.2, 3.0)
    with fleet:
        assert sorted(CALLS) == ["initialise", "setup on a", "setup on b", "shutdown on a"]
        assert b.ask(Stop("T")).ok
    assert CALLS[-1] == "shutdown on b"
    assert "terminate" not in CALLS


class Hasty(Deliver):
    """Forgets to call `on_start` of `TreeTask`."""

    def on_start(self) -> None:
        self.began = True


def test_a_class_with_an_on_start_of_its_own_goes_on_as_well():
    a, b, fleet = moved(Hasty, 1.2, 12.0)
    with fleet:
        assert steps_of(a) + steps_of(b) == ALL_STEPS


@dataclass
class Wanted:
    steps: int = 3


@dataclass
class Mine(TreeState):
    ends: int = 0


class Typed(TreeTask[Wanted, Mine]):
    def make_tree(self) -> py_trees.behaviour.Behaviour:
        return Walk("walk", self.settings.steps)

    def on_end(self, status: Status) -> None:
        self.state.ends += 1


def test_settings_and_state_may_stand_in_brackets():
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"T": {"type": Typed, "rate_hz": 2}})
        fleet.run_to(3.2)
        assert (a.task("T").settings, a.task("T").state.ends) == (Wanted(3), 2)


# Requests -----------------------------------------------------------------------------------------------------------


@packet_type("trees_in_test.how_far")
class HowFar(Request[int], frozen=True):
    """How far is it?"""


class Knows(Task):
    @answers(HowFar)
    def how_far(self, request: HowFar) -> int:
        return 3


class AskFirst(TaskBehaviour):
    """Ask, and wait for the answer on the blackboard."""

    task: "Asks"

    def initialise(self) -> None:
        self.task.ask("task:a/Knows", HowFar(), then=self.task.found)

    def update(self) -> Status:
        return Status.SUCCESS if "metres" in self.task.blackboard else Status.RUNNING


class Asks(TreeTask):
    def make_tree(self) -> py_trees.behaviour.Behaviour:
        return Sequence("asks", memory=True, children=[AskFirst("ask"), Walk("go", 2)])

    def found(self, answer: Answer[int]) -> None:
        self.blackboard["metres"] = answer.result()

    def on_end(self, status: Status) -> None:
        self.reschedule(0.0, "tick_tree")


@pytest.mark.parametrize("at_s", [0.52, 1.2, 2.2])
def test_a_behaviour_gets_the_answer_to_what_it_asked_also_if_its_task_moves(at_s: float):
    with Fleet() as fleet:
        a = fleet.start("a", tasks={"Knows": Knows, "T": {"type": Asks, "rate_hz": 2}})
        b = fleet.start("b", classes={"T": Asks})
        fleet.connect()
        fleet.run_to(at_s)
        assert a.ask(Migrate("T", to="b")).ok
        fleet.run_to(6.0)
        assert steps_of(a) + steps_of(b) == [("go", 1), ("go", 2)]
        assert b.task("T").blackboard["metres"] == 3
