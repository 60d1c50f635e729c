"""numpy arrays in the settings and state of tasks: they keep their dtype and shape wherever a task goes."""

import sys
import types
from dataclasses import dataclass, field

import msgspec
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from pancakes.config import parse
from pancakes.config.effective import effective
from pancakes.control import Configure, Describe, Migrate, Restart, Start, Stop
from pancakes.devices import Load, Pose
from pancakes.errors import ClassError, ConfigError
from pancakes.task import Task, every, on
from pancakes.testing import registered
from pancakes.util.arrays import is_array, is_array_type, is_number, is_number_type


def gains():
    return np.ones(2)


class Map(Task):
    """Marks where it is in a grid, weighs, and tells the sum."""

    @dataclass
    class Settings:
        gains: np.ndarray = field(default_factory=gains)
        kernel: NDArray[np.float32] | None = None
        steps: dict[str, NDArray[np.int16]] = field(default_factory=dict)

        def __post_init__(self):
            if self.gains.ndim != 1:
                raise ValueError("gains must be one row")

    @dataclass
    class State:
        grid: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((3, 4), np.uint8))
        images: list[np.ndarray] = field(default_factory=list)
        sums: dict[int, float] = field(default_factory=dict)
        count: int = 0

    @on("system", Pose)
    def pose(self, packet):
        self.state.grid[1, 2] += 1
        self.state.images.append(np.full((2, 1), packet.body.x_m, ">f4"))
        self.state.sums[3] = self.state.grid.sum()
        self.state.count = self.state.grid.sum()  # numpy's own integer
        self.publish("system", Load(float(self.settings.gains.sum() * self.state.grid.sum())))

    @every(hz=10)
    def tick(self, tick):
        pass


def check_grid(state, count):
    assert (state.grid.dtype, state.grid.shape, int(state.grid[1, 2])) == (np.uint8, (3, 4), count)
    assert [(image.dtype.str, image.shape) for image in state.images] == [(">f4", (2, 1))] * count
    assert state.sums == {3: float(count)}
    assert state.count == count


def mark(fleet, agent, count=1):
    for _ in range(count):
        agent.publish("system", Pose(2.5, 0.0, 0.0))
    fleet.run_for(0.2)


def test_a_state_with_arrays_comes_back_after_a_crash_and_can_be_changed_again(fleet):
    agent = fleet.start("a", tasks={"Map": Map})
    mark(fleet, agent, 3)
    fleet.run_for(2.0)
    fleet.crash("a")
    again = fleet.restart("a")
    check_grid(again.task("Map").state, 3)
    mark(fleet, again)
    check_grid(again.task("Map").state, 4)
    assert again.lines("error") == []


def test_a_task_with_arrays_moves_with_all_it_has(fleet):
    a = fleet.start("a", tasks={"Map": {"type": Map, "settings": {"gains": [1, 2.5], "kernel": [[1, 2], [3, 4]]}}})
    b = fleet.start("b")
    mark(fleet, a, 2)
    moved = a.ask(Migrate("client/Map", to="b"))
    assert moved.ok, moved.reason
    task = b.task("Map")
    check_grid(task.state, 2)
    assert_array_equal(task.settings.gains, [1.0, 2.5])
    assert (task.settings.kernel.dtype, task.settings.kernel.shape) == (np.float32, (2, 2))
    mark(fleet, b)
    check_grid(task.state, 3)


def test_a_checkpoint_is_written_where_an_array_has_changed_in_place(fleet):
    agent = fleet.start("a", tasks={"Map": Map})
    fleet.run_for(2.5)
    agent.task("Map").state.grid[0, 0] = 7
    fleet.run_for(2.5)
    fleet.crash("a")
    assert fleet.restart("a").task("Map").state.grid[0, 0] == 7


@pytest.mark.parametrize("asker", ["a", "b"])
def test_a_description_has_the_arrays_here_and_on_another_agent(fleet, asker):
    agents = {"a": fleet.start("a", tasks={"Map": Map}), "b": fleet.start("b")}
    mark(fleet, agents["a"])
    told = agents[asker].ask(Describe("client/Map", state=True), "a")
    assert told.ok, told.reason
    grid, before = told.result["state"]["grid"], told.result["settings"]["gains"]
    assert (grid.dtype, grid.shape, grid[1, 2]) == (np.uint8, (3, 4), 1)
    assert before.dtype == np.float64
    mark(fleet, agents["a"])
    assert grid[1, 2] == 1, "what was told is as it was then"
    assert told.result["settings_schema"]["properties"]["gains"]["type"] == "array"


@pytest.mark.parametrize("asker", ["a", "b"])
@pytest.mark.parametrize("value", [[3, 4.5], np.array([3.0, 4.5])])
def test_settings_are_changed_by_lists_and_by_arrays(fleet, asker, value):
    agents = {"a": fleet.start("a", tasks={"Map": Map}), "b": fleet.start("b")}
    fleet.run_for(0.2)
    told = agents[asker].ask(Configure("client/Map", {"gains": value}), "a")
    assert told.ok, told.reason
    assert_array_equal(agents["a"].task("Map").settings.gains, np.array([3.0, 4.5]), strict=True)
    told = agents[asker].ask(Configure("client/Map", {"steps": {"x": [1, 2]}}), "a")
    assert told.ok, told.reason
    assert_array_equal(agents["a"].task("Map").settings.steps["x"], np.array([1, 2], np.int16), strict=True)
    fleet.run_for(1.5)
    fleet.crash("a")
    assert_array_equal(fleet.restart("a").task("Map").settings.gains, [3.0, 4.5])


