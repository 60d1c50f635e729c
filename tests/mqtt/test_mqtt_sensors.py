"""Sensors behind a real broker: their messages become readings."""

from __future__ import annotations

import math
from typing import Any

import pytest
from mqtt.brokers import Mosquitto
from pancakes_mqtt.packets import Number
from pancakes_mqtt.sensors import MqttBattery, MqttDistance, MqttMotion, MqttNumber, MqttPose, MqttTemperature

from pancakes.control import Describe, Stop
from pancakes.devices import Battery, Motion, Pose, Sonar, Temperature
from pancakes.settings import check_settings
from pancakes.testing import AgentHandle, threaded_agent


def device(cls: type, broker: Mosquitto, **settings: Any) -> dict[str, Any]:
    return {"device": {"type": cls, "settings": {"broker": broker.address, **settings}}}


def is_heard(agent: AgentHandle, broker: Mosquitto, count: int = 1) -> None:
    """Waits until the broker has said that it sends what the agent asked for."""
    agent.wait_until(lambda: broker.log().count("Sending SUBACK to pancakes-") >= count, what="SUBACK")


ZIGBEE = '{"battery":97,"humidity":41.5,"linkquality":120,"occupancy":true,"temperature":21.5,"voltage":3000}'
TASMOTA = '{"Time":"2026-11-25T10:00:00","SI7021":{"Temperature":68.0,"Humidity":40.1},"TempUnit":"F"}'
SR04 = '{"Time":"2026-11-25T10:00:00","SR04":{"Distance":123.5}}'


@pytest.mark.parametrize(
    ("cls", "settings", "topic", "payload", "body"),
    [
        (MqttTemperature, {"form": "zigbee2mqtt", "device": "shed"}, "zigbee2mqtt/shed", ZIGBEE, Temperature(21.5)),
        (MqttMotion, {"form": "zigbee2mqtt", "device": "shed"}, "zigbee2mqtt/shed", ZIGBEE, Motion(True)),
        (
            MqttBattery,
            {"form": "zigbee2mqtt", "device": "shed", "voltage": "voltage", "voltage_unit": "mV"},
            "zigbee2mqtt/shed",
            ZIGBEE,
            Battery(3.0, 0.97),
        ),
        (
            MqttNumber,
            {"form": "zigbee2mqtt", "device": "shed", "field": "humidity", "unit": "%"},
            "zigbee2mqtt/shed",
            ZIGBEE,
            Number(41.5, "%"),
        ),
        (
            MqttTemperature,
            {"form": "esphome", "device": "yard/air"},
            "yard/sensor/air/state",
            "-3.25",
            Temperature(-3.25),
        ),
        (MqttMotion, {"form": "esphome", "device": "yard/pir"}, "yard/binary_sensor/pir/state", "OFF", Motion(False)),
        (
            MqttDistance,
            {"form": "esphome", "device": "yard/far", "bearing_rad": 0.5},
            "yard/sensor/far/state",
            "1.25",
            Sonar((0.5,), (1.25,), 4.0),
        ),
        (MqttTemperature, {"form": "tasmota", "device": "attic"}, "tele/attic/SENSOR", TASMOTA, Temperature(20.0)),
        (MqttMotion, {"form": "tasmota", "device": "attic"}, "stat/attic/POWER", "ON", Motion(True)),
        (
            MqttDistance,
            {"form": "tasmota", "device": "attic", "metres": 0.01},
            "tele/attic/SENSOR",
            SR04,
            Sonar((0.0,), (1.235,), 4.0),
        ),
        (
            MqttTemperature,
            {"topic": "own/+/air", "field": "rooms.1.celsius", "unit": "K"},
            "own/house/air",
            '{"rooms": [{"celsius": 1}, {"celsius": 273.15}]}',
            Temperature(0.0),
        ),
        (
            MqttPose,
            {"topic": "tracker/r1", "field": "pose"},
            "tracker/r1",
            '{"pose": {"x": 1.5, "y": -2, "theta": 0.25}}',
            Pose(1.5, -2.0, 0.25),
        ),
    ],
    ids=lambda value: str(value)[:40] if isinstance(value, str) else None,
)
def test_what_a_device_says_is_a_reading(
    broker: Mosquitto, cls: type, settings: dict[str, Any], topic: str, payload: str, body: Any
) -> None:
    with threaded_agent("a", devices=device(cls, broker, **settings)) as agent:
        is_heard(agent, broker)
        broker.pub(topic, payload)
        found = agent.wait_for(type(body))
        assert (found.source, found.body) == ("a/device/device", body)


