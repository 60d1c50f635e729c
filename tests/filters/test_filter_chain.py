"""Filters of an actuator: every command passes them, whoever gives it; what they do is counted, shown and told."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from pancakes.control import Configure, Describe, Migrate, Restart
from pancakes.devices import Twist
from pancakes.devices.driver import Actuator
from pancakes.errors import ConfigError
from pancakes.filters.filter import Changed, Filter, Held
from pancakes.kernel.timer import OneShot
from pancakes.simulation.fleet import registered
from pancakes.task import Task, every
from pancakes.testing import Fleet


class Wheels(Actuator):
    """Writes down what it is told."""

    type = "motors"

    @dataclass
    class Settings:
        port: str = "a"

    told: list = []
    opened = 0

    def open(self):
        type(self).opened += 1
        type(self).told = []

    def write(self, command, ttl_s, source):
        self.told.append((round(self.context.now(), 3), command.v_mps, round(ttl_s, 3)))

    def safe_stop(self):
        self.told.append((round(self.context.now(), 3), "hold"))


class Driving(Task):
    requires = ("motors",)

    @dataclass
    class Settings:
        v_mps: float = 0.1

    @every(hz=10)
    def drive(self, tick):
        self.publish("ctrl", Twist(self.settings.v_mps, 0.0))


class Scale(Filter):
    """Multiplies the speed; breaks, holds, or says nonsense if its settings ask for it."""

    type = "motors"

    @dataclass
    class Settings:
        by: float = 1.0
        mode: str = ""
        check_hz: float = 0.0

        def __post_init__(self):
            if self.by < 0:
                raise ValueError("by must not be negative")

    @property
    def check_hz(self):
        return self.settings.check_hz

    def on_settings(self):
        if self.settings.by == 13:
            raise ValueError("13 brings bad luck")

    def apply(self, command, ttl_s, source):
        match self.settings.mode:
            case "breaks":
                raise ZeroDivisionError("by nothing")
            case "holds":
                return Held("it was told to")
            case "nan":
                return Changed(Twist(float("nan"), 0.0), "no number")
            case "load":
                return "fast"
        return command if self.settings.by == 1 else Changed(Twist(command.v_mps * self.settings.by, 0.0), "scaled")


@pytest.fixture
def fleet():
    with Fleet(seed=3) as made:
        yield made


def scale(**settings):
    return {"type": Scale, "device": "motors", "settings": settings}


def robot(fleet, *filters, hz=10.0):
    made = dict(zip(("first", "second", "third"), (scale(**it) for it in filters), strict=False))
    driving = {"type": Driving, "rate_hz": hz}
    return fleet.start("a", devices={"motors": Wheels}, filters=made, tasks={"Driving": driving})


def speeds():
    return [round(it[1], 6) for it in Wheels.told if it[1] != "hold"]


def accounts(agent):
    return {it["filter"]: it for it in agent.ask(Describe("motors")).result["filters"]}


def test_command_passes_all_filters_in_order(fleet):
    agent = robot(fleet, {"by": 2.0}, {"by": 3.0}, {})
    fleet.run_for(1.0)
    assert set(speeds()) == {0.6}
    told = accounts(agent)
    assert [*told] == ["first", "second", "third"]
    assert told["first"]["changed"] == told["second"]["changed"] == len(speeds())
    assert (told["third"]["passed"], told["third"]["doing"], told["first"]["why"]) == (
        len(speeds()),
        "passes",
        "scaled",
    )


def test_command_of_another_agent_passes_the_filters(fleet):
    fleet.start(
        "a", devices={"motors": Wheels}, filters={"first": {"type": Scale, "device": "motors", "settings": {"by": 2.0}}}
    )
    fleet.start(
        "b",
        devices={"far": {"type": "network.motors", "settings": {"target": "a/device/motors"}}},
        tasks={"Driving": Driving},
    )
    fleet.run_for(1.0)
    assert set(speeds()) == {0.2}


class Apart(Wheels):
    """Wheels that write down what they are told by the agent that has them."""

    by_agent: dict = {}

    def open(self):
        self.told = self.by_agent.setdefault(self.context.agent, [])


def test_filter_stays_when_a_task_migrates_and_is_taken_over(fleet):
    """Each robot has a filter of its own, whatever task commands it, and however that came to it."""
    Apart.by_agent = {}
    guarded = {"type": Driving, "guard": {"copies": 3, "lease_s": 2.0, "checkpoint_s": 0.5}}
    for name, by in (("a", 2.0), ("b", 3.0), ("c", 4.0)):
        tasks = {"Driving": guarded} if name == "a" else {}
        fleet.start(name, devices={"motors": Apart}, filters={"first": scale(by=by)}, tasks=tasks)
    fleet.run_for(3.0)
    assert fleet.agents["a"].ask(Migrate("Driving", to="b")).ok
    fleet.run_for(3.0)
    fleet.crash("b")
    fleet.run_until(lambda: "Driving" in [it for name in ("a", "c") for it in fleet.agents[name].running()], 20.0)
    fleet.run_for(2.0)
    taken_by = next(name for name in ("a", "c") if "Driving" in fleet.agents[name].running())
    said = {name: {round(it[1], 6) for it in told if it[1] != "hold"} for name, told in Apart.by_agent.items()}
    assert said["b"] == {0.3}
    assert said["a"] == {0.2} and said[taken_by] == {{"a": 0.2, "c": 0.4}[taken_by]}


@pytest.mark.parametrize(
    ("mode", "why"),
    [
        ("breaks", "failed: ZeroDivisionError: by nothing"),
        ("nan", "failed: ValueError: its command is none: v_mps is nan"),
        ("load", "failed: TypeError: it returned a str, which is no command of the type 'motors'"),
        ("holds", "it was told to"),
    ],
)
def test_filter_without_a_command_stops_the_actuator(fleet, mode, why):
    agent = robot(fleet, {"by": 2.0}, {})
    fleet.run_for(0.5)
    Wheels.told.clear()
    assert agent.ask(Configure("motors", {"filters": {"first": {"by": 2.0}, "second": {"mode": mode}}})).ok
    fleet.run_for(1.0)
    assert [it[1] for it in Wheels.told] == ["hold"]
    told = accounts(agent)["second"]
    assert told["doing"] == "holds" and told["why"].startswith(why) and told["held"] >= 9
    assert len([line for line in agent.lines("error") if why.removeprefix("failed: ") in line]) == (mode != "holds")
    (event,) = [it for it in agent.events("command_filtered", filter="second") if it["doing"] == "holds"]
    assert event["reason"].startswith(why) and event["by"] == "a/client/Driving"
    assert agent.ask(Configure("motors", {"filters": {"first": {"by": 2.0}, "second": {}}})).ok
    fleet.run_for(1.0)
    assert set(speeds()) == {0.2}, "it goes on once a command passes"


def test_filter_settings_change_while_wheels_run(fleet):
    agent = robot(fleet, {"by": 2.0})
    fleet.run_for(0.5)
    opened = Wheels.opened
    assert agent.ask(Configure("motors", {"filters": {"first": {"by": 4.0}}})).ok
    Wheels.told.clear()
    fleet.run_for(0.5)
    assert set(speeds()) == {0.4} and Wheels.opened == opened and "hold" not in [it[1] for it in Wheels.told]
    for bad, why in (
        ({"by": -1.0}, "filters.first: by must not be negative"),
        ({"by": 13.0}, "13 brings bad luck"),
        ({"bye": 2.0}, "filters.first.bye: unknown key, did you mean 'by'?"),
    ):
        reply = agent.ask(Configure("motors", {"filters": {"first": bad}}))
        assert not reply.ok and why in reply.reason
    Wheels.told.clear()
    fleet.run_for(0.5)
    assert set(speeds()) == {0.4}, "a refused change leaves the former"
    assert agent.ask(Restart("device")).ok
    fleet.run_for(0.5)
    assert set(speeds()) == {0.4}, "it survives a restart of the service"
    assert agent.ask(Configure("motors", {"port": "b"})).ok
    assert Wheels.opened == opened + 2, "the driver's own settings open it again"


def test_command_is_checked_again_while_good(fleet):
    agent = robot(fleet, {"check_hz": 20.0}, hz=1.0)
    fleet.run_for(1.1)
    assert agent.ask(Configure("motors", {"filters": {"first": {"check_hz": 20.0, "by": 3.0}}})).ok
    Wheels.told.clear()
    fleet.run_for(0.2)
    ((at_s, v_mps, ttl_s),) = Wheels.told
    assert v_mps == pytest.approx(0.3) and at_s + ttl_s == pytest.approx(1.5, abs=0.01), "once, and good for no longer"


def test_late_look_brings_no_old_command_back(fleet):
    """On threads, the look at a command may have left the timer when the next command comes."""
    agent = robot(fleet, {"check_hz": 20.0}, hz=1.0)
    motors = agent.kernel.registry.get("a/device/motors")
    after, looks = motors.after, []

    def take(delay_s, function):
        if delay_s != 0.05:  # 20 Hz
            return after(delay_s, function)
        looks.append(function)
        return OneShot(function)

    motors.after = take
    fleet.run_for(1.5)
    assert agent.ask(Configure("Driving", {"v_mps": 0.3})).ok
    fleet.run_for(0.7)
    assert Wheels.told[-1][1] == pytest.approx(0.3)
    told = list(Wheels.told)
    looks[0]()
    assert Wheels.told == told


def test_guard_holds_although_filters_check_again(fleet):
    robot(fleet, {"check_hz": 20.0}, hz=1.0)
    fleet.run_for(1.95)
    assert [it[1] for it in Wheels.told] == [0.1, "hold"]


LIMIT = "type = 'limit'\nsettings = { max_mps = 1 }\n"
BARRIER = "type = 'barrier'\ndevice = 'motors'\n"
SMALL = "settings = {{ radius_m = 0.5, max_mps = 0.2, max_radps = 3, area = {{ {} }} }}"
BAD = [
    ("type = 'barier'\ndevice = 'motors'", "unknown filter 'barier', did you mean 'barrier'?"),
    (f"{LIMIT}device = 'motor'", "there is no device 'motor' here, did you mean 'motors'?"),
    (f"{LIMIT}device = 'pose'", "'pose' is no actuator"),
    (f"{LIMIT}device = 'lamp'", "'limit' is for actuators of the type 'motors', and 'lamp' is of the type 'lamp'"),
    ("type = 'limit'\ndevice = 'motors'", "needs a limit: max_mps, max_radps or both"),
    ("type = 'limit'", "device: is missing"),
    ("device = 'motors'", "type: is missing"),
    (f"{BARRIER}settings = {{ max_mps = 0.2, max_radps = 3 }}", "settings.radius_m: is missing"),
    (BARRIER + SMALL.format("x_min_m = 1, x_max_m = 0, y_min_m = 0, y_max_m = 1"), "x_min_m = 1 is above x_max_m = 0"),
    (
        BARRIER + SMALL.format("x_min_m = 0, x_max_m = 1, y_min_m = 0, y_max_m = 9"),
        "area is too small: the robot needs more than 1.14 m in it each way",
    ),
    (f"{BARRIER}speed = 3", "unknown key; the filter's own settings belong in its key `settings`"),
]


class Lamp(Wheels):
    type = "lamp"


@pytest.mark.parametrize(("table", "why"), BAD)
def test_bad_filter_is_named_with_its_key(table, why):
    from pancakes.config import parse

    text = (
        'schema = 1\nagent.name = "a"\n[device.motors]\ndriver = "null.motors"\n[device.lamp]\ndriver = "test.lamp"\n'
        f'[device.pose]\ndriver = "null.pose"\n[filter.apart]\n{table}\n'
    )
    with pytest.raises(ConfigError) as raised:
        parse(text, "a.toml", plugins=registered({"test.lamp": Lamp}))
    assert why in str(raised.value) and "[filter.apart]" in str(raised.value)


def test_name_of_a_filter_must_be_a_word():
    from pancakes.config import parse

    text = 'schema = 1\nagent.name = "a"\ndevice.motors.driver = "null.motors"\n[filter.keep-off]\ntype = "limit"\n'
    with pytest.raises(ConfigError, match="'keep-off' is no name for a filter: use letters"):
        parse(text + 'device = "motors"\nsettings.max_mps = 1\n', "a.toml", plugins=registered({}))


def test_limit_slows_down_on_the_same_path(fleet):
    settings = {"max_mps": 0.2, "max_radps": 1.0}
    agent = fleet.start(
        "a",
        devices={"motors": Wheels},
        filters={"limit": {"type": "limit", "device": "motors", "settings": settings}},
        tasks={"Driving": {"type": Driving, "settings": {"v_mps": 0.8}}},
    )
    fleet.run_for(0.5)
    assert set(speeds()) == {0.2}
    assert accounts(agent)["limit"]["why"] == "too fast"


class Stubborn(Wheels):
    """Its first stop fails."""

    failed = False

    def safe_stop(self):
        if not type(self).failed:
            type(self).failed = True
            raise OSError("the cable is loose")
        super().safe_stop()


def test_stop_that_failed_is_tried_again(fleet):
    Stubborn.failed = False
    driving = {"type": Driving, "rate_hz": 10.0}
    agent = fleet.start("a", devices={"motors": Stubborn}, filters={"first": scale()}, tasks={"Driving": driving})
    fleet.run_for(1.0)
    assert agent.ask(Configure("motors", {"filters": {"first": {"mode": "holds"}}})).ok
    fleet.run_for(0.3)
    assert Stubborn.failed and Wheels.told and Stubborn.told[-1][1] == "hold"
