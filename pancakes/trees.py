"""Behaviour trees as tasks (extra `trees`): a py_trees tree that migrates with the status of its nodes.

    class Deliver(TreeTask):
        @on(SYSTEM, queue="latest")
        def located(self, pose: Pose) -> None:
            self.blackboard["x_m"] = pose.x_m

        def make_tree(self) -> py_trees.behaviour.Behaviour:
            steps = [Drive("To the shelf", 4.0), Timer("Load", 5.0), Drive("To the door", 0.0)]
            return py_trees.composites.Sequence("Deliver", memory=True, children=steps)

A `TreeTask` ticks its tree at the rate of its timer `tick_tree`, in mission time. After each tick it writes into its
state what the tree remembers: the status of each node, the child that each composite is at, the attributes that a
behaviour `keeps`, and the blackboard. With that the tree goes on after a migration, a take-over or a restart.

Each task has a blackboard of its own. py_trees has one for the whole process; importing this module makes it the one of
the task whose tree is being ticked, and outside of trees it stays what it was.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, MutableMapping
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any, ClassVar, Final, Generic, Literal, cast

import msgspec

from pancakes.errors import ClassError, PancakesError, needing_extra
from pancakes.task import SettingsT, StateT, Task, Tick, every
from pancakes.util.class_checks import check_own_names

with needing_extra("there are no behaviour trees"):
    import py_trees
    from py_trees.common import Status

__all__ = ["TaskBehaviour", "Timeout", "Timer", "TreeError", "TreeNode", "TreeState", "TreeTask"]

_Leaf = bool | int | float | str | None
_Plain1 = _Leaf | list[_Leaf] | dict[str, _Leaf]
_Plain2 = _Leaf | list[_Plain1] | dict[str, _Plain1]
_Plain3 = _Leaf | list[_Plain2] | dict[str, _Plain2]
_Plain = _Leaf | list[_Plain3] | dict[str, _Plain3]
DEEPEST: Final = 4
"""How deep lists and mappings on a blackboard may be nested."""
_STATUS: Final = "py_trees.Status"
"""A mapping with only this key stands for a `Status` in what is saved."""


class TreeError(PancakesError):
    """A behaviour tree cannot go on: what it remembers cannot travel."""

    code = "invalid"


# What is saved ---------------------------------------------------------------------------------------------------


class TreeNode(msgspec.Struct):
    """What is saved of one node of a tree.

    Attributes:
        name: its name.
        kind: the name of its class.
        depth: how many nodes are above it.
        status: `INVALID` (not ticked, or interrupted), `RUNNING`, `SUCCESS` or `FAILURE`.
        message: its feedback message.
        child: index of the child that a composite is at; -1: it is at none.
        kept: the attributes that it keeps, by name.
    """

    name: str
    kind: str
    depth: int
    status: Literal["INVALID", "RUNNING", "SUCCESS", "FAILURE"] = "INVALID"
    message: str = ""
    child: int = -1
    kept: dict[str, _Plain] = {}


@dataclass
class TreeState:
    """The state of a `TreeTask`. A state of your own derives from it.

    Attributes:
        nodes: the nodes of the tree, each before its children, as of the last tick.
        blackboard: the blackboard, by absolute key.
    """

    nodes: list[TreeNode] = field(default_factory=list)
    blackboard: dict[str, _Plain] = field(default_factory=dict)


def _saved(value: Any, what: str, inside: int = 0, status_below: int = DEEPEST) -> Any:
    """Return a value of a blackboard or a node as it is saved.

    Args:
        value: the value.
        what: names it in an error.
        inside: in how many lists and mappings it is.
        status_below: in how many a `Status` may be.

    Raises:
        TreeError: it cannot travel.
    """
    kind = type(value)
    if value is None or kind in (bool, float, str):
        return value
    if kind is int:
        if -(2**63) <= value < 2**64:
            return value
        raise TreeError(f"{what} is an integer beyond 64 bits, which cannot travel")
    if kind is Status and inside <= status_below:
        return {_STATUS: value.name}
    if kind not in (list, tuple, dict):
        raise TreeError(
            f"{what} is of the class {kind.__name__}, which cannot travel: write numbers, strings, booleans, None, and"
            " lists and mappings of these"
        )
    if inside == DEEPEST:
        raise TreeError(f"{what} is nested more than {DEEPEST} deep, which cannot travel")
    if kind is not dict:
        return [_saved(item, what, inside + 1, status_below) for item in value]
    for key in value:
        if type(key) is not str:
            raise TreeError(f"{what} has the key {key!r}, which cannot travel: keys are strings")
    return {key: _saved(item, what, inside + 1, status_below) for key, item in value.items()}


def _given_back(value: Any) -> Any:
    """Return a value that `_saved` wrote as it was; a tuple comes back as a list."""
    if isinstance(value, list):
        return [_given_back(item) for item in value]
    if not isinstance(value, dict):
        return value
    if list(value) == [_STATUS] and value[_STATUS] in Status.__members__:
        return Status[value[_STATUS]]
    return {key: _given_back(item) for key, item in value.items()}


# The blackboard --------------------------------------------------------------------------------------------------


class _Board(MutableMapping[str, Any]):
    """The blackboard of one task: its values, and who registered which key.

    The values are those in the task's state, so what is changed in place is saved as well. They are checked when they
    are written, and after each tick.

    Args:
        task: the task.
    """

    def __init__(self, task: TreeTask[Any, Any]) -> None:
        self._task = task
        self.storage = _Values(task)
        self.metadata: dict[str, Any] = {}
        self.clients: dict[Any, Any] = {}

    def __getitem__(self, key: str) -> Any:
        return self.storage[_absolute(key)]

    def __setitem__(self, key: str, value: Any) -> None:
        self.storage[_absolute(key)] = value

    def __delitem__(self, key: str) -> None:
        del self.storage[_absolute(key)]

    def __iter__(self) -> Iterator[str]:
        return (key.lstrip("/") for key in self.storage)

    def __len__(self) -> int:
        return len(self.storage)

    def __repr__(self) -> str:
        return f"<blackboard {dict(self)!r}>"


class _Values(MutableMapping[str, Any]):
    """The values of a task's blackboard by absolute key, as py_trees reads and writes them."""

    def __init__(self, task: TreeTask[Any, Any]) -> None:
        self._task = task

    @property
    def _kept(self) -> dict[str, Any]:
        kept: dict[str, Any] = self._task.state.blackboard
        return kept

    def __getitem__(self, key: str) -> Any:
        value = self._kept[key]
        return _given_back(value) if isinstance(value, dict) and _STATUS in value else value

    def __setitem__(self, key: str, value: Any) -> None:
        saved = self._checked(key, value)
        self._kept[key] = saved if isinstance(value, Status) else value

    def __delitem__(self, key: str) -> None:
        del self._kept[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._kept)

    def __len__(self) -> int:
        return len(self._kept)

    def check(self) -> None:
        """Raise `TreeError` if a value, which may have been changed in place, cannot travel."""
        for key, value in self._kept.items():
            self._checked(key, value)

    def _checked(self, key: str, value: Any) -> Any:
        what = f"the value of the blackboard key {key.lstrip('/')!r} of {self._task.name}"
        return _saved(value, what, status_below=0)