def test_what_is_no_reading_is_named_once_and_the_next_reading_counts(broker: Mosquitto) -> None:
    shed = {"form": "zigbee2mqtt", "device": "shed", "qos": 1}
    with threaded_agent("a", devices=device(MqttTemperature, broker, **shed)) as agent:
        is_heard(agent, broker)
        bad = ["{}", "{}", '{"temperature": null}', '{"temperature": "hot"}', "noise", '{"temperature": NaN}']
        broker.pub_lines("zigbee2mqtt/shed", bad, "-q", "1")
        broker.pub("zigbee2mqtt/shed", '{"temperature": 20.5}', "-q", "1")
        agent.wait_for(Temperature)
        assert [packet.body.celsius for packet in agent.probe.packets(Temperature)] == [20.5]
        warnings = [line for line in agent.lines("warning") if "is not a reading" in line]
        assert warnings == [
            "device: a reading is missed: a message on zigbee2mqtt/shed is not a reading: it has no key 'temperature'"
            " of the path 'temperature', only none"
        ]
        assert agent.ask(Describe("device")).result["readings"]["missed"] == 5


@pytest.mark.parametrize("word", ["nan", "inf", "-inf", "NaN"])
def test_what_is_not_finite_is_no_reading(broker: Mosquitto, word: str) -> None:
    with threaded_agent("a", devices=device(MqttTemperature, broker, topic="t")) as agent:
        is_heard(agent, broker)
        broker.pub("t", word)
        agent.wait_until(lambda: any("is not a finite number" in line for line in agent.lines("warning")))
        assert not agent.probe.packets(Temperature)


def test_a_reading_that_the_broker_has_kept_counts_where_the_settings_say_so(broker: Mosquitto) -> None:
    broker.pub("t", "1.0", "-r")
    devices = {
        "new": device(MqttTemperature, broker, topic="t")["device"],
        "kept": device(MqttTemperature, broker, topic="t", retained=True)["device"],
    }
    with threaded_agent("a", devices=devices) as agent:
        assert agent.wait_for(Temperature).source == "a/device/kept"
        broker.pub("t", "2.0")
        agent.wait_for(Temperature, source="a/device/new")
        heard = [(packet.source, packet.body.celsius) for packet in agent.probe.packets(Temperature)]
        assert ("a/device/new", 1.0) not in heard and ("a/device/new", 2.0) in heard


def test_a_device_that_says_that_it_is_offline_is_named(broker: Mosquitto) -> None:
    shed = {"form": "zigbee2mqtt", "device": "shed"}
    with threaded_agent("a", devices=device(MqttTemperature, broker, **shed)) as agent:
        is_heard(agent, broker, 2)
        broker.pub("zigbee2mqtt/shed/availability", '{"state":"offline"}')
        agent.wait_until(lambda: "device: the device says that it is offline" in agent.lines("warning"))
        broker.pub("zigbee2mqtt/shed/availability", "online")
        agent.wait_until(lambda: "device: the device is there again" in agent.lines("info"))


def test_a_sensor_that_falls_silent_is_named_until_it_speaks(broker: Mosquitto) -> None:
    air = device(MqttTemperature, broker, topic="t")["device"]
    with threaded_agent("a", devices={"device": {**air, "silent_mission_s": 0.3}}) as agent:
        agent.wait_until(lambda: any("no reading has come for" in line for line in agent.lines("warning")))
        broker.pub("t", "3")
        agent.wait_until(lambda: "device: readings come again" in agent.lines("info"))


