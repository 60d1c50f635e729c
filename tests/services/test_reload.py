"""A task goes on in a new class while its agent runs; what does not fit leaves it in the old one."""

import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from services.plugin_on_disk import POINTS, PluginOnDisk, written

from pancakes.control import (
    Configure,
    Create,
    Describe,
    Drive,
    EndDrive,
    Migrate,
    Reload,
    Remove,
    Reply,
    Reschedule,
    Restart,
    Start,
    Stop,
)
from pancakes.devices import Twist
from pancakes.devices.driver import Actuator
from pancakes.errors import LocalProtocolError
from pancakes.kernel.actor import core_of
from pancakes.packet import type_name
from pancakes.security.access import right_of
from pancakes.service import Service
from pancakes.testing import AgentHandle, Fleet

IMPORTING, GO_ON = threading.Event(), threading.Event()
TRIED: list[type] = []
WALK, COUNT = "walk_in_test.Walk", "walk_in_test.Count"


class Plain(Service):
    """A service whose tasks neither move nor outlive a crash."""


def is_of_plugin(name: str) -> bool:
    return name.partition(".")[0] == "walk_in_test"


@pytest.fixture
def plugin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PluginOnDisk]:
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield written(tmp_path)
    for name in [name for name in sys.modules if is_of_plugin(name)]:
        del sys.modules[name]


def walker(fleet: Fleet, **tasks: Any) -> AgentHandle:
    a = fleet.start("a", tasks={"Walk": WALK, **tasks})
    fleet.run_for(2.05)
    return a


def is_packet_type(cls: type) -> bool:
    try:
        return type_name(cls) != ""
    except LocalProtocolError:
        return False


def words(a: AgentHandle) -> list[str]:
    return [it["word"] for it in a.events("walked")]


def code_of(reply: Reply) -> str:
    return reply.refusal.code if reply.refusal is not None else ""


def step_of(a: AgentHandle) -> Any:
    """Return the body of the last step that was published on an agent."""
    return [it.body for it in a.probe.packets() if it.type == "walk_in_test.step"][-1]


def test_a_task_goes_on_with_its_state_in_the_new_class_and_in_a_module_that_it_imports(
    fleet: Fleet, plugin: PluginOnDisk
) -> None:
    a = walker(fleet)
    assert a.ask(Configure("Walk", {"name": "berta"})).ok
    before = a.task("Walk")
    plugin.edit("helpers", "first", "second")
    plugin.edit("walk", "stride_m: float = 0.5", "stride_m: float = 0.7")
    plugin.edit("walk", "steps: int = 0\n", "steps: int = 0\n        falls: list[int] = field(default_factory=list)\n")
    reply = a.ask(Reload(WALK))
    assert reply.ok, reply.reason
    assert [it["task"] for it in reply.result["tasks"]] == ["Walk"]
    now = a.task("Walk")
    assert type(now) is not type(before) and now.state.steps == before.state.steps >= 20
    assert now.state.falls == []
    assert (now.settings.stride_m, now.settings.name) == (0.7, "berta"), "a default that was not set is the new one"
    fleet.run_for(2.0)
    assert "second" in words(a)
    assert a.events("task_reloaded", task="Walk")


def test_a_rate_counts_that_was_edited_unless_it_was_set(fleet: Fleet, plugin: PluginOnDisk) -> None:
    a = walker(fleet, Set={"type": WALK, "rate_hz": 4.0}, Changed=WALK)
    assert a.ask(Reschedule("Changed", 3.0)).ok
    plugin.edit("walk", "hz=10", "hz=20")
    assert a.ask(Reload(WALK)).ok
    rates = {name: a.ask(Describe(name)).result["rate_hz"] for name in ("Walk", "Set", "Changed")}
    assert rates == {"Walk": 20.0, "Set": 4.0, "Changed": pytest.approx(3.0)}


