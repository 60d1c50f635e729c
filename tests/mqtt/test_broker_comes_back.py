"""A broker that goes and comes back: nothing that is promised is lost, and nothing grows meanwhile."""

from __future__ import annotations

import json
import signal
import threading
from typing import Any

import pytest
from mqtt.brokers import Mosquitto
from pancakes_mqtt.bridge import MqttBridge
from pancakes_mqtt.packets import BrokerTraffic, Number
from pancakes_mqtt.sensors import MqttTemperature

from pancakes.control import Start, Stop
from pancakes.devices import Temperature
from pancakes.kernel.handlers import on, reliable
from pancakes.packet import Packet
from pancakes.task import Task
from pancakes.testing import AgentHandle, threaded_agent

NUMBERS = "numbers"
VERSIONS = pytest.mark.parametrize("protocol", ["5", "3.1.1"])


def service(broker: Mosquitto, **settings: Any) -> dict[str, Any]:
    publish = [
        {"channel": "system", "type": "mqtt.number", "topic": "out/0"},
        {"channel": "one", "type": "mqtt.number", "topic": "out/1", "qos": 1},
        {"channel": "two", "type": "mqtt.number", "topic": "out/2", "qos": 2},
    ]
    take = [{"topic": "in/+", "type": "mqtt.number", "channel": NUMBERS, "qos": 2}]
    tables = {"broker": broker.address, "report_s": 0.1, "publish": publish, "take": take}
    return {"mqtt": {"type": MqttBridge, "settings": {**tables, **settings}}}


def traffic(agent: AgentHandle) -> BrokerTraffic:
    """Returns how the service fares, as it says it after this was asked."""
    agent.probe.forget()
    found = agent.wait_for(BrokerTraffic).body
    assert isinstance(found, BrokerTraffic)
    return found


def is_there(agent: AgentHandle, broker: Mosquitto) -> None:
    agent.wait_until(lambda: "Sending SUBACK to pancakes-a-mqtt" in broker.log(), what="SUBACK")
    agent.wait_for(BrokerTraffic, lambda body: body.connected and not body.waiting)


def is_gone(agent: AgentHandle) -> None:
    agent.wait_until(lambda: any("is gone" in line for line in agent.lines("warning")), what="the broker is gone")


def taken(agent: AgentHandle) -> list[float]:
    return [packet.body.value for packet in agent.probe.packets(Number, channel=NUMBERS)]


@VERSIONS
def test_what_is_promised_while_the_broker_is_dead_arrives_once_and_in_order(broker: Mosquitto, protocol: str) -> None:
    with threaded_agent("a", services=service(broker, protocol=protocol)) as agent:
        is_there(agent, broker)
        for qos in "12":
            broker.remember(f"out/{qos}", f"watch{qos}")
        broker.kill()
        is_gone(agent)
        for number in range(100):
            for channel in ("one", "two", "system"):
                agent.publish(channel, Number(float(number)))
        # What is not promised is lost, and counted.
        agent.wait_for(BrokerTraffic, lambda body: (body.waiting, body.unsent) == (200, 100))
        agent.probe.forget()  # it said the same before the broker died
        broker.start()
        agent.wait_for(BrokerTraffic, lambda body: body.connected and not body.waiting)
        for qos in "12":
            with broker.remembered(f"out/{qos}", f"watch{qos}") as heard:
                numbers = [json.loads(next(heard)[1])["value"] for _ in range(100)]
            assert numbers == [float(number) for number in range(100)], f"QoS {qos}"
        assert traffic(agent).published == 202, "the two hundred, and the status twice"


def test_what_was_under_way_when_the_broker_was_killed_is_sent_again(broker: Mosquitto) -> None:
    with threaded_agent("a", services=service(broker)) as agent:
        is_there(agent, broker)
        broker.remember("out/2", "watch")
        broker.settle()
        broker.signal(signal.SIGSTOP)
        for number in range(50):
            agent.publish("two", Number(float(number)))
        agent.wait_for(BrokerTraffic, lambda body: body.waiting == 50)
        broker.kill(settled=False)
        is_gone(agent)
        agent.probe.forget()  # it said the same before the broker died
        broker.start()
        agent.wait_for(BrokerTraffic, lambda body: body.connected and not body.waiting)
        with broker.remembered("out/2", "watch") as heard:
            numbers = [json.loads(next(heard)[1])["value"] for _ in range(50)]
        assert numbers == [float(number) for number in range(50)]


