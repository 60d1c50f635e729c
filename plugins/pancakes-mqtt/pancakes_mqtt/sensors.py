"""Sensors that others have made and that speak by MQTT, as drivers (`mqtt.*`).

A message becomes a reading in the thread of the connection, which hands it to the stream at once: nothing waits here.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from pancakes.devices import Battery, Motion, Pose, Sonar, Temperature
from pancakes.devices.driver import DeviceContext, Pace, Sensor
from pancakes.devices.validation import level_of
from pancakes.errors import PancakesError
from pancakes.settings import Positive
from pancakes_mqtt.broker_settings import BrokerSettings
from pancakes_mqtt.forms import FORMS, FormName, Saying, fault_of_device, named
from pancakes_mqtt.message import Message, Qos
from pancakes_mqtt.packets import Number
from pancakes_mqtt.payloads import BadPayload, celsius_of, decoded, number_of, oddities, truth_of, value_at
from pancakes_mqtt.shared_broker import SharedBroker, shared_broker
from pancakes_mqtt.topics import fault_of_filter, fault_of_retained, means

MOST_TOLD = 20
"""A device warns of no more than so many different things that are wrong in part."""


class MqttSensor(Sensor):
    """A sensor that speaks by MQTT; a type of one's own needs a subclass that names it and makes its body.

    Attributes:
        kind: what a form calls its readings; empty: no form has such.
    """

    rate = "none"
    kind: ClassVar[str] = ""

    @dataclass(kw_only=True)
    class Settings(BrokerSettings):
        """Where it speaks, and how.

        Attributes:
            form: which program or firmware the device speaks by; without it, `topic` says where.
            device: its name there: `shed`, or with esphome `node/id`.
            topic: the topic of its readings, where it is another than the form's.
            field: the path of the reading in its JSON, such as `SI7021.Temperature`; empty: the payload is the reading.
            available: the topic on which it says whether it is there, where it is another than the form's.
            qos: the quality of service that the broker is asked for.
            retained: whether a reading that the broker has kept, and that may be old, counts.
            max_hz: how many readings a second are published, where more come; without it, all are.
        """

        form: FormName = ""
        device: str = ""
        topic: str = ""
        field: str = ""
        available: str = ""
        qos: Qos = 1
        retained: bool = False
        max_hz: Positive | None = None

        def __post_init__(self) -> None:
            super().__post_init__()
            if fault := fault_of_device(self.form, self.device):
                raise ValueError(fault)
            for topic in filter(None, (self.topic, self.available)):
                if fault := fault_of_filter(topic):
                    raise ValueError(fault)
            if self.retained and (fault := fault_of_retained(self.topic)):
                raise ValueError(fault)
            if not self.form and not self.topic:
                raise ValueError("topic is missing, or form and device")

    settings: Any

    def __init__(self, context: DeviceContext, settings: Any) -> None:
        super().__init__(context, settings)
        self._saying = self._where()
        self._available = self._where_available()
        self._pace = Pace(settings.max_hz) if settings.max_hz is not None else None
        self._broker: SharedBroker | None = None
        self._told: set[str] = set()
        self._there = True

    @abstractmethod
    def body(self, payload: bytes, field: str) -> Any | None:
        """Return the reading in a payload; None where the device cannot tell. In the connection's thread.

        Raises:
            BadPayload: there is none.
        """

    def open(self) -> None:
        refuse_virtual_time(self.context)
        if not self._saying.topic:
            raise PancakesError(
                f"devices of {self.settings.form} tell no {self.kind or self.type}: set topic and field"
            )
        self._broker = shared_broker(self.context, self.settings)
        self._broker.join(self.context.device, self.context.log)
        self._broker.listen(self._saying.topic, self.settings.qos, self._came)
        if self._available.topic:
            self._broker.listen(self._available.topic, 1, self._came)

    def close(self) -> None:
        if self._broker is not None:
            self._broker.leave(self.context.device, self._came)

    def sample(self) -> None:
        """Readings come by themselves."""

    def _where(self) -> Saying:
        settings = self.settings
        of_form = FORMS[settings.form].says.get(self.kind, Saying("")) if settings.form else Saying("")
        topic = settings.topic or named(of_form.topic, settings.device)
        return Saying(topic, settings.field or ("" if settings.topic else of_form.field))

    def _where_available(self) -> Saying:
        settings = self.settings
        of_form = FORMS[settings.form].available if settings.form else Saying("")
        return Saying(settings.available or named(of_form.topic, settings.device), of_form.field)

    # In the connection's thread --------------------------------------------------------------------------------

    def _came(self, message: Message) -> None:
        if self._available.topic and means(self._available.topic, message.topic):
            self._heard_whether_there(message)
        if not means(self._saying.topic, message.topic) or (message.retain and not self.settings.retained):
            return
        if odd := oddities(message.payload):
            self.tell_once(f"what {message.topic} says is no JSON in part ({odd}): the rest of it is read")
        try:
            body = self.body(message.payload, self._saying.field)
        except BadPayload as error:
            self.context.missed(f"what {message.topic} says is no reading: {error}")
            return
        if body is not None and (self._pace is None or self._pace.due(self.context.now())):
            self.context.deliver(body)
        else:
            self.context.alive()

    def _heard_whether_there(self, message: Message) -> None:
        try:
            there = truth_of(_availability(message.payload, self._available.field))
        except BadPayload:
            return  # it is for people then
        if there is not None and there != self._there:
            self._there = there
            text = "the device is there again" if there else "the device says that it is offline"
            self.context.log("info" if there else "warning", text)

    def tell_once(self, text: str) -> None:
        """Warn of something in the log, once: a device that is at odds with its settings would drown the rest."""
        if text not in self._told and len(self._told) < MOST_TOLD:
            self._told.add(text)
            self.context.log("warning", text)


def _availability(payload: bytes, field: str) -> Any:
    """Return what a device says of its being there: older versions of Zigbee2MQTT say it without JSON."""
    try:
        return value_at(payload, field)
    except BadPayload:
        return value_at(payload, "")


def refuse_virtual_time(context: DeviceContext) -> None:
    """Raise PancakesError where the agent runs in virtual time: no broker waits for that."""
    if context.virtual:
        raise PancakesError(
            f"{context.agent}/device/{context.device} speaks to a broker, which knows no virtual time:"
            " give it a null driver there, such as null.temperature"
        )


class MqttTemperature(MqttSensor):
    """A thermometer (`mqtt.temperature`)."""

    type = "temperature"
    kind = "temperature"

    @dataclass(kw_only=True)
    class Settings(MqttSensor.Settings):
        """Where it speaks, and how.

        Attributes:
            unit: the unit in which it speaks; without it, C, and what a Tasmota says in its TempUnit.
        """

        unit: Literal["C", "F", "K", ""] = ""

    def body(self, payload: bytes, field: str) -> Temperature | None:
        number = number_of(value_at(payload, field))
        if number is None:
            return None
        unit = self.settings.unit
        if not unit and self.settings.form == "tasmota":
            told = decoded(payload)
            unit = str(told.get("TempUnit", "C")) if isinstance(told, Mapping) else "C"
        return Temperature(celsius_of(number, unit))


class MqttMotion(MqttSensor):
    """A motion sensor (`mqtt.motion`)."""

    type = "motion"
    kind = "motion"

    @dataclass(kw_only=True)
    class Settings(MqttSensor.Settings):
        """Where it speaks, and how.

        Attributes:
            true_values: what it says for yes, such as `closed`, besides what always means yes (`on`, `open`, ...).
            false_values: what it says for no.
            invert: whether yes is told as no, and no as yes, as for a contact that says `true` when it is closed.
        """

        true_values: list[str] = field(default_factory=list)
        false_values: list[str] = field(default_factory=list)
        invert: bool = False

        def __post_init__(self) -> None:
            super().__post_init__()
            self.true_values = [it.strip().lower() for it in self.true_values]
            self.false_values = [it.strip().lower() for it in self.false_values]
            if both := next((it for it in self.true_values if it in self.false_values), None):
                raise ValueError(f"true_values and false_values both have {both!r}")

    def body(self, payload: bytes, field: str) -> Motion | None:
        settings = self.settings
        detected = truth_of(value_at(payload, field), settings.true_values, settings.false_values)
        return Motion(detected is not settings.invert) if detected is not None else None


class MqttBattery(MqttSensor):
    """A battery (`mqtt.battery`). Its voltage is NaN where the device does not tell it."""

    type = "battery"
    kind = "battery"

    @dataclass(kw_only=True)
    class Settings(MqttSensor.Settings):
        """Where it speaks, and how.

        Attributes:
            full: what it says when the battery is full: 100 if it speaks in percent, 1 if in fractions. What lies
                beyond, or below 0, is no reading.
            voltage: the path of the voltage in its JSON; empty: it tells none.
            voltage_unit: the unit of that; Zigbee2MQTT says mV.
        """

        full: Positive = 100.0
        voltage: str = ""
        voltage_unit: Literal["V", "mV"] = "V"

    def body(self, payload: bytes, field: str) -> Battery | None:
        level = number_of(value_at(payload, field))
        if level is None:
            return None
        try:
            return Battery(self._volts(payload), level_of(level, self.settings.full))
        except PancakesError as error:
            raise BadPayload(str(error)) from None

    def _volts(self, payload: bytes) -> float:
        """Return the voltage; NaN if it is not told, or is no number: the level is a reading all the same."""
        settings = self.settings
        if not settings.voltage:
            return math.nan
        try:
            volts = number_of(value_at(payload, settings.voltage))
        except BadPayload as error:
            self.tell_once(f"its voltage cannot be read: {error}")
            return math.nan
        return math.nan if volts is None else volts / 1000.0 if settings.voltage_unit == "mV" else volts


class MqttDistance(MqttSensor):
    """A sensor of distance, such as an ultrasonic one (`mqtt.distance`): a sonar with one bearing."""

    type = "sonar"
    kind = "distance"

    @dataclass(kw_only=True)
    class Settings(MqttSensor.Settings):
        """Where it speaks, and how.

        Attributes:
            metres: how many metres one of its units is; a Tasmota speaks in centimetres (0.01).
            max_range_m: its full range: what is farther away, or not heard (0 and below), is told as this.
            bearing_rad: where it looks, in the frame of the body.
        """

        metres: Positive = 1.0
        max_range_m: Positive = 4.0
        bearing_rad: float = 0.0

    def body(self, payload: bytes, field: str) -> Sonar | None:
        number = number_of(value_at(payload, field))
        if number is None:
            return None
        settings, range_m = self.settings, number * self.settings.metres
        if not 0.0 < range_m < settings.max_range_m:
            range_m = settings.max_range_m
        return Sonar((settings.bearing_rad,), (range_m,), settings.max_range_m)


class MqttPose(MqttSensor):
    """A pose in JSON, as a tracker tells it (`mqtt.pose`)."""

    type = "pose"

    @dataclass(kw_only=True)
    class Settings(MqttSensor.Settings):
        """Where it speaks, and how.

        Attributes:
            x: the path of x in its JSON, below `field` where that is set; metres.
            y: the path of y.
            theta: the path of the heading; radians, counter-clockwise from the x axis.
        """

        x: str = "x"
        y: str = "y"
        theta: str = "theta"

    def body(self, payload: bytes, field: str) -> Pose | None:
        above = f"{field}." if field else ""
        paths = (self.settings.x, self.settings.y, self.settings.theta)
        x_m, y_m, theta_rad = (number_of(value_at(payload, above + path)) for path in paths)
        return Pose(x_m, y_m, theta_rad) if x_m is not None and y_m is not None and theta_rad is not None else None


class MqttNumber(MqttSensor):
    """Any other number: humidity, light, power (`mqtt.number`)."""

    type = "mqtt.number"
    kind = "number"

    @dataclass(kw_only=True)
    class Settings(MqttSensor.Settings):
        """Where it speaks, and how.

        Attributes:
            unit: the unit, for people; it goes along with each reading.
        """

        unit: str = ""

    def body(self, payload: bytes, field: str) -> Number | None:
        number = number_of(value_at(payload, field))
        return Number(number, self.settings.unit) if number is not None else None