ANSWERS = """
from dataclasses import dataclass
from pancakes import Answer, Pending, Request, SYSTEM, Task, answers, on, packet_type
from walk_in_test.packets import Step

@packet_type("walk_in_test.find")
class Where(Request[str], frozen=True):
    pass

class Walk(Task):
    @dataclass
    class State:
        kept: Pending[str, object] | None = None

    @answers(Where)
    def where(self, request: Where, pending: Pending[str, object]) -> None:
        self.state.kept = pending

class Count(Task):
    @on(SYSTEM, Step)
    def ask_it(self, step: Step) -> None:
        self.ask("task:a/Walk", Where(), then=self.told, timeout_s=30.0)

    def told(self, answer: Answer[str]) -> None:
        self.event("told", text=str(answer.error or answer.result()))
"""
AT_ONCE = ("where(self, request: Where, pending: Pending[str, object]) -> None", "where(self, request: Where) -> str")


def test_a_request_that_waits_is_answered_by_the_new_class_if_that_answers_at_once(
    fleet: Fleet, plugin: PluginOnDisk
) -> None:
    plugin.write("walk", ANSWERS)
    plugin.install("0.1.0", POINTS.replace("count:Count", "walk:Count"))
    a = fleet.start("a", tasks={"Walk": WALK, "Count": COUNT})
    fleet.run_for(1.0)
    a.publish("system", sys.modules["walk_in_test.packets"].Step(1))
    fleet.run_for(1.0)
    assert a.task("Walk").state.kept is not None
    plugin.edit("walk", *AT_ONCE)
    plugin.edit("walk", "self.state.kept = pending", "return 'here'")
    assert a.ask(Reload(WALK)).ok
    fleet.run_for(1.0)
    assert [it["text"] for it in a.events("told")] == ["here"]


class Wheel(Actuator):
    type = "motors"

    def write(self, command: Twist, ttl_s: float, source: str) -> None: ...

    def safe_stop(self) -> None: ...


def test_a_task_keeps_its_actuators_and_commands_them_in_the_new_class(fleet: Fleet, plugin: PluginOnDisk) -> None:
    plugin.edit("walk", "    settings: Settings", "    requires = ('motors',)\n    settings: Settings")
    a = fleet.start("a", devices={"motors": Wheel}, tasks={"Walk": WALK, "Waits": WALK})
    fleet.run_for(1.0)
    assert a.running() == ["Walk"]
    held = a.ask(Describe("motors")).result["holder"]
    assert a.ask(Reload(WALK)).ok
    fleet.run_for(10.0)
    assert a.ask(Describe("motors")).result["holder"] == held == "a/client/Walk"


def test_a_task_whose_actuator_is_driven_by_hand_is_not_reloaded_then(fleet: Fleet, plugin: PluginOnDisk) -> None:
    plugin.edit("walk", "    settings: Settings", "    requires = ('motors',)\n    settings: Settings")
    a = fleet.start("a", devices={"motors": Wheel}, tasks={"Walk": WALK})
    fleet.run_for(1.0)
    assert a.ask(Drive("motors", "one", begin=True)).ok
    before = a.task("Walk")
    reply = a.ask(Reload(WALK))
    assert not reply.ok and "drives motors by hand" in reply.reason
    assert a.task("Walk") is before
    assert a.ask(EndDrive("motors", "one")).ok
    assert a.ask(Reload(WALK)).ok
    assert a.task("Walk") is not before


def test_it_goes_on_in_the_new_class_after_a_failure_and_a_restart_of_its_service(
    fleet: Fleet, plugin: PluginOnDisk
) -> None:
    a = walker(fleet)
    plugin.edit("helpers", "first", "second")
    assert a.ask(Reload(WALK)).ok
    cls = type(a.task("Walk"))
    assert a.ask(Restart("Walk")).ok
    assert type(a.task("Walk")) is cls
    assert a.ask(Restart("client")).ok
    fleet.run_for(1.0)
    assert type(a.task("Walk")) is cls
    assert a.ask(Create("Other", WALK)).ok
    assert type(a.task("Other")) is cls