def _absolute(key: str) -> str:
    return key if key.startswith("/") else f"/{key}"


_BOARD: Final[ContextVar[_Board | None]] = ContextVar("pancakes.trees.board", default=None)


class _Shared(MutableMapping[Any, Any]):
    """One of the tables of py_trees' blackboard: that of the task whose tree is ticked; elsewhere the process's."""

    def __init__(self, name: str, outside: dict[Any, Any]) -> None:
        self._name = name
        self._outside = outside

    def _table(self) -> MutableMapping[Any, Any]:
        board = _BOARD.get()
        table: MutableMapping[Any, Any] = self._outside if board is None else getattr(board, self._name)
        return table

    def __getitem__(self, key: Any) -> Any:
        return self._table()[key]

    def __setitem__(self, key: Any, value: Any) -> None:
        self._table()[key] = value

    def __delitem__(self, key: Any) -> None:
        del self._table()[key]

    def __iter__(self) -> Iterator[Any]:
        return iter(self._table())

    def __len__(self) -> int:
        return len(self._table())


def _share() -> None:
    """Give py_trees' blackboard tables that know whose tree is ticked. Two tasks may be ticked by two threads."""
    blackboard: Any = py_trees.blackboard.Blackboard
    for name in ("storage", "metadata", "clients"):
        if not isinstance(getattr(blackboard, name), _Shared):
            setattr(blackboard, name, _Shared(name, getattr(blackboard, name)))


_share()


@contextmanager
def _on(board: _Board) -> Iterator[None]:
    _share()  # a program with trees of its own may have given py_trees other tables, to clear them
    token = _BOARD.set(board)
    try:
        yield
    finally:
        _BOARD.reset(token)


# Nodes -----------------------------------------------------------------------------------------------------------


