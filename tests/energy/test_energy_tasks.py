"""The governor and the supervisor on agents in virtual time: real tasks turned by real packets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest

from pancakes.control import Configure, Describe, Reschedule, Restart, Start, Stop
from pancakes.devices import Battery, Load, Motion
from pancakes.devices.driver import Sensor
from pancakes.energy.governor import EnergyGovernor
from pancakes.energy.rate_supervisor import RateSupervisor
from pancakes.events import Event
from pancakes.packet import LOG, SYSTEM
from pancakes.task import Task, Tick, every
from pancakes.testing import AgentHandle, Fleet


class Gauge(Sensor):
    """A battery whose level a test sets."""

    type = "battery"
    level = 1.0

    def read(self) -> Battery:
        return Battery(8.0, Gauge.level)


class Eye(Sensor):
    """A motion sensor that sees what a test lets it see."""

    type = "motion"
    seen = False

    def read(self) -> Motion:
        return Motion(Eye.seen)


class Wheels(Task):
    """Something that drives, and could drive slower."""

    @dataclass
    class Settings:
        speed_mps: float = 0.1

    settings: Settings

    @every(hz=10)
    def drive(self, tick: Tick) -> None:
        pass


@pytest.fixture(autouse=True)
def _as_new():
    Gauge.level, Eye.seen = 1.0, False


DEVICES = {"battery": {"type": Gauge, "rate_hz": 1}, "motion": {"type": Eye, "rate_hz": 5}}
GOVERNED: dict[str, Any] = {
    "thresholds": [{"below": 0.6, "effort": 0.5}, {"below": 0.3, "effort": 0.0}],
    "rates": {"device/motion": {"full": 5, "least": 1}, "network/Discovery": {"full": 1, "least": 0.2}},
    "values": {"Wheels": {"speed_mps": {"full": 0.1, "least": 0.04}}},
}


def governed(fleet: Fleet, **changes: Any) -> AgentHandle:
    settings = {**GOVERNED, **changes}
    tasks = {"Wheels": Wheels, "Governor": {"type": EnergyGovernor, "settings": settings}}
    return fleet.start("a", devices=DEVICES, tasks=tasks)


def standing(agent: AgentHandle) -> tuple[float, float, float]:
    """Where the three knobs really stand."""
    motion, beacons = agent.component("device/motion"), agent.component("network/Discovery")
    return (
        round(motion.timers["read"].rate_hz, 6),
        round(beacons.timers["announce"].rate_hz, 6),
        agent.task("Wheels").settings.speed_mps,
    )


def orders(agent: AgentHandle) -> int:
    """How many orders the governor has given."""
    asked = (Reschedule, Configure, Start, Stop)
    return sum(len(agent.probe.packets(body, source="a/client/Governor")) for body in asked)


def test_the_governor_turns_real_tasks_down_and_up_again():
    with Fleet() as fleet:
        agent = governed(fleet)
        fleet.run_for(10.0)
        assert standing(agent) == (5.0, 1.0, 0.1)
        assert orders(agent) == 0
        Gauge.level = 0.5
        fleet.run_for(5.0)
        assert standing(agent) == (3.0, 0.6, 0.07)
        Gauge.level = 0.2
        fleet.run_for(5.0)
        assert standing(agent) == (1.0, 0.2, 0.04)
        Gauge.level = 0.9
        fleet.run_for(5.0)
        assert standing(agent) == (5.0, 1.0, 0.1)
        assert [event["effort"] for event in agent.events("effort_changed")] == [0.5, 0.0, 1.0]
        assert orders(agent) == 9, "three knobs, three times"


def test_no_order_is_repeated_while_nothing_changes():
    with Fleet() as fleet:
        agent = governed(fleet)
        Gauge.level = 0.2
        fleet.run_for(5.0)
        given = orders(agent)
        for step in range(40):
            Gauge.level = 0.3 + (0.02 if step % 2 else -0.02)
            fleet.run_for(5.0)
        assert orders(agent) == given == 3


def test_a_refusal_is_logged_in_clear_words_and_made_good_when_the_task_starts():
    with Fleet() as fleet:
        agent = governed(fleet)
        assert agent.ask(Stop("Wheels")).ok
        Gauge.level = 0.2
        fleet.run_for(60.0)
        said = [line for line in agent.lines("warning") if "Wheels" in line]
        assert said == ["speed_mps of Wheels was not set to 0.04: a/client/Wheels is stopped, not running"]
        assert agent.ask(Start("Wheels")).ok
        fleet.run_for(3.0)
        assert standing(agent)[2] == 0.04


def test_a_target_that_does_not_exist_is_named_once():
    with Fleet() as fleet:
        agent = governed(fleet, rates={"device/mtion": {"full": 5, "least": 1}})
        Gauge.level = 0.2
        fleet.run_for(60.0)
        (said,) = [line for line in agent.lines("warning") if "mtion" in line]
        assert said.startswith("the rate of device/mtion was not set to 1: ")


def test_the_network_really_sleeps_and_is_awake_again_when_the_battery_is_full():
    with Fleet() as fleet:
        agent = governed(fleet, sleep={"every_s": 20, "for_s": 10})
        other = fleet.start("b")
        fleet.connect()
        Gauge.level = 0.2
        agent.wait_for_event("service_stopped", service="network")
        fleet.run_for(1.0)
        assert other.agent.mesh.connected() == {}
        agent.wait_until(lambda: agent.component("network/Discovery") is not None, 12.0, "the network's waking")
        fleet.run_for(3.0)
        assert standing(agent)[1] == 0.2, "the beacons are as slow as before the sleep"
        fleet.run_for(100.0)
        sleeps = agent.events("service_stopped", service="network")
        assert len(sleeps) in (5, 6), "once in 20 s"
        beacons = agent.events("rate_changed", task="Discovery")
        assert len(beacons) == 1, "a sleep makes nobody forget its rate, so no order is repeated"
        Gauge.level = 1.0
        fleet.run_for(5.0)
        fleet.connect()
        assert standing(agent) == (5.0, 1.0, 0.1)
        slept = len(agent.events("service_stopped", service="network"))
        fleet.run_for(60.0)
        assert len(agent.events("service_stopped", service="network")) == slept


def test_a_governor_that_is_stopped_gives_everything_back_and_takes_it_again():
    with Fleet() as fleet:
        agent = governed(fleet)
        Gauge.level = 0.2
        fleet.run_for(5.0)
        assert agent.ask(Stop("Governor")).ok
        fleet.run_for(1.0)
        assert standing(agent) == (5.0, 1.0, 0.1)
        assert agent.ask(Start("Governor")).ok
        fleet.run_for(3.0)
        assert standing(agent) == (1.0, 0.2, 0.04)


def test_a_governor_that_is_stopped_while_the_network_sleeps_wakes_it():
    with Fleet() as fleet:
        agent = governed(fleet, sleep={"every_s": 60, "for_s": 50})
        Gauge.level = 0.2
        agent.wait_for_event("service_stopped", service="network")
        fleet.run_for(3.0)
        assert agent.ask(Stop("Governor")).ok
        fleet.run_for(1.0)
        assert standing(agent) == (5.0, 1.0, 0.1)


def test_an_agent_that_ends_has_nothing_to_give_back():
    with Fleet() as fleet:
        agent = governed(fleet, sleep={"every_s": 60, "for_s": 50})
        Gauge.level = 0.2
        fleet.run_for(5.0)
        given = orders(agent)
        fleet.stop("a")
        assert orders(agent) == given
        agent = fleet.restart("a")
        fleet.run_for(5.0)
        assert agent.component("device/motion").timers["read"].rate_hz == pytest.approx(1.0), "it goes on where it was"
        assert agent.task("Wheels").settings.speed_mps == 0.04


def test_a_governor_that_crashed_goes_on_without_repeating_its_orders():
    with Fleet() as fleet:
        agent = governed(fleet)
        Gauge.level = 0.2
        fleet.run_for(5.0)
        given = orders(agent)
        governor = agent.task("Governor")
        governor.call(lambda: 1 / 0)
        fleet.run_for(5.0)
        assert agent.task("Governor") is not governor
        assert standing(agent) == (1.0, 0.2, 0.04)
        assert orders(agent) == given, "it has asked what holds, and found it as it should be"
        assert agent.probe.packets(Describe, source="a/client/Governor")


def test_new_settings_count_at_once():
    with Fleet() as fleet:
        agent = governed(fleet)
        Gauge.level = 0.2
        fleet.run_for(5.0)
        changed = {"rates": {"device/motion": {"full": 5, "least": 2}}}
        assert agent.ask(Configure("Governor", changed)).ok
        fleet.run_for(3.0)
        assert standing(agent) == (2.0, 1.0, 0.04), "the beacons are governed no more"
        refused = agent.ask(Configure("Governor", {"policy": "feedback"}))
        assert "needs a table feedback" in refused.reason


def test_a_foreign_battery_is_no_concern():
    with Fleet() as fleet:
        agent = governed(fleet)
        other = fleet.start("b")
        fleet.connect()
        for _ in range(10):
            other.publish(SYSTEM, Battery(6.0, 0.05), to="a")
            fleet.run_for(1.0)
        assert agent.probe.packets(Battery, lambda body: body.level == 0.05), "it has come"
        assert orders(agent) == 0


def test_a_service_of_another_agent_that_stops_is_no_concern():
    with Fleet() as fleet:
        agent = governed(fleet)
        other = fleet.start("b")
        fleet.connect()
        other.publish(LOG, Event("service_stopped", {"service": "network"}), to="a")
        fleet.run_for(2.0)
        Gauge.level = 0.2
        fleet.run_for(5.0)
        assert standing(agent) == (1.0, 0.2, 0.04)


def test_feedback_lets_a_battery_last_that_pays_for_what_is_done():
    """A closed loop: the governor turns the rate, the rate empties the battery."""
    with Fleet() as fleet:
        feedback = {"until_s": 600, "reserve": 0.1, "period_s": 20}
        only = {"rates": {"device/motion": {"full": 5, "least": 0.5}}, "values": {}}
        agent = governed(fleet, policy="feedback", feedback=feedback, **only)
        heard = 0
        while fleet.now() < 600.0:
            fleet.run_for(1.0)
            readings = len(agent.probe.packets(Motion))
            Gauge.level = max(Gauge.level - 0.0003 - 0.0006 * (readings - heard), 0.0)
            heard = readings
        assert Gauge.level == pytest.approx(0.1, abs=0.03), "at 5 readings a second it would have lasted 303 s"


def test_feedback_gives_way_to_a_busy_processor():
    class Busy(Sensor):
        type = "load"

        def read(self) -> Load:
            return Load(0.95)

    with Fleet() as fleet:
        feedback = {"until_s": 100_000, "period_s": 10, "load_at_most": 0.7}
        settings = {**GOVERNED, "policy": "feedback", "feedback": feedback}
        tasks = {"Wheels": Wheels, "Governor": {"type": EnergyGovernor, "settings": settings}}
        devices = {**DEVICES, "load": {"type": Busy, "rate_hz": 1}}
        agent = fleet.start("a", devices=devices, tasks=tasks)
        fleet.run_for(300.0)
        assert standing(agent) == (1.0, 0.2, 0.04)


def test_the_load_of_another_agent_is_no_concern():
    with Fleet() as fleet:
        feedback = {"until_s": 100_000, "period_s": 10, "load_at_most": 0.7}
        agent = governed(fleet, policy="feedback", feedback=feedback)
        other = fleet.start("b")
        fleet.connect()
        for _ in range(60):
            other.publish(SYSTEM, Load(0.95), to="a")
            fleet.run_for(1.0)
        assert agent.probe.packets(Load), "it has come"
        assert orders(agent) == 0


RULES = {"moves": {"when": "motion", "field": "detected", "above": 0.5, "quiet_after_s": 10}}
PACES = {"device/battery": {"fast": 1, "slow": 0.2}, "Wheels": {"fast": 10, "slow": 1}}


def supervised(fleet: Fleet, **changes: Any) -> AgentHandle:
    rules = {"moves": {**RULES["moves"], "rates": PACES, **changes}}
    tasks = {"Wheels": Wheels, "Supervisor": {"type": RateSupervisor, "settings": {"rules": rules}}}
    return fleet.start("a", devices=DEVICES, tasks=tasks)


def rates(agent: AgentHandle) -> tuple[float, float]:
    battery = agent.component("device/battery").timers["read"].rate_hz
    return round(battery, 6), round(agent.component("client/Wheels").timers["drive"].rate_hz, 6)


def test_the_supervisor_slows_sensors_down_while_it_is_quiet_and_is_fast_at_once():
    with Fleet() as fleet:
        agent = supervised(fleet)
        fleet.run_for(5.0)
        assert rates(agent) == (1.0, 10.0)
        fleet.run_for(10.0)
        assert rates(agent) == (0.2, 1.0)
        Eye.seen = True
        fleet.run_for(0.25)
        assert rates(agent) == (1.0, 10.0), "the next reading of the eye is enough"
        fleet.run_for(30.0)
        assert rates(agent) == (1.0, 10.0)
        assert [event["kind"] for event in agent.events(rule="moves")] == ["quiet", "busy"]


def test_packets_of_neighbours_count_only_where_the_rule_says_so():
    for include_remote in (False, True):
        with Fleet() as fleet:
            agent = supervised(fleet, include_remote=include_remote)
            other = fleet.start("b")
            fleet.connect()
            for _ in range(20):
                other.publish(SYSTEM, Motion(True), to="a")
                fleet.run_for(1.0)
            assert rates(agent) == ((1.0, 10.0) if include_remote else (0.2, 1.0))


def test_a_supervisor_that_is_stopped_lets_all_be_fast():
    with Fleet() as fleet:
        agent = supervised(fleet)
        fleet.run_for(15.0)
        assert rates(agent) == (0.2, 1.0)
        assert agent.ask(Stop("Supervisor")).ok
        fleet.run_for(1.0)
        assert rates(agent) == (1.0, 10.0)


def test_a_supervisor_that_was_restarted_finds_what_was_slow():
    with Fleet() as fleet:
        agent = supervised(fleet)
        fleet.run_for(15.0)
        agent.task("Supervisor").call(lambda: 1 / 0)
        fleet.run_for(5.0)
        assert rates(agent) == (1.0, 10.0), "who has just begun had better look"
        fleet.run_for(15.0)
        assert rates(agent) == (0.2, 1.0)
        assert agent.ask(Restart("Wheels", keep_state=False)).ok
        fleet.run_for(3.0)
        assert rates(agent) == (0.2, 1.0), "it had forgotten its rate, and was told it again"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"when": "moton"}, "unknown type 'moton', did you mean 'motion'?"),
        ({"field": "detectd"}, "motion has no field 'detectd', only detected, bearing_rad, range_m"),
    ],
)
def test_a_rule_about_nothing_that_exists_is_refused_and_changes_nothing(change, said):
    with Fleet() as fleet:
        agent = supervised(fleet)
        rule = {**RULES["moves"], "rates": PACES, **change}
        assert said in agent.ask(Configure("Supervisor", {"rules": {"moves": rule}})).reason
        kept = agent.task("Supervisor").settings.rules["moves"]
        assert (kept.when, kept.field) == ("motion", "detected")
        fleet.run_for(15.0)
        assert rates(agent) == (0.2, 1.0), "the old rule still holds"