@pytest.mark.parametrize(
    ("module", "old", "new", "says"),
    [
        ("walk", "steps: int = 0", "steps: str = ''", "steps"),
        ("walk", "steps: int = 0", "paces: int = 0", "steps"),
        ("walk", "settings: Settings", "settings: Settings; requires = ('pose',)", "pose"),
        ("walk", "class Walk(Task):", "class Walk(Task):\n    state = 1 / 0\n", "walk.py:8"),
        ("helpers", "WORD", "import walk_in_test.missing\nWORD", "helpers.py:2"),
        ("walk", "class Walk(Task):", "class Walk(Task:", "walk.py"),
    ],
    ids=["another type", "field gone", "device missing", "import fails", "import of another fails", "syntax"],
)
def test_what_does_not_fit_is_refused_and_the_task_goes_on_in_its_class(
    fleet: Fleet, plugin: PluginOnDisk, module: str, old: str, new: str, says: str
) -> None:
    a = walker(fleet)
    assert a.ask(Configure("Walk", {"stride_m": 0.9})).ok
    before, modules = a.task("Walk"), {name: it for name, it in sys.modules.items() if is_of_plugin(name)}
    plugin.edit(module, old, new)
    for dry_run in (True, False):
        refused = a.ask(Reload(WALK, dry_run))
        assert says in refused.reason
    assert a.task("Walk") is before
    assert modules == {name: it for name, it in sys.modules.items() if is_of_plugin(name)}
    fleet.run_for(2.0)
    assert set(words(a)) == {"first"}
    assert a.ask(Restart("Walk")).ok
    assert type(a.task("Walk")) is type(before)
    plugin.edit(module, new, old)
    assert a.ask(Reload(WALK)).ok, "once it is mended"


def test_a_dry_run_changes_nothing(fleet: Fleet, plugin: PluginOnDisk) -> None:
    a = walker(fleet)
    before = a.task("Walk")
    plugin.edit("helpers", "first", "second")
    assert a.ask(Reload(WALK, dry_run=True)).ok
    fleet.run_for(2.0)
    assert a.task("Walk") is before and set(words(a)) == {"first"}


def test_tasks_of_other_types_of_the_distribution_go_along_and_share_packets(
    fleet: Fleet, plugin: PluginOnDisk
) -> None:
    a = walker(fleet, Count=COUNT)
    heard = a.task("Count").state.heard
    plugin.edit("packets", "number: int", "number: int\n    word: str = 'left'")
    reply = a.ask(Reload(WALK))
    assert sorted(it["task"] for it in reply.result["tasks"]) == ["Count", "Walk"]
    fleet.run_for(2.0)
    assert a.task("Count").state.heard >= heard + 18
    assert type(step_of(a)).__struct_fields__ == ("number", "word")


def test_a_packet_type_that_has_not_changed_stays_one_class_for_all(fleet: Fleet, plugin: PluginOnDisk) -> None:
    a = walker(fleet)
    before = type(step_of(a))
    plugin.edit("packets", "from msgspec", "# a line more\n\nfrom msgspec")
    plugin.edit("helpers", "first", "second")
    assert a.ask(Reload(WALK)).ok
    fleet.run_for(2.0)
    assert type(step_of(a)) is before
    plugin.edit("packets", "== 1", "== 0")
    assert a.ask(Reload(WALK)).ok
    fleet.run_for(2.0)
    assert type(step_of(a)) is not before, "a method has changed"