class TaskBehaviour(py_trees.behaviour.Behaviour):
    """The base of behaviours that belong to a `TreeTask`.

    `initialise` is not called again after a migration while the behaviour is running: what it needs then is in `keeps`
    or on the blackboard, and what cannot travel (a client, a file) is made in `setup`, which runs on each agent before
    the attributes are given back.

    Attributes:
        keeps: the names of the attributes that travel; `__init__` sets each of them.
        task: the task, once its tree is made; not in `__init__`. Behaviours of py_trees have it as well.
    """

    keeps: ClassVar[tuple[str, ...]] = ()
    task: TreeTask[Any, Any]


class Timer(TaskBehaviour):
    """Run for a time, then succeed: py_trees' `Timer` by the mission clock.

    Args:
        name: its name.
        duration_s: how long, in seconds of mission time.
    """

    keeps: ClassVar[tuple[str, ...]] = ("until_s", "seen_s")

    def __init__(self, name: str, duration_s: float) -> None:
        super().__init__(name)
        self.duration_s = duration_s
        self.until_s = self.seen_s = 0.0

    def initialise(self) -> None:
        """Begin to count."""
        _begin(self)

    def update(self) -> Status:
        """Return whether the time is up."""
        return Status.SUCCESS if _is_over(self) else Status.RUNNING


class Timeout(py_trees.decorators.Decorator):
    """Fail if a child is still running after a time: py_trees' `Timeout` by the mission clock.

    Args:
        name: its name.
        child: the child.
        duration_s: how long it may run, in seconds of mission time.
    """

    keeps: ClassVar[tuple[str, ...]] = ("until_s", "seen_s")
    task: TreeTask[Any, Any]

    def __init__(self, name: str, child: py_trees.behaviour.Behaviour, duration_s: float) -> None:
        super().__init__(name=name, child=child)
        self.duration_s = duration_s
        self.until_s = self.seen_s = 0.0

    def initialise(self) -> None:
        """Begin to count."""
        _begin(self)
        self.feedback_message = ""

    def update(self) -> Status:
        """Return the child's status, or failure if the time is up and it is still running."""
        if _is_over(self) and self.decorated.status is Status.RUNNING:
            self.feedback_message = "timed out"
            return Status.FAILURE
        return self.decorated.status


def _begin(timer: Timer | Timeout) -> None:
    timer.seen_s = timer.task.now()
    timer.until_s = timer.seen_s + timer.duration_s


def _is_over(timer: Timer | Timeout) -> bool:
    """Return whether the time is up. If the mission has started again since the last look, the rest remains."""
    before_s, timer.seen_s = timer.seen_s, timer.task.now()
    if timer.seen_s < before_s:
        timer.until_s += timer.seen_s - before_s
    return timer.seen_s >= timer.until_s


_KEPT: Final[Mapping[tuple[str, str], tuple[str, ...]]] = {
    ("behaviours", "Periodic"): ("count", "response"),
    ("behaviours", "StatusQueue"): ("current_queue",),
    ("behaviours", "SuccessEveryN"): ("count",),
    ("behaviours", "TickCounter"): ("counter",),
    ("decorators", "Count"): (
        *("total_tick_count", "failure_count", "success_count"),
        *("running_count", "interrupt_count"),
    ),
    ("decorators", "OneShot"): ("final_status",),
    ("decorators", "Repeat"): ("success",),
    ("decorators", "Retry"): ("failures",),
}
"""What the nodes of py_trees remember from one tick to the next, by module and class."""
_REFUSED: Final[Mapping[tuple[str, str], str]] = {
    ("timers", "Timer"): "counts by the clock of its machine: use pancakes.trees.Timer",
    ("decorators", "Timeout"): "counts by the clock of its machine: use pancakes.trees.Timeout",
    ("decorators", "ForEach"): "cannot go on in the middle of its items: keep the index on the blackboard",
    ("behaviours", "ProbabilisticBehaviour"): (
        "draws from a generator that no seed sets: write a behaviour that draws from self.task.random"
    ),
}
"""The nodes of py_trees that do not carry over, and what to use in their place."""


def _key(cls: type) -> tuple[str, str]:
    package, _, module = cls.__module__.rpartition(".")
    return (module, cls.__name__) if package == "py_trees" else ("", "")


def _keeps(cls: type) -> tuple[str, ...]:
    """Return the attributes that nodes of a class keep, with those of its bases."""
    names = [name for part in cls.__mro__ for name in (*vars(part).get("keeps", ()), *_KEPT.get(_key(part), ()))]
    return tuple(dict.fromkeys(names))


_Shape = list[tuple[str, str, int]]
_RANDOM: Final = re.compile(r"[0-9a-f]{8}([-_][0-9a-f]{4}){3}[-_][0-9a-f]{12}")
"""A UUID: py_trees makes names and keys of some."""