def test_devices_share_a_connection_and_one_that_stops_leaves_the_others(broker: Mosquitto) -> None:
    devices = {
        name: device(MqttTemperature, broker, topic=f"t/{name}", client_id="both")["device"] for name in ("one", "two")
    }
    with threaded_agent("a", devices=devices) as agent:
        agent.wait_until(lambda: broker.log().count("Sending SUBACK to both") >= 2)
        assert broker.log().count("as both") == 1
        assert agent.ask(Stop("device/one")).ok
        agent.wait_until(lambda: "Received UNSUBSCRIBE from both" in broker.log())
        broker.pub("t/two", "5")
        assert agent.wait_for(Temperature).source == "a/device/two"


def test_it_refuses_virtual_time_with_a_sentence(virtual_agent: Any) -> None:
    agent = virtual_agent("a", devices={"air": {"type": MqttTemperature, "settings": {"topic": "t"}}})
    failed = agent.wait_for_event("task_failed", task="air")
    assert "a/device/air needs a broker, which has no virtual time: give it a null driver" in failed["error"]


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({}, "topic is missing, or form and device"),
        ({"form": "esphome", "device": "yard"}, "is not a device of esphome, whose names are like 'node/id'"),
        ({"form": "zigbee2mqtt"}, "form = 'zigbee2mqtt' needs the name of a device"),
        ({"device": "x", "topic": "t"}, "device = 'x' has no use without form"),
        ({"topic": "a/#/b"}, "# must be alone after the last /"),
        ({"topic": "a/b+"}, "+ must be alone between two /"),
        ({"topic": "t", "broker": "http://x"}, "is not an address such as 'mqtt://"),
        ({"topic": "t", "broker": "mqtt://me:secret@x"}, "write it as user, and the password in a file"),
        ({"topic": "t", "ca": "ca.pem"}, "is not encrypted, so ca and certificate have no use"),
        ({"topic": "t", "broker": "mqtts://x", "key": "k"}, "certificate and key go together"),
        ({"topic": "t", "password_file": "p"}, "password_file goes with user"),
        ({"topic": "t", "qos": 3}, "qos"),
    ],
)
def test_settings_that_make_no_sense_are_named(settings: dict[str, Any], problem: str) -> None:
    assert problem in "; ".join(map(str, check_settings(MqttTemperature.Settings, settings)))


def test_nothing_but_finite_readings_are_made_of_a_battery_without_a_voltage(broker: Mosquitto) -> None:
    settings = {"topic": "b", "full": 4.2}
    with threaded_agent("a", devices=device(MqttBattery, broker, **settings)) as agent:
        is_heard(agent, broker)
        broker.pub("b", "2.1")
        body = agent.wait_for(Battery).body
        assert body.level == 0.5 and math.isnan(body.voltage_v)


# What is wrong in part, or beyond its bounds -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "payload", "reason"),
    [
        ({}, "120", "a level of 120 is not between 0 and full = 100"),
        ({}, "-1", "a level of -1 is not between 0 and full = 100"),
        ({"full": 1.0}, "85", "a level of 85 is not between 0 and full = 1"),
    ],
)
def test_a_level_out_of_its_range_is_no_reading(
    broker: Mosquitto, settings: dict[str, Any], payload: str, reason: str
) -> None:
    with threaded_agent("a", devices=device(MqttBattery, broker, topic="b", **settings)) as agent:
        is_heard(agent, broker)
        broker.pub("b", payload)
        agent.wait_until(lambda: any(reason in line for line in agent.lines("warning")))
        assert not agent.probe.packets(Battery)


