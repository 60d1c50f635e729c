"""The tasks of a sensor field on agents in virtual time, whose sensors say what a test lets them say."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from pancakes_sensor_field.alarm import Alarm
from pancakes_sensor_field.drivers import TinyMotion, TinyTemperature
from pancakes_sensor_field.duty_cycle import DutyCycle
from pancakes_sensor_field.packets import Activity, AlarmCleared, AlarmRaised, Report, ReportPeriod
from pancakes_sensor_field.watch import Watch

from pancakes.control import Configure, Migrate, Stop
from pancakes.devices import Motion, Temperature
from pancakes.devices.builtin_drivers import NullMotion, NullSensor, NullTemperature
from pancakes.packet import Packet, task_address
from pancakes.testing import AgentHandle, Fleet

ALARM = {"type": Alarm, "durability": "each", "settings": {"tally_s": 5.0}}
SENSES = {"temperature": TinyTemperature, "motion": TinyMotion}
BLIND = {"temperature": NullTemperature, "motion": NullMotion}


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    with Fleet() as made:
        yield made


def feel(agent: AgentHandle, body: Any, device: str = "") -> None:
    """Lets a node's sensor say something."""
    kind = device or ("motion" if isinstance(body, Motion) else "temperature")
    agent.publish("system", body, to=f"{agent.name}/device/{kind}")


def report(agent: AgentHandle, node: str, number: int, celsius: float, moving: bool) -> None:
    """Lets some node report to the alarm that was born on `gateway`."""
    agent.publish("system", Report(node, number, celsius, moving), to=task_address("gateway/Alarm"))


# Watch -----------------------------------------------------------------------------------------------------------


def watched(fleet: Fleet, **settings: Any) -> AgentHandle:
    settings = {"alarm": "node/Alarm", **settings}
    tasks = {"Alarm": ALARM, "Watch": {"type": Watch, "rate_hz": 0.1, "settings": settings}}
    return fleet.start("node", devices=SENSES, tasks=tasks)


def reports(agent: AgentHandle) -> dict[str, list[Any]]:
    """Returns what the alarm on an agent remembers of each node."""
    nodes = agent.task("Alarm").state.nodes
    return {name: [node.received, node.celsius, node.moving] for name, node in nodes.items()}


def test_a_watch_reports_at_its_rate_and_at_once_when_something_happens(fleet: Fleet) -> None:
    node = watched(fleet)
    fleet.run_for(15.0)
    assert reports(node) == {}, "it has not felt anything yet"
    feel(node, Temperature(20.0))
    fleet.run_for(10.0)
    assert reports(node) == {"node": [1, 20.0, False]}
    feel(node, Motion(True))
    fleet.run_for(0.1)
    assert reports(node) == {"node": [2, 20.0, True]}
    feel(node, Motion(True))
    feel(node, Temperature(29.9))
    fleet.run_for(0.1)
    assert reports(node)["node"][0] == 2, "no news"
    feel(node, Temperature(31.0))
    fleet.run_for(0.1)
    assert reports(node) == {"node": [3, 31.0, True]}
    assert node.task("Watch").state.reports == 3


def test_a_watch_says_to_its_own_agent_when_something_happens_and_when_no_more(fleet: Fleet) -> None:
    node = watched(fleet)
    for body in (Motion(True), Temperature(40.0), Motion(False), Temperature(20.0)):
        feel(node, body)
        fleet.run_for(0.1)
    assert [packet.body for packet in node.probe.packets(Activity)] == [Activity("node", True), Activity("node", False)]


def test_a_watch_of_a_tiny_node_takes_the_devices_that_stand_for_it(fleet: Fleet) -> None:
    devices = {**SENSES, "shed_temperature": TinyTemperature, "shed_motion": TinyMotion}
    settings = {"alarm": "node/Alarm", "node": "shed", "temperature": "shed_temperature", "motion": "shed_motion"}
    node = fleet.start("node", devices=devices, tasks={"Alarm": ALARM, "Watch": {"type": Watch, "settings": settings}})
    feel(node, Motion(True))
    fleet.run_for(0.1)
    assert reports(node) == {}
    feel(node, Motion(True), "shed_motion")
    fleet.run_for(0.1)
    assert reports(node) == {"shed": [1, None, True]}


# Alarm -----------------------------------------------------------------------------------------------------------


