"""Classes of tasks, services, drivers and costs that cannot work are refused when they are made."""

import importlib.util
import itertools
import sys
from dataclasses import dataclass

import pytest
from seeded import for_each

from pancakes.config import parse
from pancakes.devices import Load
from pancakes.errors import ClassError, ConfigError, PluginError
from pancakes.service import Service
from pancakes.task import Task, TaskSpec
from pancakes.util.plugins import Plugins

HEAD = """\
from __future__ import annotations
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Annotated, Any
import msgspec
import numpy as np
from numpy.typing import NDArray
from pancakes.devices.driver import Actuator, Sensor
from pancakes.filters.filter import Filter
from pancakes.migration import Cost
from pancakes.durable.client_service import ClientService
from pancakes.packet import packet_type
from pancakes.request import Pending, Request, answers
from pancakes.service import Service
from pancakes.task import Task, every, on, reliable
@packet_type("refusals.where")
class Where(Request[float], frozen=True):
    name: str
class Gripper: ...
"""


class ModuleOf:
    """Imports a module with a text that is given; it lies at `path`, another each time."""

    def __init__(self, folder):
        self._folder = folder
        self._count = 0

    def __call__(self, text):
        self._count += 1
        self.path = self._folder / f"robot_module{self._count}.py"
        self.path.write_text(HEAD + text)
        spec = importlib.util.spec_from_file_location("robot_module", self.path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules["robot_module"] = module
        spec.loader.exec_module(module)
        return module


@pytest.fixture
def module_of(tmp_path):
    yield ModuleOf(tmp_path)
    sys.modules.pop("robot_module", None)


def refusal(module_of, text):
    with pytest.raises(ClassError) as raised:
        module_of(text)
    return str(raised.value)


def line_of(text, part):
    lines = (HEAD + text).splitlines()
    return next(number for number, line in enumerate(lines, 1) if part in line)


METHODS = [
    ("Task", "@every(hz=1)\n    async def blink(self, tick):\n        yield", "def blink(self, tick: Tick) -> None"),
    ("Task", "@on('system')\n    async def seen(self): ...", "def seen(self, packet: Packet) -> None"),
    ("Task", "@on('system')\n    def seen(self, body, packet, more): ...", "def seen(self, packet: Packet) -> None"),
    ("Task", "@every(hz=1)\n    def blink(self): ...", "def blink(self, tick: Tick) -> None"),
    ("Task", "@every(hz=1)\n    def blink(self, tick, more): ...", "def blink(self, tick: Tick) -> None"),
    ("Task", "@every(hz=1)\n    def blink(self, tick, *, more): ...", "def blink(self, tick: Tick) -> None"),
    ("Task", "@every(hz=1)\n    def blink(self, tick):\n        yield tick", "def blink(self, tick: Tick) -> None"),
    ("Task", "@on('system')\n    def seen(): ...", "def seen(self, packet: Packet) -> None"),
    (
        "Task",
        "@on('system')\n    @on('ctrl', queue=3)\n    def seen(self): ...",
        "def seen(self, packet: Packet) -> None",
    ),
    ("Task", "@on('system')\n    @staticmethod\n    def seen(packet): ...", "def seen(self, packet: Packet) -> None"),
    ("Task", "@on('system')\n    @classmethod\n    def seen(cls, p): ...", "def seen(self, packet: Packet) -> None"),
    ("Service", "async def on_start(self): ...", "def on_start(self)"),
    ("Task", "def on_start(self, why): ...", "def on_start(self)"),
    ("Task", "def on_start(self):\n        yield", "def on_start(self)"),
    ("Task", "async def on_stop(self):\n        yield", "def on_stop(self)"),
    ("Task", "async def on_settings(self): ...", "def on_settings(self)"),
    ("Task", "def on_settings(self, settings): ...", "def on_settings(self)"),
    ("Service", "async def own_tasks(self): ...", "def own_tasks(self)"),
    ("Service", "def own_tasks(self, more): ...", "def own_tasks(self)"),
    ("Sensor", "type = 'pose'\n    async def read(self): ...", "def read(self)"),
    (
        "Actuator",
        "type = 'motors'\n    def write(self, command): ...",
        "def write(self, command, ttl_s, source)",
    ),
    ("Cost", "name = 'mine'\n    def terms(self): ...", "def terms(self, facts)"),
    ("Task", "@answers(Where)\n    def find(self): ...", "def find(self, request: Where)"),
    ("Task", "@answers(Where)\n    def find(self, request, pending, more): ...", "def find(self, request: Where)"),
    ("Task", "@answers(Where)\n    def find(self, request):\n        yield", "def find(self, request: Where)"),
    ("Task", "async def on_cancel(self, pending): ...", "def on_cancel(self, pending)"),
    ("Task", "def on_cancel(self): ...", "def on_cancel(self, pending)"),
]


def test_class_refusal_of_a_method_names_line_and_remedy(module_of):
    def check(case):
        base, method, instead = case
        text = f"class Robot({base}):\n    {method}\n"
        said = refusal(module_of, text)
        name = method.partition("def ")[2].partition("(")[0]
        assert said.startswith(f"{module_of.path}:{line_of(text, f'def {name}(')}: Robot.{name} ")
        assert f"write `{instead}`" in said

    for_each(METHODS, check)


MARKED = [
    ("Task", "@every(hz=1)\n    @every(hz=2)\n    def go(self, it): ...", "twice with @every"),
    ("Task", "@every(hz=1)\n    @on('system')\n    def go(self, it): ...", "both @on and @every"),
    ("Service", "@on('system')\n    @every(hz=1)\n    def go(self, it): ...", "both @on and @every"),
    ("Task", "@on('system')\n    @on('system')\n    def go(self, it): ...", "twice with @on('system')"),
    ("Task", "@answers(Where)\n    @on('system')\n    def go(self, it): ...", "@answers and with @on or @every"),
    ("Service", "@answers(Where)\n    def go(self, it): ...", "a service answers no requests"),
    ("Task", "@property\n    @answers(Where)\n    def go(self, it): ...", "leave @property out"),
    ("Task", "@on('system', 'pose')\n    @on('system')\n    def go(self, it): ...", "twice with @on('system')"),
    ("Task", "@every(hz=1)\n    def on_start(self, it=None): ...", "calls on_start itself"),
    ("Task", "@on('system')\n    def on_settings(self, it=None): ...", "calls on_settings itself"),
    ("Service", "@every(hz=1)\n    def on_stop(self, it=None): ...", "calls on_stop itself"),
    ("Task", "@property\n    @every(hz=1)\n    def go(self, it): ...", "leave @property out"),
    ("Task", "@classmethod\n    @on('system')\n    def go(self, it): ...", "leave @classmethod out"),
    ("Sensor", "type = 'pose'\n    @every(hz=1)\n    def go(self, it): ...", "Leave @every out"),
    ("Cost", "name = 'mine'\n    @on('system')\n    def go(self, it): ...", "Leave @on out"),
]


def test_a_mark_at_the_wrong_place_is_refused(module_of):
    def check(case):
        base, method, why = case
        text = f"class Robot({base}):\n    {method}\n"
        said = refusal(module_of, text)
        name = method.partition("def ")[2].partition("(")[0]
        assert said.startswith(f"{module_of.path}:{line_of(text, f'def {name}(')}: Robot.{name} is decorated ")
        assert why in said

    for_each(MARKED, check)


def test_a_method_may_listen_to_several_packets(module_of):
    module_of(
        "class R(Task):\n    @on('system', 'a')\n    @on('system', 'b')\n    @on('log')\n    def go(self, it): ...\n"
    )


@pytest.mark.parametrize("mark", ["on", "every"])
def test_a_mark_without_its_brackets_is_refused(module_of, mark):
    assert f"write @{mark}(" in refusal(module_of, f"class Robot(Task):\n    @{mark}\n    def go(self, it): ...\n")


FIELDS = [
    ("path: Path = Path('/tmp')", "write str"),
    ("paths: dict[str, list[Path]] = field(default_factory=dict)", "write str"),
    ("path: Path | str = ''", "write str"),
    ("what: Any = None", "say what it is"),
    ("what: object = None", "say what it is"),
    ("what: dict[str, Any] = field(default_factory=dict)", "say what it is"),
    ("what: list = field(default_factory=list)", "say what it is"),
    ("gripper: Gripper | None = None", "write a @dataclass"),
    ("then: Callable[[], None] | None = None", "write a @dataclass"),
    ("z: complex = 0", "write a @dataclass"),
    ("x: np.float64 = 0.0", "write float"),
    ("objects: NDArray[np.object_] | None = None", "write NDArray[np.float64]"),
    ("words: list[NDArray[np.str_]] = field(default_factory=list)", "write NDArray[np.float64]"),
    ("cells: dict[tuple[int, int], float] = field(default_factory=dict)", "write dict[str, ...]"),
    ("bounded: Annotated[str, msgspec.Meta(ge=0)] = ''", "cannot be checked when it is read again"),
    ("count: int = field(default=0, init=False)", "leave that out"),
]


def test_class_refusal_of_a_field_names_line_and_remedy(module_of):
    def check(case):
        (declared, instead), (base, name) = case
        text = f"class Robot({base}):\n    @dataclass\n    class {name}:\n        fine: int = 0\n        {declared}\n"
        said = refusal(module_of, text)
        assert said.startswith(
            f"{module_of.path}:{line_of(text, declared)}: Robot.{name}.{declared.partition(':')[0]} "
        )
        assert instead in said

    for_each(itertools.product(FIELDS, [("Task", "State"), ("Task", "Settings"), ("Service", "Settings")]), check)


def test_the_settings_of_a_driver_are_judged_as_well(module_of):
    text = """\
class Camera(Sensor):
    type = "pose"
    @dataclass
    class Settings:
        device: Path = Path("/dev/video0")
    def read(self): ...
"""
    assert f":{line_of(text, 'device:')}: Camera.Settings.device is a path" in refusal(module_of, text)


def test_a_field_of_a_class_that_is_used_inside_is_named_with_that_class(module_of):
    text = """\
@dataclass
class Arm:
    gripper: Gripper | None = None
class Robot(Task):
    @dataclass
    class State:
        arms: list[Arm] = field(default_factory=list)
"""
    said = refusal(module_of, text)
    assert f":{line_of(text, 'arms:')}: Robot.State.arms is made of Arm, whose gripper is of the class Gripper" in said


def test_all_faults_of_a_class_come_at_once(module_of):
    text = """\
class Robot(Task):
    @dataclass
    class Settings:
        path: Path = Path()
    @dataclass
    class State:
        what: Any = None
"""
    said = refusal(module_of, text)
    assert "Robot.Settings.path" in said
    assert "Robot.State.what" in said


def test_a_state_without_the_decorator_is_refused(module_of):
    text = "class Robot(Task):\n    class State:\n        x: int = 0\n"
    said = refusal(module_of, text)
    assert said == f"{module_of.path}:{line_of(text, 'class State')}: Robot.State is no dataclass: decorate it with" + (
        " @dataclass"
    )


def test_an_array_that_all_tasks_would_share_is_refused(module_of):
    text = "class Robot(Task):\n    class State(msgspec.Struct):\n        grid: np.ndarray = np.zeros(3)\n"
    assert "default_factory" in refusal(module_of, text)


def test_a_name_that_is_not_known_yet_refuses_nothing_and_hides_nothing(module_of):
    head = "class Robot(Task):\n    @dataclass\n    class State:\n        it: Later | None = None\n"
    module_of(head + "class Later: ...\n")
    assert "State.path" in refusal(module_of, head + "        path: Path = Path()\nclass Later: ...\n")


def test_what_can_be_saved_is_taken(module_of):
    module_of("""\
class Colour(Enum):
    RED = "red"
@dataclass
class Leg:
    length_m: float
    next: Leg | None = None
class Robot(Task):
    @dataclass
    class State:
        legs: dict[int, list[Leg]] = field(default_factory=dict)
        colours: set[Colour] = field(default_factory=set)
        raw: bytes = b""
        share: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.5
        grid: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
        images: list[NDArray[np.uint8]] = field(default_factory=list)
        last: NDArray[np.float32] | None = None
        noted: "tuple[float, ...]" = ()
""")


def test_a_handler_that_another_decorator_wraps_is_taken(module_of):
    module_of("""\
import functools
def counted(method):
    @functools.wraps(method)
    def call(*args):
        return method(*args)
    return call
class Robot(Task):
    @every(hz=1)
    @counted
    def blink(self, tick): ...
    @on("system")
    def seen(self, packet, again=False): ...
    @on("ctrl")
    def moved(self, *packets): ...
""")


def test_a_handler_that_is_named_at_run_time_is_judged_as_well(fleet):
    class Late(Task):
        def on_start(self):
            self.subscribe("system", Load, self.seen)  # type: ignore[arg-type]

        async def seen(self, packet): ...

    agent = fleet.start("a", tasks={"Late": Late})
    agent.wait_for_event("task_given_up", task="Late")
    assert any("Late.seen is `async def`" in line for line in agent.lines("error")) or any(
        "Late.seen is `async def`" in str(event) for event in agent.events("task_given_up")
    )


def test_a_tap_that_nobody_would_await_is_refused(fleet):
    async def hear(packet): ...

    with pytest.raises(ClassError, match="hear is `async def`"):
        fleet.start("a").kernel.stream.tap("system", hear)


NOT_FREE = [
    ("Task", "def pause(self): ...", "pause"),
    ("Task", "def migrate(self): ...", "migrate"),
    ("Task", "@every(hz=1)\n    def resume(self, tick): ...", "resume"),
    ("Task", "@property\n    def settings(self): ...", "def settings"),
    ("Task", "@staticmethod\n    def call(function): ...", "call"),
    ("Task", "name = 'circle'", "class Robot"),
    ("Task", "def _stop(self): ...", "_stop"),
    ("Task", "def on_start(self):\n        value = {}\n        self.address = value", "self.address"),
    ("Task", "def on_start(self):\n        self.agent = lambda: self", "self.agent"),
    ("Service", "def publish(self, channel, body): ...", "publish"),
    ("Service", "def on_start(self):\n        self._actor, self.mine = {}, 1", "self._actor"),
    ("ClientService", "def call(self, function): ...", "call"),
    ("ClientService", "def on_start(self):\n        self.name = []", "self.name"),
    ("Sensor", "def settings(self): ...\n    def read(self): ...", "def settings"),
    ("Actuator", "def context(self): ...", "context"),
]


@pytest.mark.parametrize(("base", "part", "marked"), NOT_FREE, ids=[f"{it[0]}-{it[2]}" for it in NOT_FREE])
def test_name_of_pancakes_is_refused_in_a_class_of_a_user(module_of, base, part, marked):
    text = f"class Robot({base}):\n    {part}\n"
    said = refusal(module_of, text)
    assert said.startswith(f"{module_of.path}:{line_of(text, marked)}: Robot.") and "is Pancakes' own" in said


def test_name_of_pancakes_in_a_mixin_is_refused(module_of):
    said = refusal(module_of, "class Stops:\n    def stop(self): ...\nclass Robot(Stops, Task): ...\n")
    assert "Stops.stop would replace a name that is Pancakes' own in a Task" in said


def test_class_with_hooks_and_names_of_its_own_is_taken(module_of):
    module_of("""\
class Base(Task):
    def on_start(self):
        self.mine = self.agent
        other = Gripper()
        other.name = "x"
        self.settings, self.state = self.settings, self.state
    def steer(self): ...
class Robot(Base):
    requires = ("pose",)
    def on_receive(self, message): ...
    def on_failure(self, exception_type, exception_value, traceback): ...
    def steer(self): ...
class Camera(Sensor):
    type = "load"
    blocking = True
    def open(self):
        self.handle = 1
    def read(self): ...
class Bridge(Service):
    only_name = "bridge"
    def own_tasks(self):
        return ()
""")


@pytest.mark.parametrize(
    ("base", "signature", "instead"),
    [
        ("Task", "self", "on_start(self)"),
        ("Task", "self, kernel, address", "on_start(self)"),
        ("Service", "self, settings", "on_start(self)"),
        ("Sensor", "self", "open(self)"),
    ],
)
def test_init_that_cannot_be_called_is_refused(module_of, base, signature, instead):
    text = f"class Robot({base}):\n    def __init__({signature}): ...\n"
    said = refusal(module_of, text)
    assert said.startswith(f"{module_of.path}:{line_of(text, '__init__')}: Robot.__init__ takes ({signature})")
    assert f"write `def {instead}`" in said


def test_a_driver_says_what_it_does_with_a_rate_in_one_of_three_words(module_of):
    text = "class Gauge(Sensor):\n    type = 'x'\n    rate = 5\n"
    said = f":{line_of(text, 'class Gauge')}: Gauge.rate is 5, and none of 'needed', 'optional', 'none'"
    assert said in refusal(module_of, text)


@pytest.mark.parametrize("name", ["requires", "offers"])
def test_one_word_for_a_tuple_of_words_is_refused(module_of, name):
    said = refusal(module_of, f"class Robot(Task):\n    {name} = 'pose'\n")
    assert f"Robot.{name} is 'pose': write ('pose',)" in said
    assert "and no tuple of names" in refusal(module_of, f"class Robot(Task):\n    {name} = (1, '')\n")


QUEUES = ["'latst'", "0", "None", "reliable(0)", "-1", "'5'", "2.5", "True"]


@pytest.mark.parametrize("queue", QUEUES)
def test_queue_policy_is_refused_where_it_is_written(module_of, queue):
    """It would fail whoever publishes, and not the task that wrote it."""
    said = refusal(
        module_of, f"class Robot(Task):\n    @on('system', queue={queue})\n    def seen(self, packet): ...\n"
    )
    assert said.startswith(("queue is ", "a queue takes "))


def test_queue_policy_fails_the_task_that_subscribes(fleet):
    class Subscribes(Task):
        def on_start(self):
            self.subscribe("system", Load, self.seen, queue="latest")
            self.subscribe("system", Load, self.seen, queue="last")  # type: ignore[arg-type]

        def seen(self, packet): ...

    agent = fleet.start("a", tasks={"Subscribes": Subscribes})
    agent.wait_for_event("task_given_up", task="Subscribes")
    assert agent.publish("system", Load(0.5)), "who publishes has no part in it"


IN_A_MIXIN = [
    ("Task", "async def on_settings(self): ...", "Mixin.on_settings is `async def`"),
    ("Task", "def on_start(self, x): ...", "Mixin.on_start takes (self, x)"),
    ("Task", "on_start = None", "Mixin.on_start is None"),
    ("Task", "requires = 'pose'", "Mixin.requires is 'pose': write ('pose',)"),
    ("Task", "@dataclass\n    class Settings:\n        what: Any = None", "Mixin.Settings.what may be anything"),
    ("Task", "def seen(self):\n        self.log.wran('x')", "Mixin.seen: the log has no level 'wran'"),
    ("Service", "@dataclass\n    class Settings:\n        what: Any = None", "Mixin.Settings.what may be anything"),
    ("Service", "@staticmethod\n    def own_tasks(): ...", "Mixin.own_tasks is a staticmethod"),
    ("Service", "def refuse_stop(self, kernel, name, arguments, for_s): ...", "Mixin.refuse_stop is a function"),
    ("Sensor", "async def read(self): ...", "Mixin.read is `async def`"),
    ("Sensor", "def hardware(self, settings): ...", "Mixin.hardware is a function"),
    ("Cost", "def terms(self): ...", "Mixin.terms takes (self)"),
]


def test_what_a_class_may_not_have_a_mixin_may_not_bring(module_of):
    def check(case):
        base, part, said = case
        assert said in refusal(module_of, f"class Mixin:\n    {part}\nclass Robot(Mixin, {base}): ...\n")

    for_each(IN_A_MIXIN, check)


def test_mixin_whose_part_stands_behind_is_not_judged(module_of):
    module_of("""\
class Mixin:
    requires = "pose"
    def on_start(self, x): ...
class Robot(Mixin, Task):
    requires = ("pose",)
    def on_start(self):
        Mixin.on_start(self, 1)
class Static:
    @staticmethod
    def named(other):
        other.name = "x"
class Other(Static, Task): ...
""")


NO_FUNCTION = [
    ("on_start = None", "is None"),
    ("@property\n    def on_start(self): ...", "is a property"),
    ("@staticmethod\n    def on_stop(): ...", "is a staticmethod"),
    ("on_settings = 5", "is 5"),
]


@pytest.mark.parametrize(("part", "what"), NO_FUNCTION)
def test_hook_that_is_no_function_is_refused(module_of, part, what):
    said = refusal(module_of, f"class Robot(Task):\n    {part}\n")
    assert what in said
    assert "which Pancakes calls: write `def on_" in said


def test_hook_of_a_class_between_hides_no_fault(module_of):
    text = "class Base(Task):\n    def on_start(self): ...\nclass Robot(Base):\n    def on_start(self, x): ...\n"
    assert "Robot.on_start takes (self, x)" in refusal(module_of, text)


SET_PAST = [
    ("def on_start(self):\n        self.name += 'x'", "sets self.name"),
    ("def on_start(self):\n        for self.name in 'ab': ...", "sets self.name"),
    ("def on_start(self):\n        other = Task\n        other.mine, self.agent = 1, 2", "sets self.agent"),
    ("def on_start(self):\n        def inner():\n            self.name = 'x'\n        inner()", "sets self.name"),
    ("def on_start(self):\n        [lambda: 1 for self.name in 'ab']", "sets self.name"),
    ("def on_start(self):\n        del self.log", "deletes self.log"),
    ("def on_start(self):\n        del self.state", "deletes self.state"),
    ("@renamed\n    def on_start(self): ...", "sets self.name"),
    (
        "def speed(self): ...\n    def put(self, value):\n        self.name = value\n    speed = property(speed, put)",
        "sets self.name",
    ),
    (
        "@property\n    def v(self): ...\n    @v.setter\n    def v(self, value):\n        self.name = value",
        "sets self.name",
    ),
    ("@cached_property\n    def speed(self):\n        self.name = 'x'", "sets self.name"),
]
WRAPS = """\
import functools
from functools import cached_property
def renamed(method):
    @functools.wraps(method)
    def call(me):
        me.name = "x"
        return method(me)
    return call
"""


def test_name_of_pancakes_is_set_by_no_way_round(module_of):
    def check(case):
        part, said = case
        refused = refusal(module_of, f"{WRAPS}class Robot(Task):\n    {part}\n")
        assert said in refused and "is Pancakes' own" in refused

    for_each(SET_PAST, check)


def test_what_only_looks_like_setting_an_own_name_is_taken(module_of):
    module_of("""\
class Robot(Task):
    def on_start(self):
        self.count = 1
        self.count += 1
        other = Gripper()
        other.name = "x"
        other.name += self.name
        self.other = other
        self.other.name += "x"
        del self.other.name, self.count
        self.state = self.settings
        def inner(self):
            self.name = "x"
        class Held:
            def __init__(self):
                self.name = "x"
""")


UNMADE = [
    ("Task", "def __new__(cls): return object.__new__(cls)", "Robot.__new__ takes (cls)"),
    ("Task", "def __init__(self, *a, **k): self.mine = 1", "Robot.__init__ does not call"),
    ("Service", "def __init__(self, *a, **k): self.mine = 1", "Robot.__init__ does not call"),
    ("Sensor", "def __new__(cls): return object.__new__(cls)", "Robot.__new__ takes (cls)"),
    ("Cost", "def __init__(self, weight): ...", "Robot.__init__ takes (self, weight)"),
]


@pytest.mark.parametrize(("base", "part", "said"), UNMADE)
def test_class_that_cannot_be_made_is_refused(module_of, base, part, said):
    assert said in refusal(module_of, f"class Robot({base}):\n    {part}\n")
    mixed_in = f"class Mixin:\n    {part}\nclass Robot(Mixin, {base}): ...\n"
    assert said.replace("Robot", "Mixin") in refusal(module_of, mixed_in)


def test_init_that_passes_on_what_it_is_given_is_taken(module_of):
    module_of("""\
class Counts:
    def __new__(cls, *args, **others):
        return super().__new__(cls)
    def __init__(self, *args, **others):
        super().__init__(*args, **others)
        self.count = 1
class Robot(Counts, Task): ...
class Camera(Counts, Sensor):
    type = "pose"
    def read(self): ...
class Gauge(Sensor):
    type = "load"
    def __init__(self, context, settings):
        self.mine = settings
    def read(self): ...
@dataclass
class Near(Cost):
    weight: float = 1.0
    def terms(self, facts): ...
class Far(Cost):
    def __init__(self):
        self.weight = 2.0
    def terms(self, facts): ...
""")


DECORATED = [
    ("tasks", "@dataclass\nclass Robot(Task):\n    speed: float = 1.0\n"),
    ("tasks", "@dataclass\nclass Robot(Task): ...\n"),
    ("tasks", "@dataclass(init=False)\nclass Robot(Task): ...\n"),
    ("tasks", "@dataclass\nclass Mixin:\n    speed: float = 1.0\nclass Robot(Mixin, Task): ...\n"),
    ("services", "@dataclass\nclass Robot(Service):\n    speed: float = 1.0\n"),
    ("drivers", "@dataclass\nclass Robot(Sensor):\n    type = 'x'\n    def read(self): ...\n"),
    ("costs", "@dataclass\nclass Robot(Cost):\n    weight: float\n    def terms(self, facts): ...\n"),
    ("filters", "@dataclass\nclass Robot(Filter):\n    def apply(self, command, ttl_s, source): ...\n"),
]
ABSTRACT = [
    (
        "drivers",
        "class Robot(Actuator):\n    type = 'x'\n    def write(self, command, ttl_s, source): ...\n",
        "`def safe_stop(",
    ),
    ("drivers", "class Robot(Sensor):\n    type = 'x'\n", "`def read(self)`"),
    ("costs", "class Robot(Cost): ...\n", "`def terms(self, facts)`"),
    ("filters", "class Robot(Filter): ...\n", "`def apply(self, command, ttl_s, source)`"),
    (
        "tasks",
        "from abc import ABC, abstractmethod\nclass Robot(Task, ABC):\n    @abstractmethod\n    def go(self): ...\n",
        "`def go(self)`",
    ),
]


def load(module_of, kind, text):
    """Returns why a class that is made is refused when it is loaded."""
    try:
        cls = module_of(text).Robot
        Plugins({(f"pancakes.{kind}", "mine"): cls}).get(f"pancakes.{kind}", "mine")
    except (ClassError, PluginError) as error:
        return str(error)
    return ""


def test_dataclass_for_a_class_that_pancakes_makes_is_refused(module_of):
    def check(case):
        said = load(module_of, *case)
        assert "is decorated with @dataclass, but Pancakes makes" in said
        assert f"{module_of.path}:" in said

    for_each(DECORATED, check)


def test_class_that_lacks_methods_is_refused_when_loaded(module_of):
    def check(case):
        kind, text, instead = case
        said = load(module_of, kind, text)
        assert f"{module_of.path}:" in said and "Robot lacks" in said and instead in said

    for_each(ABSTRACT, check)


def test_check_of_a_configuration_refuses_what_cannot_be_made(module_of):
    robot = module_of(DECORATED[0][1]).Robot
    with pytest.raises(ConfigError, match="is decorated with @dataclass"):
        parse(
            '[agent]\nname = "a"\n[task.R]\ntype = "mine"\n',
            "robot.toml",
            plugins=Plugins({("pancakes.tasks", "mine"): robot}),
            must_load=True,
        )


def test_task_that_a_service_cannot_make_is_given_up_at_once(fleet):
    @dataclass
    class Odd(Task):
        speed: float = 1.0

    class Silent(Task):
        def __init__(self, *args, **others):
            if not args:
                super().__init__(*args, **others)

    class Gone(Task):
        def __new__(cls, *args, **others):
            made = super().__new__(cls)
            return None if args else made

    class Brings(Service):
        def own_tasks(self):
            return [TaskSpec(cls.__name__, cls) for cls in (Odd, Silent, Gone)]

    agent = fleet.start("a", services={"brings": Brings})
    wanted = {"Odd": "is decorated with @dataclass", "Silent": "__init__ does not call", "Gone": "__new__ does not"}
    for name, said in wanted.items():
        assert said in str(agent.wait_for_event("task_given_up", task=name))
        assert not agent.events("task_failed", task=name, then="restart")


def test_class_refusal_of_what_answers_no_request_or_one_twice(module_of):
    assert "a class of requests, not 'where'" in refusal(module_of, "@answers('where')\ndef go(self, it): ...\n")
    twice = "    @answers(Where)\n    def {}(self, it): ...\n"
    said = refusal(module_of, "class Robot(Task):\n" + twice.format("other") + twice.format("go"))
    assert "Robot.go answers Where, as other does" in said
    assert "is a staticmethod" in refusal(module_of, "@answers(Where)\n@staticmethod\ndef go(it): ...\n")
    unregistered = "class Other(Request[float], frozen=True): ...\n@answers(Other)\ndef go(self, it): ...\n"
    assert "decorate it with @packet_type" in refusal(module_of, unregistered)
