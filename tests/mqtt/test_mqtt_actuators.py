"""Actuators behind a real broker: what they are told, and what becomes of commands while there is none."""

from __future__ import annotations

from typing import Any

import pytest
from mqtt.brokers import Mosquitto
from pancakes_mqtt.actuators import MqttLight, MqttMotors, MqttSwitch
from pancakes_mqtt.packets import Light, Switch

from pancakes.control import Describe, Stop
from pancakes.devices import Twist
from pancakes.packet import CTRL
from pancakes.settings import check_settings
from pancakes.task import Task
from pancakes.testing import AgentHandle, threaded_agent


class Hand(Task):
    """Holds the switch for a test."""

    requires = ("mqtt.switch",)


class Dimmer(Task):
    requires = ("mqtt.light",)


class Wheel(Task):
    requires = ("motors",)


def device(cls: type, broker: Mosquitto, hold_after_s: float = 60.0, **settings: Any) -> dict[str, Any]:
    parts = {"type": cls, "hold_after_mission_s": hold_after_s, "settings": {"broker": broker.address, **settings}}
    return {"device": parts}


def is_connected(agent: AgentHandle, count: int = 1) -> None:
    agent.wait_until(lambda: sum("connected to the broker" in line for line in agent.lines("info")) >= count)


@pytest.mark.parametrize(
    ("cls", "task", "settings", "body", "topic", "command", "hold"),
    [
        (
            MqttSwitch,
            Hand,
            {"form": "zigbee2mqtt", "device": "plug"},
            Switch(True),
            "zigbee2mqtt/plug/set",
            '{"state": "ON"}',
            '{"state": "OFF"}',
        ),
        (
            MqttSwitch,
            Hand,
            {"form": "esphome", "device": "yard/pump"},
            Switch(True),
            "yard/switch/pump/command",
            "ON",
            "OFF",
        ),
        (MqttSwitch, Hand, {"form": "tasmota", "device": "plug"}, Switch(True), "cmnd/plug/POWER", "ON", "OFF"),
        (MqttSwitch, Hand, {"topic": "t", "on": "1", "off": "0"}, Switch(True), "t", "1", "0"),
        (
            MqttLight,
            Dimmer,
            {"form": "zigbee2mqtt", "device": "lamp"},
            Light(0.5),
            "zigbee2mqtt/lamp/set",
            '{"state": "ON", "brightness": 127}',
            '{"state": "OFF"}',
        ),
        (MqttLight, Dimmer, {"form": "tasmota", "device": "lamp"}, Light(1.0), "cmnd/lamp/Dimmer", "100", "0"),
        (
            MqttLight,
            Dimmer,
            {"topic": "l", "command": '{"b": {brightness}}', "full": 10},
            Light(0.25),
            "l",
            '{"b": 2.5}',
            '{"b": 0}',
        ),
        (
            MqttMotors,
            Wheel,
            {"topic": "r1/cmd"},
            Twist(0.25, -1.5),
            "r1/cmd",
            '{"v_mps": 0.25, "omega_radps": -1.5, "ttl_s": 60}',
            '{"v_mps": 0, "omega_radps": 0, "ttl_s": 0}',
        ),
    ],
    ids=lambda value: value if isinstance(value, str) and "/" in value else None,
)
def test_a_command_and_the_safe_hold_reach_the_device(
    broker: Mosquitto, cls: type, task: type, settings: Any, body: Any, topic: str, command: str, hold: str
) -> None:
    with threaded_agent("a", devices=device(cls, broker, **settings), tasks={"Task": task}) as agent:
        is_connected(agent)
        with broker.listening(topic) as told:
            agent.task("Task").publish(CTRL, body)
            assert next(told) == (topic, command)
            assert agent.ask(Stop("Task")).ok
            assert next(told) == (topic, hold)


def test_no_command_waits_for_a_broker_but_the_safe_hold_does(broker: Mosquitto) -> None:
    plug = device(MqttSwitch, broker, 0.3, topic="plug")
    with threaded_agent("a", devices=plug, tasks={"Hand": Hand}) as agent:
        is_connected(agent)
        broker.remember("plug", "plug")
        broker.kill()
        agent.wait_until(lambda: any("is gone" in line for line in agent.lines("warning")))
        agent.task("Hand").publish(CTRL, Switch(True))
        agent.wait_for_event("safe_hold", reason="no fresh command")
        assert "device: commands are lost: there is no broker that takes them" in agent.lines("warning")
        broker.start()
        with broker.remembered("plug", "plug") as told:
            assert next(told) == ("plug", "OFF"), "and no ON, whose time is over"
            agent.task("Hand").publish(CTRL, Switch(True))
            assert next(told) == ("plug", "ON")
        assert "device: commands are taken again" in agent.lines("info")


def test_what_an_agent_holds_when_it_ends_reaches_the_device_before_the_connection_ends(broker: Mosquitto) -> None:
    with broker.listening("plug") as told:
        with threaded_agent("a", devices=device(MqttSwitch, broker, topic="plug"), tasks={"Hand": Hand}) as agent:
            is_connected(agent)
            agent.task("Hand").publish(CTRL, Switch(True))
            assert next(told) == ("plug", "ON")
        assert next(told) == ("plug", "OFF")


@pytest.mark.parametrize(
    ("cls", "settings", "holds"),
    [
        (MqttSwitch, {}, None),
        (MqttSwitch, {"holds_after_s": 2.0}, 2.0),
        (MqttMotors, {}, 60.0),
        (MqttMotors, {"command": "{v_mps}"}, None),
    ],
)
def test_it_says_whether_the_hardware_holds_by_itself(
    broker: Mosquitto, cls: type, settings: Any, holds: float | None
) -> None:
    with threaded_agent("a", devices=device(cls, broker, topic="t", **settings)) as agent:
        (told,) = [agent.ask(Describe("device/device")).result]
        assert told["watchdog_s"] == holds


def test_a_topic_of_commands_has_no_wildcard() -> None:
    problems = check_settings(MqttSwitch.Settings, {"topic": "plugs/+"})
    assert "only filters may contain +" in str(problems[0])


def test_a_light_is_not_told_to_be_brighter_than_it_can_be(broker: Mosquitto) -> None:
    with threaded_agent("a", devices=device(MqttLight, broker, topic="lamp"), tasks={"Dimmer": Dimmer}) as agent:
        is_connected(agent)
        agent.task("Dimmer").publish(CTRL, Light(1.5))
        refused = agent.wait_for_event("command_refused", device="device")
        assert (refused["by"], refused["reason"]) == ("a/client/Dimmer", "brightness is 1.5, above 1")