def test_motion_and_heat_raise_one_alarm_which_is_said_until_it_is_over(fleet: Fleet) -> None:
    gateway = fleet.start("gateway", devices=BLIND, tasks={"Alarm": ALARM})
    neighbour = fleet.start("north", devices=BLIND)
    fleet.connect()
    report(gateway, "a", 1, 50.0, False)
    fleet.run_for(3.0)
    assert not gateway.events("alarm_raised")
    report(gateway, "b", 1, 20.0, True)
    fleet.run_for(5.0)
    (raised,) = gateway.events("alarm_raised")
    assert (raised["number"], raised["weight"], raised["moving"], raised["hot"]) == (1, 3.0, ["b"], ["a"])
    assert [packet.body.number for packet in neighbour.probe.packets(AlarmRaised)] == [1, 1, 1], "every 2 s"
    report(gateway, "b", 2, 20.0, False)
    fleet.run_for(40.0)
    assert [event["number"] for event in gateway.events("alarm_cleared")] == [1]
    assert [packet.body for packet in neighbour.probe.packets(AlarmCleared)] == [AlarmCleared(1)]
    said = len(neighbour.probe.packets(AlarmRaised))
    fleet.run_for(10.0)
    assert len(neighbour.probe.packets(AlarmRaised)) == said


def test_the_open_alarm_its_count_and_its_evidence_move_and_no_report_is_lost(fleet: Fleet) -> None:
    gateway = fleet.start("gateway", devices=BLIND, tasks={"Alarm": ALARM})
    north = fleet.start("north", devices=BLIND)
    fleet.connect()
    report(gateway, "a", 1, 50.0, True)
    gateway.wait_for_event("alarm_raised")
    assert gateway.ask(Migrate("Alarm")).ok
    for number in range(2, 6):
        report(gateway, "a", number, 20.0, False)
        report(north, "b", number - 1, 20.0, False)
    fleet.run_for(3.0)
    assert gateway.running() == [] and north.running() == ["Alarm"]
    state = north.task("Alarm").state
    assert state.open and state.alarms == 1 and not north.events("alarm_raised"), "it is the same alarm"
    assert {name: (node.received, node.highest) for name, node in state.nodes.items()} == {"a": (5, 5), "b": (4, 4)}
    assert north.wait_for_event("tally")["heard"] == {"a": [5, 5], "b": [4, 4]}
    north.wait_for_event("alarm_cleared", 60.0, number=1)
    report(north, "b", 5, 60.0, True)
    assert north.wait_for_event("alarm_raised")["number"] == 2


def test_an_agent_without_what_the_alarm_requires_refuses_it(fleet: Fleet) -> None:
    gateway = fleet.start("gateway", devices=BLIND, tasks={"Alarm": ALARM})
    fleet.start("north", devices={"temperature": NullTemperature})
    fleet.connect()
    reply = gateway.ask(Migrate("Alarm"))
    assert not reply.ok and "north: lacks the device type motion" in reply.reason
    assert gateway.running() == ["Alarm"]


# DutyCycle -------------------------------------------------------------------------------------------------------

SLEEPY = {
    "rates": {"device/motion": {"quiet_hz": 1.0, "busy_hz": 4.0}},
    "linger_s": 5.0,
    "sleep_s": 20.0,
    "awake_s": 3.0,
    "hosts": ["Alarm"],
}


def sleeper(fleet: Fleet, **tasks: Any) -> AgentHandle:
    """Starts a node that sleeps while nothing happens, and one that always listens."""
    gateway = fleet.start("gateway")
    duty = {"type": DutyCycle, "settings": SLEEPY}
    fleet.start("node", devices=BLIND, tasks={"DutyCycle": duty, **tasks})
    fleet.connect()
    return gateway


def awake(gateway: AgentHandle) -> bool:
    """Returns whether the node can be reached."""
    return "node" in gateway.agent.mesh.connected()


def rate_hz(agent: AgentHandle, task: str) -> float:
    return 1.0 / agent.component(f"device/{task}").timers["read"].period_s


def test_a_quiet_node_sleeps_most_of_the_time_and_looks_in_now_and_then(fleet: Fleet) -> None:
    gateway = sleeper(fleet)
    seen = []
    for _ in range(100):
        fleet.run_for(1.0)
        seen.append(awake(gateway))
    assert 10 <= sum(seen) <= 25
    assert not any(seen[8:20]) and any(seen[20:30]) and any(seen[45:55])
    assert rate_hz(fleet.agents["node"], "motion") == 1.0


def test_what_happens_wakes_it_at_once_and_raises_its_rates(fleet: Fleet) -> None:
    gateway = sleeper(fleet)
    node = fleet.agents["node"]
    fleet.run_for(10.0)
    assert not awake(gateway)
    node.publish("system", Activity("node", True))
    fleet.run_for(0.5)
    assert awake(gateway) and rate_hz(node, "motion") == 4.0
    fleet.run_for(60.0)
    assert awake(gateway), "for as long as it happens"
    node.publish("system", Activity("node", False))
    fleet.run_for(4.5)
    assert awake(gateway) and rate_hz(node, "motion") == 4.0, "and a while longer"
    fleet.run_for(10.0)
    assert not awake(gateway) and rate_hz(node, "motion") == 1.0
    assert [event["busy"] for event in node.events("duty")] == [True, False]


