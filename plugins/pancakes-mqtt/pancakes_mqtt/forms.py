"""The topics, paths and payloads of devices of Zigbee2MQTT, ESPHome and Tasmota. Pure.

Sources: zigbee2mqtt.io/guide/usage/mqtt_topics_and_messages.html; esphome.io/components/mqtt.html;
tasmota.github.io/docs/MQTT/.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

import msgspec

FormName = Literal["zigbee2mqtt", "esphome", "tasmota", ""]
"""The program or firmware of a device; empty: its own topics and paths."""


class Saying(msgspec.Struct, frozen=True):
    """Where a value is published.

    Attributes:
        topic: the topic, with `{device}`, or `{node}` and `{id}`.
        field: the path in its JSON; empty: the payload is the value.
    """

    topic: str
    field: str = ""


class Form(msgspec.Struct, frozen=True):
    """The conventions of one program or firmware.

    Attributes:
        says: where each kind of reading is published.
        available: where their availability is published.
        commands: where each kind of command is taken.
        on, off: the payloads that switch.
        brightest: the highest brightness of a light.
        two_names: whether a device's name is `node/id`.
    """

    says: Mapping[str, Saying]
    available: Saying
    commands: Mapping[str, str]
    on: str
    off: str
    brightest: int
    two_names: bool = False


_Z2M: Final = "zigbee2mqtt/{device}"
FORMS: Final[Mapping[str, Form]] = {
    "zigbee2mqtt": Form(
        says={
            "temperature": Saying(_Z2M, "temperature"),
            "motion": Saying(_Z2M, "occupancy"),
            "battery": Saying(_Z2M, "battery"),
            "number": Saying(_Z2M),
        },
        available=Saying(f"{_Z2M}/availability", "state"),
        commands={"switch": f"{_Z2M}/set", "light": f"{_Z2M}/set"},
        on='{"state": "ON"}',
        off='{"state": "OFF"}',
        brightest=254,
    ),
    "esphome": Form(
        says={
            "temperature": Saying("{node}/sensor/{id}/state"),
            "motion": Saying("{node}/binary_sensor/{id}/state"),
            "battery": Saying("{node}/sensor/{id}/state"),
            "distance": Saying("{node}/sensor/{id}/state"),
            "number": Saying("{node}/sensor/{id}/state"),
        },
        available=Saying("{node}/status"),
        commands={"switch": "{node}/switch/{id}/command", "light": "{node}/light/{id}/command"},
        on="ON",
        off="OFF",
        brightest=255,
        two_names=True,
    ),
    "tasmota": Form(
        says={
            "temperature": Saying("tele/{device}/SENSOR", "*.Temperature"),
            "motion": Saying("stat/{device}/POWER"),
            "distance": Saying("tele/{device}/SENSOR", "*.Distance"),
            "number": Saying("tele/{device}/SENSOR"),
        },
        available=Saying("tele/{device}/LWT"),
        commands={"switch": "cmnd/{device}/POWER", "light": "cmnd/{device}/Dimmer"},
        on="ON",
        off="OFF",
        brightest=100,
    ),
}


def fault_of_device(form: str, device: str) -> str:
    """Return why a device name does not fit a form; empty: it fits."""
    if not form:
        return f"device = {device!r} has no use without form" if device else ""
    if not device:
        return f"form = {form!r} needs the name of a device"
    if any(sign in device for sign in "+#{}\0"):
        return f"device = {device!r} is not the name of a device"
    if FORMS[form].two_names and (device.count("/") != 1 or not all(device.split("/"))):
        return f"device = {device!r} is not a device of {form}, whose names are like 'node/id'"
    return ""


def named(template: str, device: str) -> str:
    """Return a topic of a form for one device."""
    node, _, id_ = device.partition("/")
    return template.replace("{device}", device).replace("{node}", node).replace("{id}", id_)


def light_payload(form: str, share: float) -> str:
    """Return the payload that sets a light to this share of its brightness, above 0."""
    if form == "tasmota":
        return str(max(1, round(100 * share)))
    return f'{{"state": "ON", "brightness": {max(1, round(FORMS[form].brightest * share))}}}'


def dark_payload(form: str) -> str:
    """Return the payload that turns a light off."""
    return "0" if form == "tasmota" else '{"state": "OFF"}'
