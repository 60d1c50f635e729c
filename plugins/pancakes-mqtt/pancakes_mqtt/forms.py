"""How the devices of Zigbee2MQTT, ESPHome and Tasmota speak: topics, paths and payloads, by what is wanted. Pure.

Sources: zigbee2mqtt.io/guide/usage/mqtt_topics_and_messages.html; esphome.io/components/mqtt.html;
tasmota.github.io/docs/MQTT/.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal

import msgspec

FormName = Literal["zigbee2mqtt", "esphome", "tasmota", ""]
"""Which program or firmware the device speaks by; empty: by topics and paths of its own."""


class Saying(msgspec.Struct, frozen=True):
    """Where a thing is said.

    Attributes:
        topic: the topic, with `{device}`, or `{node}` and `{id}`.
        field: the path in its JSON; empty: the payload is the value.
    """

    topic: str
    field: str = ""


class Form(msgspec.Struct, frozen=True):
    """How devices of one kind speak.

    Attributes:
        says: where each kind of reading is said.
        available: where they say whether they are there.
        commands: where each kind of command is taken.
        on, off: the payloads that switch.
        brightest: of the brightness of a light.
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
    """Say why a form has no device of this name; empty: it has."""
    if not form:
        return f"device = {device!r} says nothing without form" if device else ""
    if not device:
        return f"form = {form!r} needs the name of a device"
    if any(sign in device for sign in "+#{}\0"):
        return f"device = {device!r} is no name of a device"
    if FORMS[form].two_names and (device.count("/") != 1 or not all(device.split("/"))):
        return f"device = {device!r} is no device of {form}, whose names are such as 'node/id'"
    return ""


def named(template: str, device: str) -> str:
    """Return a topic of a form for one device."""
    node, _, id_ = device.partition("/")
    return template.replace("{device}", device).replace("{node}", node).replace("{id}", id_)


def light_payload(form: str, share: float) -> str:
    """Return what a light of a form is told so that it shines with this share of its brightness, above 0."""
    if form == "tasmota":
        return str(max(1, round(100 * share)))
    return f'{{"state": "ON", "brightness": {max(1, round(FORMS[form].brightest * share))}}}'


def dark_payload(form: str) -> str:
    """Return what a light of a form is told so that it is dark."""
    return "0" if form == "tasmota" else '{"state": "OFF"}'