def test_an_alarm_keeps_those_awake_that_hear_of_it(fleet: Fleet) -> None:
    gateway = sleeper(fleet)
    fleet.run_for(2.0)
    for _ in range(10):
        gateway.publish("system", AlarmRaised(1, 3.0, (), ()), to="*")
        fleet.run_for(2.0)
    assert awake(gateway) and rate_hz(fleet.agents["node"], "motion") == 4.0
    fleet.run_for(12.0)
    assert not awake(gateway)


def test_an_agent_that_has_the_alarm_stays_in_reach(fleet: Fleet) -> None:
    gateway = sleeper(fleet, Alarm={**ALARM, "start": True})
    fleet.run_for(60.0)
    assert awake(gateway)


def test_an_alarm_that_arrives_keeps_its_new_agent_awake(fleet: Fleet) -> None:
    gateway = fleet.start("gateway", devices=BLIND, tasks={"Alarm": ALARM})
    fleet.start("node", devices=BLIND, tasks={"DutyCycle": {"type": DutyCycle, "settings": SLEEPY}})
    fleet.connect()
    assert gateway.ask(Migrate("Alarm")).ok
    fleet.run_for(60.0)
    assert awake(gateway) and "Alarm" in fleet.agents["node"].running()


def test_reports_wait_for_a_network_that_sleeps(fleet: Fleet) -> None:
    gateway = fleet.start("gateway", devices=BLIND, tasks={"Alarm": ALARM})
    watch = {"type": Watch, "rate_hz": 0.5, "settings": {"alarm": "gateway/Alarm"}}
    duty = {"type": DutyCycle, "settings": {**SLEEPY, "hosts": []}}
    node = fleet.start("node", devices=SENSES, tasks={"Watch": watch, "DutyCycle": duty})
    fleet.connect()
    feel(node, Temperature(20.0))
    fleet.run_for(18.0)
    made, come = node.task("Watch").state.reports, gateway.task("Alarm").state.nodes["node"].received
    assert not awake(gateway) and made > come
    fleet.run_for(10.0)
    remembered = gateway.task("Alarm").state.nodes["node"]
    assert remembered.received == remembered.highest >= made


def test_what_was_reported_late_counts_from_when_it_was_seen(fleet: Fleet) -> None:
    gateway = fleet.start("gateway", devices=BLIND, tasks={"Alarm": ALARM})
    watch = {"type": Watch, "rate_hz": 0.5, "settings": {"alarm": "gateway/Alarm"}}
    node = fleet.start("node", devices=SENSES, tasks={"Watch": watch})
    fleet.connect()
    node.publish("sysctrl", Stop("network", for_s=15.0))
    fleet.run_for(1.0)
    for moving in (True, False):
        feel(node, Motion(moving))
        fleet.run_for(0.5)
    seen_s = fleet.now()
    fleet.run_for(20.0)
    assert gateway.task("Alarm").state.nodes["node"].moved_s == pytest.approx(seen_s, abs=1.0)


class Line(NullSensor):
    """A line that says what it is told."""

    type = "sensor_field.line"

    def receive(self, packet: Packet) -> None:
        assert isinstance(packet.body, ReportPeriod) and not packet.body.node
        self.context.log("info", f"every {packet.body.period_s:g} s")


def test_lines_are_told_how_often_their_tiny_nodes_report(fleet: Fleet) -> None:
    duty = {"type": DutyCycle, "settings": {"lines": {"tiny": {"quiet_s": 10.0, "busy_s": 1.0}}}}
    gateway = fleet.start("gateway", devices={"tiny": Line}, tasks={"DutyCycle": duty})
    fleet.run_for(2.0)
    gateway.publish("system", Activity("shed", True))
    fleet.run_for(2.0)
    assert [line for line in gateway.lines("info") if "every" in line] == ["tiny: every 10 s", "tiny: every 1 s"]


def test_what_cannot_be_slowed_down_is_named(fleet: Fleet) -> None:
    settings = {"rates": {"client/Nobody": {"quiet_hz": 1.0, "busy_hz": 2.0}}}
    node = fleet.start("node", tasks={"DutyCycle": {"type": DutyCycle, "settings": settings}})
    fleet.run_for(2.0)
    assert any(line.startswith("client/Nobody did not change its rate: ") for line in node.lines("warning"))


def test_new_settings_count_at_once(fleet: Fleet) -> None:
    gateway = sleeper(fleet)
    node = fleet.agents["node"]
    fleet.run_for(2.0)
    rates = {"device/motion": {"quiet_hz": 0.5, "busy_hz": 2.0}}
    assert node.ask(Configure("DutyCycle", {"rates": rates, "sleep_s": 0.0})).ok
    fleet.run_for(60.0)
    assert awake(gateway) and rate_hz(node, "motion") == 0.5