@VERSIONS
def test_what_came_while_the_service_was_away_and_the_broker_was_killed_arrives_once(
    broker: Mosquitto, protocol: str
) -> None:
    with threaded_agent("a", services=service(broker, protocol=protocol)) as agent:
        is_there(agent, broker)
        assert agent.ask(Stop("mqtt")).ok
        agent.wait_until(lambda: "Received DISCONNECT from pancakes-a-mqtt" in broker.log())
        broker.pub_lines("in/1", [str(number) for number in range(50)], "-q", "1")
        broker.pub_lines("in/2", [str(number) for number in range(50, 100)], "-q", "2")
        broker.kill()
        broker.start()
        assert agent.ask(Start("mqtt")).ok
        agent.wait_until(lambda: len(taken(agent)) >= 100)
        broker.pub("in/1", "-1", "-q", "1")
        agent.wait_until(lambda: taken(agent)[-1] == -1)
        assert taken(agent) == [*map(float, range(100)), -1.0]


def test_a_sensor_hears_what_was_said_before_it_had_found_its_broker_again(broker: Mosquitto) -> None:
    device = {"type": MqttTemperature, "settings": {"broker": broker.address, "topic": "t", "qos": 1}}
    with threaded_agent("a", devices={"air": device}) as agent:
        agent.wait_until(lambda: "Sending SUBACK to pancakes-a-devices" in broker.log())
        broker.kill()
        is_gone(agent)
        broker.start()
        broker.pub("t", "21.5", "-q", "1")
        assert agent.wait_for(Temperature, timeout_s=10).body.celsius == 21.5
        agent.wait_until(lambda: sum("connected to the broker" in line for line in agent.lines("info")) == 2)
        assert not agent.events("task_failed")


def test_a_broker_that_comes_up_late_is_found_and_its_absence_said_once(broker: Mosquitto) -> None:
    broker.end()
    with threaded_agent("a", services=service(broker)) as agent:
        agent.wait_until(lambda: any("is not there" in line for line in agent.lines("warning")))
        for _ in range(10):
            traffic(agent)
        broker.start()
        is_there(agent, broker)
    lines = [line for line in agent.lines("warning") if "is not there" in line or "is gone" in line]
    assert len(lines) <= 1 and all("(connection refused); trying until it is" in line for line in lines)


def test_what_waits_is_bounded_and_what_finds_no_room_is_counted(broker: Mosquitto) -> None:
    with threaded_agent("a", services=service(broker, queue=100)) as agent:
        is_there(agent, broker)
        broker.kill()
        is_gone(agent)
        for number in range(500):
            agent.publish("one", Number(float(number)))
        agent.wait_for(BrokerTraffic, lambda body: (body.connected, body.waiting, body.unsent) == (False, 100, 400))


class Stubborn(Task):
    """Takes one packet, and no more until the test lets it."""

    blocking = True
    gate = threading.Event()

    @on(NUMBERS, Number, queue=reliable(10))
    def number(self, packet: Packet) -> None:
        self.gate.wait(30.0)


@pytest.fixture
def stubborn() -> Any:
    Stubborn.gate.clear()
    yield Stubborn
    Stubborn.gate.set()


def test_a_topic_that_floods_a_slow_reader_is_bounded_and_counted_and_the_agent_goes_on(
    broker: Mosquitto, stubborn: type[Stubborn]
) -> None:
    tasks = {"Stubborn": stubborn}
    with threaded_agent("a", services=service(broker, queue=100), tasks=tasks) as agent:
        is_there(agent, broker)
        broker.pub_lines("in/0", ["1"] * 5000)
        agent.wait_for(BrokerTraffic, lambda body: body.overflowed > 4000)
        told = traffic(agent)
        assert told.taken <= 20 and told.connected
        agent.publish("one", Number(7.0))
        agent.wait_for(BrokerTraffic, lambda body: body.published > told.published)
        stubborn.gate.set()
        agent.wait_for(BrokerTraffic, lambda body: body.taken + body.overflowed == 5000)


def test_what_is_promised_waits_at_the_broker_for_a_slow_reader_and_none_is_lost(
    broker: Mosquitto, stubborn: type[Stubborn]
) -> None:
    tasks = {"Stubborn": stubborn}
    with threaded_agent("a", services=service(broker, queue=20), tasks=tasks) as agent:
        is_there(agent, broker)
        broker.pub_lines("in/1", [str(number) for number in range(500)], "-q", "1")
        told = traffic(agent)
        assert told.taken <= 20 and told.overflowed == 0
        stubborn.gate.set()
        agent.wait_for(BrokerTraffic, lambda body: body.taken == 500)
        heard = {packet.body.value for packet in agent.probe.packets(Number, channel=NUMBERS)}
        assert len(heard) + told.taken == 500, "each once; the test has forgotten those before it looked"


def test_a_broker_that_does_not_answer_is_given_up_and_found_again(broker: Mosquitto) -> None:
    with threaded_agent("a", services=service(broker, keepalive_s=2)) as agent:
        is_there(agent, broker)
        broker.signal(signal.SIGSTOP)
        is_gone(agent)
        broker.signal(signal.SIGCONT)
        before = traffic(agent).connections
        agent.wait_for(BrokerTraffic, lambda body: body.connected and body.connections >= before)