def test_what_is_sound_in_a_message_is_read_and_the_rest_is_named_once(broker: Mosquitto) -> None:
    said = '{"temperature":21.5,"humidity":NaN}'
    devices = {
        "air": device(MqttTemperature, broker, topic="t", field="temperature")["device"],
        "damp": device(MqttNumber, broker, topic="t", field="humidity")["device"],
    }
    with threaded_agent("a", devices=devices) as agent:
        is_heard(agent, broker)
        for _ in range(3):
            broker.pub("t", said)
        agent.wait_until(lambda: len(agent.probe.packets(Temperature)) == 3)
        agent.wait_until(lambda: agent.ask(Describe("damp")).result["readings"]["missed"] == 3)
        warnings = [line for line in agent.lines("warning") if line.startswith("air: ")]
        assert warnings == ["air: a message on t is partly not JSON (humidity is nan): the rest is read"]
        missed = "a message on t is not a reading: nan is not a finite number"
        assert any(missed in line for line in agent.lines("warning"))


def test_a_voltage_that_cannot_be_read_costs_no_level(broker: Mosquitto) -> None:
    settings = {"topic": "b", "field": "level", "voltage": "volts"}
    with threaded_agent("a", devices=device(MqttBattery, broker, **settings)) as agent:
        is_heard(agent, broker)
        broker.pub("b", '{"level": 50, "volts": "n/a"}')
        body = agent.wait_for(Battery).body
        assert body.level == 0.5 and math.isnan(body.voltage_v)
        agent.wait_until(lambda: any("its voltage cannot be read" in line for line in agent.lines("warning")))


@pytest.mark.parametrize(
    ("settings", "payload", "detected"),
    [
        ({"field": "contact", "invert": True}, '{"contact": true}', False),
        ({"field": "contact", "invert": True}, '{"contact": false}', True),
        ({"true_values": ["Ajar"]}, "ajar", True),
        ({"false_values": ["open"]}, "OPEN", False),
        ({"true_values": ["closed"], "invert": True}, "closed", False),
    ],
)
def test_a_contact_is_told_as_its_settings_say(
    broker: Mosquitto, settings: dict[str, Any], payload: str, detected: bool
) -> None:
    with threaded_agent("a", devices=device(MqttMotion, broker, topic="door", **settings)) as agent:
        is_heard(agent, broker)
        broker.pub("door", payload)
        assert agent.wait_for(Motion).body == Motion(detected)


def test_a_shared_subscription_shares_its_messages(broker: Mosquitto) -> None:
    devices = {"device": device(MqttNumber, broker, topic="$share/crew/jobs/#")["device"]}
    with threaded_agent("a", devices=devices) as one, threaded_agent("b", devices=devices) as other:
        is_heard(one, broker, 2)
        for number in range(20):
            broker.pub("jobs/1", str(number), "-q", "1")
        one.wait_until(lambda: len(one.probe.packets(Number)) + len(other.probe.packets(Number)) == 20)
        assert one.probe.packets(Number) and other.probe.packets(Number)


@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
def test_a_payload_that_is_too_large_is_not_taken(broker: Mosquitto, protocol: str) -> None:
    settings = {"topic": "t/#", "largest_bytes": 1000, "protocol": protocol, "retained": True}
    with threaded_agent("a", devices=device(MqttNumber, broker, **settings)) as agent:
        is_heard(agent, broker)
        broker.pub("t/much", " " * 100_000 + "1")
        broker.pub("t/more", " " * 2000 + "2")
        broker.pub("t/well", "3")
        assert agent.wait_for(Number).body == Number(3.0)
        agent.wait_until(lambda: any("t/more is not taken: it has 2001 bytes" in line for line in agent.lines()))


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"topic": "$share/crew"}, "a shared subscription has the form $share/GROUP/FILTER"),
        ({"topic": "$share/crew/a", "retained": True}, "shared subscriptions get no retained messages"),
        ({"topic": "t", "true_values": ["Shut"], "false_values": ["shut"]}, "true_values and false_values both have"),
        ({"topic": "t", "largest_bytes": 0}, "largest_bytes"),
    ],
)
def test_settings_of_a_contact_that_make_no_sense_are_named(settings: dict[str, Any], problem: str) -> None:
    assert problem in "; ".join(map(str, check_settings(MqttMotion.Settings, settings)))