class _Tree:
    """The nodes of a tree in the order in which they are saved, each before its children.

    Raises:
        ClassError: the tree cannot be saved, or one of its nodes does not carry over; it names the node.
    """

    def __init__(self, root: py_trees.behaviour.Behaviour, task: TreeTask[Any, Any]) -> None:
        self.root = root
        self.nodes: list[tuple[py_trees.behaviour.Behaviour, int, tuple[str, ...]]] = []
        self._owner = type(task).__qualname__
        self._seen: set[int] = set()
        self._add(root, ())
        for node, _, _ in self.nodes:
            node.task = task

    def _add(self, node: py_trees.behaviour.Behaviour, above: tuple[str, ...]) -> None:
        path = (*above, node.name)
        head = f"the tree of {self._owner}: {' > '.join(path)}"
        if id(node) in self._seen:
            raise ClassError(f"{head} is in the tree twice: make a node for each place")
        self._seen.add(id(node))
        if vars(node).get("task") is not None:
            raise ClassError(f"{head} has a task already: make_tree makes new nodes each time")
        for part in type(node).__mro__:
            if fault := _REFUSED.get(_key(part)):
                raise ClassError(f"{head} is a {part.__name__} of py_trees, which {fault}")
        self._check_keeps(node, head)
        self.nodes.append((node, len(above), _keeps(type(node))))
        if _RANDOM.search(node.name):
            raise ClassError(f"{head} has a random part in its name, which differs on each agent: give it another name")
        seen: list[_Shape] = []
        for child in node.children:
            begins = len(self.nodes)
            self._add(child, path)
            shape = self.shape(begins)
            if shape in seen:
                raise ClassError(
                    f"{head} has two children named {child.name!r} that cannot be told apart: give each another name"
                )
            seen.append(shape)

    def _check_keeps(self, node: py_trees.behaviour.Behaviour, head: str) -> None:
        given = getattr(type(node), "keeps", ())
        if isinstance(given, str) or not all(isinstance(name, str) for name in given):
            raise ClassError(f"{head}: {type(node).__name__}.keeps is {given!r}, and no tuple of names")
        for name in _keeps(type(node)):
            if not hasattr(node, name):
                raise ClassError(f"{head}: {type(node).__name__}.keeps names {name!r}, which its __init__ does not set")

    def shape(self, begins: int = 0) -> _Shape:
        """Return name, class and depth of each node from one on."""
        return [(node.name, type(node).__name__, depth) for node, depth, _ in self.nodes[begins:]]

    def capture(self) -> list[TreeNode]:
        """Return what the nodes remember.

        Raises:
            TreeError: an attribute that a node keeps cannot travel.
            ClassError: nodes were added or removed since the tree was made.
        """
        if [id(node) for node in _walk(self.root)] != [id(node) for node, _, _ in self.nodes]:
            raise ClassError(
                f"the tree of {self._owner} has changed since it was made: let `make_tree` make all of its nodes, and"
                " let conditions choose between them"
            )
        return [
            TreeNode(
                node.name,
                type(node).__name__,
                depth,
                node.status.name,
                str(node.feedback_message),
                self._index(node),
                {name: _saved(getattr(node, name), f"{name!r} of the node {node.name!r}") for name in keeps},
            )
            for node, depth, keeps in self.nodes
        ]

    @staticmethod
    def _index(node: py_trees.behaviour.Behaviour) -> int:
        child = getattr(node, "current_child", None)
        return node.children.index(child) if child is not None else -1

    def restore(self, saved: list[TreeNode]) -> None:
        """Give the nodes what was saved of a tree of the same shape."""
        for (node, _, keeps), row in zip(self.nodes, saved, strict=True):
            node.status = Status[row.status]
            node.feedback_message = row.message
            if hasattr(node, "current_child"):
                node.current_child = node.children[row.child] if 0 <= row.child < len(node.children) else None
            for name in keeps:
                if name in row.kept:
                    setattr(node, name, _given_back(row.kept[name]))


def _walk(node: py_trees.behaviour.Behaviour) -> Iterator[py_trees.behaviour.Behaviour]:
    yield node
    for child in node.children:
        yield from _walk(child)


def _difference(saved: _Shape, here: _Shape) -> str:
    """Return the first difference between the shapes of two trees, as a phrase; empty: there is none."""
    if saved == here:
        return ""
    at = next(
        (i for i, (old, new) in enumerate(zip(saved, here, strict=False)) if old != new), min(len(saved), len(here))
    )
    old, new = ("nothing" if at >= len(it) else f"{it[at][1]} {it[at][0]!r}" for it in (saved, here))
    return f"its node {at + 1} was {old} and is {new}"


