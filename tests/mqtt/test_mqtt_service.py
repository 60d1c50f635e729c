"""The service between an agent and a real broker."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from mqtt.brokers import Mosquitto
from pancakes_mqtt.bridge import MqttBridge
from pancakes_mqtt.packets import BrokerTraffic, Number

from pancakes.devices import Battery, Pose, Temperature
from pancakes.events import Event
from pancakes.packet import NETWORK, SYSTEM
from pancakes.settings import check_settings
from pancakes.testing import AgentHandle, threaded_agent

POSES = {"channel": "system", "type": "pose", "topic": "robots/{agent}/{name}/{type}"}


def service(broker: Mosquitto, **settings: Any) -> dict[str, Any]:
    return {"mqtt": {"type": MqttBridge, "settings": {"broker": broker.address, "report_s": 0.2, **settings}}}


def is_heard(agent: AgentHandle, broker: Mosquitto, count: int = 1) -> None:
    agent.wait_until(lambda: broker.log().count("Sending SUBACK to pancakes-") >= count, what="SUBACK")


def is_connected(agent: AgentHandle) -> None:
    agent.wait_for(BrokerTraffic, lambda body: body.connected)


def test_packets_become_messages_as_the_table_says(broker: Mosquitto) -> None:
    rows = [POSES, {"channel": "own", "topic": "all/{channel}/{source}", "payload": "packet", "qos": 1, "retain": True}]
    with threaded_agent("a", services=service(broker, publish=rows)) as agent, broker.listening("robots/#") as heard:
        is_connected(agent)
        agent.publish(SYSTEM, Temperature(1.0))
        agent.publish(SYSTEM, Pose(1.0, 2.0, 0.5))
        assert next(heard) == ("robots/a/Probe/pose", '{"x_m":1.0,"y_m":2.0,"theta_rad":0.5}')
        sent = agent.publish("own", Temperature(2.0))
        told = json.loads(broker.read("all/own/a/test/Probe"))
        assert told == {
            "source": "a/test/Probe",
            "type": "temperature",
            "stamp": sent.stamp_s,
            "seq": sent.seq,
            "body": {"celsius": 2.0},
        }


def test_a_number_that_is_none_is_null(broker: Mosquitto) -> None:
    rows = [{"channel": "system", "type": "battery", "topic": "b", "retain": True}]
    with threaded_agent("a", services=service(broker, publish=rows)) as agent:
        is_connected(agent)
        agent.publish(SYSTEM, Battery(math.nan, math.inf))
        assert broker.read("b") == '{"voltage_v":null,"level":null}'


def test_messages_become_packets_as_the_table_says(broker: Mosquitto) -> None:
    rows = [
        {"topic": "goal", "type": "pose"},
        {"topic": "zigbee2mqtt/+", "type": "mqtt.number", "channel": "system", "fields": {"value": "humidity"}},
        {"topic": "bare", "type": "temperature", "channel": "own"},
    ]
    with threaded_agent("a", services=service(broker, take=rows)) as agent:
        is_heard(agent, broker, 3)
        broker.pub("goal", '{"x_m": 1, "y_m": 2, "theta_rad": 0, "who": "else"}')
        found = agent.wait_for(Pose)
        assert (found.channel, found.source, found.body) == (NETWORK, "a/mqtt", Pose(1.0, 2.0, 0.0))
        broker.pub("zigbee2mqtt/shed", '{"humidity": 40}')
        assert agent.wait_for(Number, channel="system").body == Number(40.0)
        broker.pub("bare", "21.5")
        assert agent.wait_for(Temperature, channel="own").body == Temperature(21.5)


@pytest.mark.parametrize(
    ("payload", "complaint"),
    [
        ('{"x_m": "far", "y_m": 2, "theta_rad": 0}', "x_m: 'far' is not a number"),
        ('{"y_m": 2}', "missing required field `x_m`"),
        ("noise", "and the payload is not a JSON object"),
        ("[1, 2]", "and the payload is not a JSON object"),
        ("[" * 5000, "and the payload is not a JSON object"),
    ],
)
def test_what_fits_no_packet_is_named_once_and_counted(broker: Mosquitto, payload: str, complaint: str) -> None:
    rows = [{"topic": "goal", "type": "pose"}]
    with threaded_agent("a", services=service(broker, take=rows, report_s=60)) as agent:
        is_heard(agent, broker)
        broker.pub_lines("goal", [payload, payload, '{"x_m": 1, "y_m": 2, "theta_rad": 0}'])
        agent.wait_for(Pose)
        (line,) = [line for line in agent.lines("warning") if "is not a pose" in line]
        assert line.startswith("a message on goal is not a pose: ") and complaint in line


def test_what_the_service_takes_it_does_not_send_back(broker: Mosquitto) -> None:
    take = [{"topic": "pose/in", "type": "pose", "channel": "system"}]
    with threaded_agent("a", services=service(broker, publish=[POSES], take=take)) as agent:
        is_heard(agent, broker)
        with broker.listening("robots/#") as heard:
            broker.pub("pose/in", '{"x_m": 1, "y_m": 2, "theta_rad": 0}')
            agent.wait_for(Pose)
            agent.publish(SYSTEM, Pose(9.0, 9.0, 0.0))
            assert next(heard)[0] == "robots/a/Probe/pose"


def test_its_status_is_kept_by_the_broker(broker: Mosquitto) -> None:
    with threaded_agent("a", services=service(broker)) as agent:
        is_connected(agent)
        assert broker.read("pancakes/a/status") == "online"
    with broker.listening("pancakes/a/status") as heard:
        assert next(status for _, status in heard if status == "offline") == "offline"


def test_rates_are_bounded_for_each_publisher(broker: Mosquitto) -> None:
    rows = [{**POSES, "max_hz": 0.01}]
    with threaded_agent("a", services=service(broker, publish=rows)) as agent, broker.listening("robots/#") as heard:
        is_connected(agent)
        for number in range(50):
            agent.publish(SYSTEM, Pose(float(number), 0.0, 0.0))
        assert next(heard)[1].startswith('{"x_m":0.0')
        agent.wait_for(BrokerTraffic, lambda body: body.published >= 2)
        assert agent.probe.packets(BrokerTraffic)[-1].body.published == 2, "its status and one pose"


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"take": [{"topic": "t", "type": "pose", "channel": "sysctrl"}]}, "messages cannot become packets on sysctrl"),
        ({"take": [{"topic": "t", "type": "pose", "channel": "log"}]}, "messages cannot become packets on log"),
        ({"take": [{"topic": "a/#b", "type": "pose"}]}, "# must be alone"),
        (
            {"publish": [{"channel": "system", "topic": "x/{robot}"}]},
            "has the placeholder {robot}; known are {agent}, {source}",
        ),
        ({"publish": [{"channel": "system", "topic": "x/+"}]}, "only filters may contain +"),
        ({"publish": [{"channel": "a b", "topic": "x"}]}, "a b"),
        ({"status": "a/#"}, "status: "),
    ],
)
def test_tables_that_make_no_sense_are_named(settings: dict[str, Any], problem: str) -> None:
    assert problem in "; ".join(map(str, check_settings(MqttBridge.Settings, settings)))


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        ({"topic": "t", "type": "posse"}, "no packet type 'posse' is installed here, did you mean 'pose'?"),
        ({"topic": "t", "type": "pose", "fields": {"x": "a"}}, "pose has no field 'x'"),
    ],
)
def test_a_type_that_is_not_there_is_named(broker: Mosquitto, row: dict[str, Any], problem: str) -> None:
    with threaded_agent("a", services=service(broker, take=[row])) as agent:
        failed = agent.wait_for(Event, lambda body: body.kind == "service_failed")
        assert problem in failed.body.fields["error"]


def test_it_refuses_virtual_time_with_a_sentence(virtual_agent: Any) -> None:
    agent = virtual_agent("a", services={"mqtt": MqttBridge})
    failed = agent.wait_for_event("service_failed", service="mqtt")
    assert "a/mqtt needs a broker, which has no virtual time: leave it out then" in failed["error"]