BAD = [
    ({"gains": "far"}, "gains: expected a list of numbers"),
    ({"gains": 3}, "gains: expected a list of numbers"),
    ({"gains": [1, "two"]}, "gains: expected a list of numbers"),
    ({"gains": [1, True]}, "gains: expected a list of numbers"),
    ({"gains": [[1, 2], [3]]}, "gains: expected lists of the same length"),
    ({"gains": [1.0, float("nan")]}, "gains[1]: is not a number (nan)"),
    ({"gains": np.array([np.inf])}, "gains: has a number in it that is nan or not finite"),
    ({"gains": np.array(["a"])}, "gains: expected an array of numbers or booleans"),
    ({"gains": [[1, 2], [3, 4]]}, "gains must be one row"),
    ({"kernel": [True, False]}, "kernel: expected a list of numbers"),
    ({"kernel": [1e300]}, "kernel: has a number that float32 cannot represent"),
    ({"kernel": np.array([1 + 2j])}, "kernel: expected an array of float32, not of complex128"),
    ({"steps": {"x": [1.5]}}, "steps.x: expected whole numbers"),
    ({"steps": {"x": [70_000]}}, "steps.x: has a number that int16 cannot represent"),
    ({"steps": {"x": [2**70]}}, "steps.x: "),
]


@pytest.mark.parametrize(("settings", "said"), BAD)
def test_what_is_no_array_of_that_kind_is_refused_with_the_key(fleet, settings, said):
    agent = fleet.start("a", tasks={"Map": Map})
    reply = agent.ask(Configure("client/Map", settings))
    assert said in reply.reason
    assert_array_equal(agent.task("Map").settings.gains, [1.0, 1.0])


def test_a_configuration_has_lists_which_are_checked(fleet):
    text = 'schema = 1\n[agent]\nname = "a"\n[task.Map]\ntype = "test.Map"\nsettings = {{ gains = {} }}\n'
    plugins = registered({"test.Map": Map})
    config = parse(text.format("[1, 2]"), "a.toml", plugins=plugins)
    assert effective(config, plugins)["task"]["Map"]["settings"]["gains"] == [1.0, 2.0]
    with pytest.raises(ConfigError, match=r"a.toml:6: \[task.Map\] settings.gains: expected a list of numbers"):
        parse(text.format('["a"]'), "a.toml", plugins=plugins)


def test_a_list_that_the_file_changes_takes_the_place_of_what_was_set(fleet):
    fleet.start("a", tasks={"Map": {"type": Map, "settings": {"gains": [1.0, 2.0]}}})
    fleet.run_for(1.5)
    fleet.stop("a")
    agent = fleet.start("a", tasks={"Map": {"type": Map, "settings": {"gains": [5.0]}}})
    assert_array_equal(agent.task("Map").settings.gains, [5.0])


def test_settings_that_are_arrays_in_code_outlive_a_restart(fleet):
    tasks = {"Map": {"type": Map, "settings": {"gains": np.array([1.0, 2.0])}}}
    fleet.start("a", tasks=tasks)
    fleet.run_for(1.5)
    fleet.stop("a")
    agent = fleet.restart("a")
    assert_array_equal(agent.task("Map").settings.gains, [1.0, 2.0])
    assert agent.ask(Stop("client/Map")).ok
    assert agent.ask(Start("client/Map", {"gains": np.array([4.0])})).ok
    assert_array_equal(agent.task("Map").settings.gains, [4.0])
    assert agent.ask(Restart("client/Map")).ok
    assert_array_equal(agent.task("Map").settings.gains, [4.0])


def test_a_struct_with_arrays_does_as_well(fleet):
    class Sees(Task):
        class State(msgspec.Struct):
            seen: np.ndarray = msgspec.field(default_factory=lambda: np.zeros(3, bool))

        @on("system", Pose)
        def pose(self, packet):
            self.state.seen[1] = True

    agent = fleet.start("a", tasks={"Sees": Sees})
    mark(fleet, agent)
    fleet.stop("a")
    assert_array_equal(fleet.restart("a").task("Sees").state.seen, np.array([False, True, False]), strict=True)


def test_an_array_of_objects_in_a_state_is_named_and_the_task_ends_all_the_same(fleet):
    agent = fleet.start("a", tasks={"Map": Map})
    agent.task("Map").state.images.append(np.array([object()]))
    fleet.run_for(2.5)
    assert agent.ask(Stop("client/Map")).ok
    assert any("an array of object" in line for line in agent.lines("error"))


def test_while_numpy_is_imported_for_the_first_time_no_value_is_an_array(monkeypatch):
    """Another thread imports it; its module is there, and empty."""
    monkeypatch.setitem(sys.modules, "numpy", types.ModuleType("numpy"))
    assert not is_array(1.0) and not is_number(1.0) and not is_number_type(float) and not is_array_type(float)


def test_a_structure_must_not_share_an_array_among_all_tasks():
    with pytest.raises(ClassError, match="State.grid has an array as its default, which all tasks would share"):

        class Shared(Task):
            class State(msgspec.Struct):
                cells: int = 3
                grid: np.ndarray = np.zeros(3)