# The task --------------------------------------------------------------------------------------------------------

_HOOKS: Final = ("make_tree", "on_end", "tick_tree")


class TreeTask(Task[SettingsT, StateT], Generic[SettingsT, StateT]):
    """A task that ticks a behaviour tree of py_trees.

    Its timer `tick_tree` runs at 10 Hz, unless its table has another `rate_hz`. A class that has an `on_start` or
    `on_stop` of its own calls that of `TreeTask` in it.
    """

    State: ClassVar[type] = TreeState
    _tree: _Tree | None = None
    _set_up: tuple[py_trees.behaviour.Behaviour, ...] = ()
    _own_board: _Board | None = None

    def __init_subclass__(cls, **others: Any) -> None:
        """Raise `ClassError` if the class cannot work, as `Task` does, or its state is no `TreeState`."""
        super().__init_subclass__(**others)  # which checks the names of `Task`
        check_own_names(cls, TreeTask, {*dir(Task), *_HOOKS})
        if not issubclass(cls.State, TreeState):
            raise ClassError(f"{cls.__qualname__}.State is no TreeState: write `class State(TreeState):`")

    def make_tree(self) -> py_trees.behaviour.Behaviour:
        """Return the root of the tree. Called once in each actor; it may read the settings and the blackboard."""
        raise ClassError(f"{type(self).__qualname__} has no make_tree, which returns the root of its tree")

    def on_end(self, status: Status) -> None:
        """Called after a tick in which the root succeeded or failed; the next tick begins the tree again."""

    @property
    def blackboard(self) -> MutableMapping[str, Any]:
        """The blackboard of this task, by key, for methods outside of its tree. In the actor.

        Raises:
            TreeError: a value that is written cannot travel.
        """
        return self._board()

    @property
    def tree(self) -> py_trees.behaviour.Behaviour:
        """The root of the tree. In the actor."""
        return self._made().root

    def on_start(self) -> None:
        """Make the tree, and let it go on where it was."""
        self._made()

    def on_stop(self) -> None:
        """Call `shutdown` of each node. Running nodes are not interrupted: the tree goes on from its state."""
        self._shut_down()

    def on_failure(
        self,
        exception_type: type[BaseException] | None,
        exception_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Call `shutdown` of each node, as `on_stop` does."""
        super().on_failure(exception_type, exception_value, traceback)
        self._shut_down()

    def _shut_down(self) -> None:
        nodes, self._set_up = self._set_up, ()
        with _on(self._board()), ExitStack() as stack:  # all of them, also if one fails
            for node in nodes:
                stack.callback(node.shutdown)

    @every(hz=10)
    def tick_tree(self, tick: Tick) -> None:
        """Tick the tree once, and write what it remembers into the state."""
        tree = self._made()
        board = self._board()
        with _on(board):
            tree.root.tick_once()
        self._kept.nodes = tree.capture()
        board.storage.check()
        if tree.root.status in (Status.SUCCESS, Status.FAILURE):
            self.on_end(tree.root.status)

    @property
    def _kept(self) -> TreeState:
        return cast(TreeState, self.state)

    def _board(self) -> _Board:
        if self._own_board is None:
            self._own_board = _Board(self)
        return self._own_board

    def _made(self) -> _Tree:
        if self._tree is None:
            with _on(self._board()):
                root = self.make_tree()
                if not isinstance(root, py_trees.behaviour.Behaviour):
                    raise ClassError(
                        f"{type(self).__qualname__}.make_tree returned a {type(root).__name__}, and no behaviour:"
                        " return the root of the tree"
                    )
                tree = _Tree(root, self)
                for key in self._board().metadata:
                    if _RANDOM.search(key):
                        raise ClassError(
                            f"the tree of {type(self).__qualname__} uses the blackboard key {key!r}, which has a random"
                            " part and differs on each agent: name the key, or give `either_or` a namespace"
                        )
                for node, _, _ in tree.nodes:
                    node.setup()  # some nodes begin from scratch in it
                    self._set_up = (node, *self._set_up)
                self._go_on(tree)
            self._tree = tree
        return self._tree

    def _go_on(self, tree: _Tree) -> None:
        """Let a new tree go on where the saved one was, if it has the same shape."""
        saved = self._kept.nodes
        if not saved:
            self._kept.nodes = tree.capture()
        elif why := _difference([(row.name, row.kind, row.depth) for row in saved], tree.shape()):
            self.log.warning(f"the tree of {self.name} begins at its root, with its blackboard: {why}")
            self._kept.nodes = tree.capture()
        else:
            tree.restore(saved)