def test_a_packet_type_that_others_know_is_not_changed(
    fleet: Fleet, plugin: PluginOnDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    a = walker(fleet)
    before = a.task("Walk")
    monkeypatch.setattr(sys.modules[__name__], "Step", sys.modules["walk_in_test.packets"].Step, raising=False)
    plugin.edit("packets", "number: int", "number: float")
    refused = a.ask(Reload(WALK))
    assert __name__ in refused.reason and "walk_in_test.step" in refused.reason
    assert a.task("Walk") is before


def test_a_driver_stays_and_is_named(fleet: Fleet, plugin: PluginOnDisk) -> None:
    a = fleet.start("a", devices={"load": "walk_in_test.Gauge"}, tasks={"Walk": WALK})
    fleet.run_for(1.0)
    plugin.edit("helpers", "first", "second")
    assert a.ask(Reload(WALK)).result["stays"] == ["driver walk_in_test.Gauge"]
    assert code_of(a.ask(Reload("walk_in_test.Gauge"))) == "unsupported"
    plugin.edit("packets", "number: int", "number: float")
    assert "walk_in_test.Gauge" in a.ask(Reload(WALK)).reason, "it may use the packet type in its old form"


@pytest.mark.parametrize("type_name", ["walk_in_test.Walc", "nobody.Knows", "sim.Nothing"])
def test_an_unknown_type_is_refused(fleet: Fleet, plugin: PluginOnDisk, type_name: str) -> None:
    a = walker(fleet)
    refused = a.ask(Reload(type_name))
    assert not refused.ok and type_name in refused.reason


def test_a_task_at_rest_gets_the_class_and_rests(fleet: Fleet, plugin: PluginOnDisk) -> None:
    a = walker(fleet)
    assert a.ask(Stop("Walk")).ok
    plugin.edit("helpers", "first", "second")
    assert a.ask(Reload(WALK)).ok
    assert a.running() == []
    assert a.ask(Start("Walk")).ok
    assert a.task("Walk").state.steps >= 20
    fleet.run_for(2.0)
    assert "second" in words(a)


def test_a_task_that_fails_again_and_again_is_mended(fleet: Fleet, plugin: PluginOnDisk) -> None:
    plugin.edit("walk", "self.state.steps += 1", "self.state.steps += 1 / 0")
    restart = {"policy": "always", "at_most": 3, "within_s": 60.0, "pause_s": 5.0}
    a = fleet.start("a", tasks={"Walk": {"type": WALK, "restart": restart}})
    fleet.run_for(1.0)
    assert a.running() == []
    plugin.edit("walk", "+= 1 / 0", "+= 1")
    assert a.ask(Reload(WALK)).ok
    fleet.run_for(20.0)
    assert a.running() == ["Walk"] and words(a)


def test_a_guarded_task_keeps_its_guardians_and_is_taken_over_by_no_one(fleet: Fleet, plugin: PluginOnDisk) -> None:
    a = fleet.start("a", tasks={"Walk": {"type": WALK, "guard": {"copies": 3, "lease_s": 2.0}}})
    b, c = fleet.start("b"), fleet.start("c")
    fleet.connect()
    fleet.run_for(10.0)
    before = a.ask(Describe("Walk")).result
    plugin.edit("helpers", "first", "second")
    assert a.ask(Reload(WALK)).ok
    fleet.run_for(10.0)
    after = a.ask(Describe("Walk")).result
    assert before["guarding"]["guardians"] and len(after["guarding"]["guardians"]) == 3
    assert after["fence"]["task_id"] == before["fence"]["task_id"]
    assert a.running() == ["Walk"] and not b.running() and not c.running()
    assert a.task("Walk").state.steps > 150 and "second" in words(a)


def test_a_new_version_takes_part_in_migrations_as_an_agent_that_was_restarted(
    fleet: Fleet, plugin: PluginOnDisk
) -> None:
    a, b = walker(fleet), fleet.start("b", tasks={"Own": WALK})
    fleet.connect()
    plugin.install("0.2.0")
    reply = a.ask(Reload(WALK))
    assert (reply.result["before"], reply.result["version"]) == ("0.1.0", "0.2.0")
    refused = a.ask(Migrate("Walk", to="b"))
    assert "0.1.0" in refused.reason and "0.2.0" in refused.reason
    assert b.ask(Reload(WALK)).ok
    assert a.ask(Migrate("Walk", to="b")).ok
    assert b.task("Walk").state.steps >= 20


def test_a_type_that_was_installed_meanwhile_becomes_known(fleet: Fleet, plugin: PluginOnDisk) -> None:
    plugin.install("0.1.0", "[pancakes.tasks]\nwalk_in_test.Count = walk_in_test.count:Count\n")
    a = fleet.start("a", tasks={"Count": COUNT})
    plugin.install("0.1.1", POINTS)
    assert not a.ask(Create("Walk", WALK)).ok
    assert a.ask(Reload(WALK)).ok
    assert a.ask(Create("Walk", WALK)).ok
    fleet.run_for(1.0)
    assert a.task("Count").state.heard > 5


def test_a_task_that_moves_is_not_reloaded(fleet: Fleet, plugin: PluginOnDisk) -> None:
    a, b = walker(fleet), fleet.start("b")
    fleet.connect()
    a.publish("sysctrl", Migrate("Walk", to="b"))
    asked = a.publish("sysctrl", Reload(WALK))
    fleet.run_for(5.0)
    assert code_of(a.reply_to(asked)) == "busy"
    assert b.task("Walk").state.steps > 20


def test_one_task_that_does_not_fit_keeps_all_in_their_classes(fleet: Fleet, plugin: PluginOnDisk) -> None:
    a = walker(fleet, Other={"type": WALK, "settings": {"stride_m": 3.0}})
    before = [a.task("Walk"), a.task("Other")]
    plugin.edit("walk", "from dataclasses", "from typing import Annotated\nfrom msgspec import Meta\nfrom dataclasses")
    plugin.edit("walk", "stride_m: float", "stride_m: Annotated[float, Meta(le=1)]")
    refused = a.ask(Reload(WALK))
    assert "a/client/Other" in refused.reason and "stride_m" in refused.reason
    assert [it["reason"] != "" for it in refused.result["tasks"]].count(True) == 1
    assert [a.task("Walk"), a.task("Other")] == before


STOPS_BADLY = """
    def on_stop(self) -> None:
        self.state.steps = 1_000_000
"""


def test_a_state_that_does_not_fit_at_the_last_moment_begins_again_in_its_class(
    fleet: Fleet, plugin: PluginOnDisk
) -> None:
    plugin.write("walk", (plugin.folder / "walk_in_test" / "walk.py").read_text() + STOPS_BADLY)
    a = walker(fleet)
    cls = type(a.task("Walk"))
    plugin.edit("walk", "from dataclasses", "from typing import Annotated\nfrom msgspec import Meta\nfrom dataclasses")
    plugin.edit("walk", "steps: int", "steps: Annotated[int, Meta(le=999)]")
    refused = a.ask(Reload(WALK))
    assert "steps" in refused.reason
    assert type(a.task("Walk")) is cls and a.task("Walk").state.steps == 1_000_000


def test_a_class_that_fails_to_start_is_told_and_mended_by_the_next_reload(fleet: Fleet, plugin: PluginOnDisk) -> None:
    a = walker(fleet)
    plugin.edit("walk", "state: State\n", "state: State\n    def on_start(self): self.missing\n")
    refused = a.ask(Reload(WALK))
    assert "missing" in refused.reason and "walk.py" in refused.reason
    plugin.edit("walk", "self.missing", "pass")
    assert a.ask(Reload(WALK)).ok
    fleet.run_for(60.0)
    assert a.running() == ["Walk"] and a.task("Walk").state.steps >= 20


def test_the_tasks_of_all_services_go_along(fleet: Fleet, plugin: PluginOnDisk) -> None:
    tasks = {"Other": {"type": WALK, "service": "more"}, "Plain": {"type": WALK, "service": "plain"}}
    a = fleet.start("a", services={"more": "client", "plain": Plain}, tasks={"Walk": WALK, **tasks})
    fleet.run_for(2.05)
    assert a.ask(Configure("plain/Plain", {"name": "carla"})).ok
    plugin.edit("helpers", "first", "second")
    plugin.edit("walk", "stride_m: float = 0.5", "stride_m: float = 0.7")
    reply = a.ask(Reload(WALK))
    assert sorted(it["service"] for it in reply.result["tasks"]) == ["client", "more", "plain"]
    fleet.run_for(2.0)
    for name, service in (("Walk", "client"), ("Other", "more"), ("Plain", "plain")):
        task = a.task(name, service)
        assert task.state.steps >= 39 and task.settings.stride_m == 0.7
    assert a.task("Plain", "plain").settings.name == "carla"


def test_a_second_reload_meanwhile_is_refused_and_may_be_tried_again(fleet: Fleet, plugin: PluginOnDisk) -> None:
    a = walker(fleet)
    first, second = a.publish("sysctrl", Reload(WALK)), a.publish("sysctrl", Reload(COUNT))
    fleet.run_for(1.0)
    assert a.reply_to(first).ok
    assert code_of(a.reply_to(second)) == "busy"


def test_a_type_that_was_not_imported_before_an_upgrade_is_not_mixed_with_the_old_version(
    fleet: Fleet, plugin: PluginOnDisk
) -> None:
    a = walker(fleet)
    plugin.install("0.2.0")
    refused = a.ask(Create("Count", COUNT))
    assert "0.1.0" in refused.reason and "0.2.0" in refused.reason and f"task reload {COUNT}" in refused.reason
    assert a.ask(Reload(WALK)).ok
    assert a.ask(Create("Count", COUNT)).ok


def test_what_was_sent_to_a_task_is_handled_once(fleet: Fleet, plugin: PluginOnDisk) -> None:
    a, b = fleet.start("a", tasks={"Count": COUNT}), fleet.start("b", tasks={"Walk": WALK})
    plugin.edit("helpers", "first", "second")
    fleet.connect()
    for number in range(20):
        Step = sys.modules["walk_in_test.packets"].Step
        b.publish("system", Step(number), "task:a/Count")
        if number == 10:
            assert a.ask(Reload(COUNT)).ok
        fleet.run_for(0.02)
    fleet.run_for(20.0)
    assert a.task("Count").state.heard == 20


def test_an_agent_answers_others_while_a_class_is_imported_again(
    threaded_agent: Callable[..., AgentHandle], plugin: PluginOnDisk
) -> None:
    a = threaded_agent("a", tasks={"Walk": WALK})
    a.wait_for_event("walked")
    waits = f"tests = sys.modules[{__name__!r}]\ntests.IMPORTING.set()\nassert tests.GO_ON.wait(20.0)\n"
    plugin.write("helpers", f"import sys\n{waits}WORD = 'second'\n")
    IMPORTING.clear()
    GO_ON.clear()
    asked = a.publish("sysctrl", Reload(WALK))
    assert IMPORTING.wait(20.0)
    assert a.ask(Describe("Walk")).result["state"] == "running"
    GO_ON.set()
    a.wait_for_event("walked", word="second")
    reply = a.reply_to(asked)
    assert reply.ok or code_of(reply) == "pending", "on a slow machine the answer comes before the end"


def test_a_try_needs_the_right_to_change_as_it_runs_what_it_imports() -> None:
    assert right_of(Reload(WALK, dry_run=True)) == right_of(Reload(WALK)) == "change"


NESTED = """
from enum import Enum
from msgspec import Struct
from pancakes import Request, packet_type

LIMIT = 3

class Foot(Enum):
    LEFT = 1
    RIGHT = 2

class Place(Struct, frozen=True):
    x_m: float = 0.0

@packet_type("walk_in_test.step")
class Step(Struct, frozen=True):
    number: int
    foot: Foot = Foot.LEFT
    place: Place = Place()

    def is_far(self):
        return self.number > LIMIT

@packet_type("walk_in_test.where")
class Where(Request[Place], frozen=True):
    pass
"""


def test_packets_with_parts_of_their_own_stay_one_class_if_their_module_has_not_changed(
    fleet: Fleet, plugin: PluginOnDisk
) -> None:
    plugin.write("packets", NESTED)
    a = fleet.start("a", devices={"load": "walk_in_test.Gauge"}, tasks={"Walk": WALK})
    fleet.run_for(1.05)
    before = type(step_of(a))
    plugin.edit("packets", "from enum", "# a line more\n\nfrom enum")
    plugin.edit("helpers", "first", "second")
    reply = a.ask(Reload(WALK))
    assert reply.ok, reply.reason
    fleet.run_for(2.0)
    assert "second" in words(a) and type(step_of(a)) is before
    assert sys.modules["walk_in_test.packets"].Step is before
    assert sys.modules["walk_in_test.packets"].Foot.LEFT is step_of(a).foot


@pytest.mark.parametrize(
    ("old", "new"),
    [("LIMIT = 3", "LIMIT = 4"), ("RIGHT = 2", "RIGHT = 3"), ("x_m: float = 0.0", "x_m: float = 1.0")],
    ids=["constant that a method uses", "member", "default of a part"],
)
def test_a_packet_type_changes_with_what_it_uses(fleet: Fleet, plugin: PluginOnDisk, old: str, new: str) -> None:
    plugin.write("packets", NESTED)
    a = walker(fleet)
    before = type(step_of(a))
    plugin.edit("packets", old, new)
    assert a.ask(Reload(WALK)).ok
    fleet.run_for(1.0)
    assert type(step_of(a)) is not before
    assert sys.modules["walk_in_test.packets"].Step is type(step_of(a))


def test_a_packet_type_that_is_only_tried_is_none(fleet: Fleet, plugin: PluginOnDisk) -> None:
    a = walker(fleet)
    TRIED.clear()
    plugin.edit("packets", "== 1", "== 0")
    plugin.edit("packets", "from msgspec", f"import sys\nTRIED = sys.modules[{__name__!r}].TRIED\nfrom msgspec")
    plugin.edit("packets", "== 0\n", "== 0\n\nTRIED.append(Step)\n")
    assert a.ask(Reload(WALK, dry_run=True)).ok
    plugin.edit("walk", "steps: int = 0", "paces: int = 0")
    assert not a.ask(Reload(WALK)).ok, "its state does not fit"
    plugin.edit("walk", "class Walk(Task):", "class Walk(Task:")
    assert not a.ask(Reload(WALK)).ok, "the import fails"
    assert len(TRIED) == 3 and not any(map(is_packet_type, TRIED))


def test_a_task_that_is_removed_while_it_is_asked_does_not_keep_a_reload_for_good(
    fleet: Fleet, plugin: PluginOnDisk
) -> None:
    a = walker(fleet)
    assert a.ask(Create("Other", WALK)).ok
    other = core_of(a.task("Other"))
    other.freeze()  # so that it does not answer
    asked = a.publish("sysctrl", Reload(WALK))
    fleet.run_for(0.5)
    assert a.ask(Remove("Other")).ok
    fleet.run_for(10.0)
    assert a.reply_to(asked).ok
    assert a.ask(Reload(WALK)).ok


ASKER = """
from pancakes import Answer, SYSTEM, Task, on
from walk_in_test.packets import Step, Where

class Walk(Task):
    @on(SYSTEM, Step)
    def on_step(self, packet):
        self.ask("a/client/Place", Where(), timeout_s=60.0, then=self.arrived)

    def arrived(self, answer: Answer):
        self.event("arrived", ok=answer.ok)
"""
ANSWERER = """
from pancakes import Pending, Task, answers
from walk_in_test.packets import Where

class Count(Task):
    @answers(Where)
    def where(self, request: Where, pending: Pending) -> None:
        pass
"""


def test_a_task_whose_answer_no_method_would_take_is_not_reloaded(fleet: Fleet, plugin: PluginOnDisk) -> None:
    for module, text in (("packets", NESTED), ("walk", ASKER), ("count", ANSWERER)):
        plugin.write(module, text)
    a = fleet.start("a", tasks={"Walk": WALK, "Place": COUNT})
    fleet.run_for(1.0)
    before = a.task("Walk")
    a.publish("system", sys.modules["walk_in_test.packets"].Step(1))
    fleet.run_for(1.0)
    plugin.edit("walk", "arrived", "came")
    refused = a.ask(Reload(WALK))
    assert code_of(refused) == "busy" and "'arrived'" in refused.reason
    assert a.task("Walk") is before
    plugin.edit("walk", "came", "arrived")
    plugin.edit("walk", "ok=answer.ok", "ok=answer.ok, new=True")
    assert a.ask(Reload(WALK)).ok
    fleet.run_for(65.0)
    assert a.events("arrived")[0]["new"], "the new class gets the answer of the request of its predecessor"


def test_a_task_that_waits_while_somebody_drives_is_reloaded_after_that(fleet: Fleet, plugin: PluginOnDisk) -> None:
    plugin.edit("walk", "    settings: Settings", "    requires = ('motors',)\n    settings: Settings")
    a = fleet.start("a", devices={"motors": Wheel}, tasks={"Walk": WALK})
    fleet.run_for(2.05)
    assert a.ask(Drive("motors", "one", begin=True)).ok
    before = a.task("Walk")
    plugin.edit("helpers", "first", "second")
    for dry_run in (True, False):
        refused = a.ask(Reload(WALK, dry_run))
        assert code_of(refused) == "busy" and "drives motors" in refused.reason
    assert a.task("Walk") is before
    assert a.ask(EndDrive("motors", "one")).ok
    fleet.run_for(1.0)
    assert a.ask(Reload(WALK)).ok
    fleet.run_for(2.0)
    assert "second" in words(a)
