"""Drivers of third-party sensors that publish by MQTT (`mqtt.*`).

A message becomes a reading in the thread of the connection, which passes it to the stream at once: nothing waits here.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

from pancakes import DeviceContext, PancakesError, Positive, Sensor
from pancakes.devices import Battery, Motion, Pose, Sonar, Temperature
from pancakes.devices.driver import Pace
from pancakes.devices.validation import level_of
from pancakes_mqtt.broker_settings import BrokerSettings
from pancakes_mqtt.forms import FORMS, FormName, Saying, fault_of_device, named
from pancakes_mqtt.message import Message, Qos
from pancakes_mqtt.packets import Number
from pancakes_mqtt.payloads import BadPayload, celsius_of, decoded, number_of, oddities, truth_of, value_at
from pancakes_mqtt.shared_broker import SharedBroker, shared_broker
from pancakes_mqtt.topics import fault_of_filter, fault_of_retained, means

MOST_TOLD = 20
"""A device logs at most this many different warnings about parts of messages."""


class MqttSensor(Sensor):
    """A sensor that publishes by MQTT. Subclass it for another type: name the type and make its body.

    Attributes:
        kind: the name of its readings in a form; empty: no form has any.
    """

    rate = "none"
    kind: ClassVar[str] = ""

    @dataclass(kw_only=True)
    class Settings(BrokerSettings):
        """Where and how it publishes.

        Attributes:
            form: the program or firmware of the device; without it, `topic` is needed.
            device: its name in that program: `shed`, or with esphome `node/id`.
            topic: the topic of its readings, if not that of the form.
            field: the path of the reading in its JSON, such as `SI7021.Temperature`; empty: the payload is the reading.
            available: the topic of its availability, if not that of the form.
            qos: the quality of service of the subscription.
            retained: also take retained readings, which may be old.
            max_hz: at most this many readings a second are published; without it, all.
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
        """Return the reading in a payload; None if the device reports no value. In the connection's thread.

        Raises:
            BadPayload: the payload has no reading.
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

    def read(self) -> None:
        """Do nothing: readings come by themselves."""

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
            self.tell_once(f"a message on {message.topic} is partly not JSON ({odd}): the rest is read")
        try:
            body = self.body(message.payload, self._saying.field)
        except BadPayload as error:
            self.context.missed(f"a message on {message.topic} is not a reading: {error}")
            return
        if body is not None and (self._pace is None or self._pace.due(self.context.now())):
            self.context.deliver(body)
        else:
            self.context.alive()

    def _heard_whether_there(self, message: Message) -> None:
        try:
            there = truth_of(_availability(message.payload, self._available.field))
        except BadPayload:
            return  # the topic is for people then
        if there is not None and there != self._there:
            self._there = there
            text = "the device is there again" if there else "the device says that it is offline"
            self.context.log("info" if there else "warning", text)

    def tell_once(self, text: str) -> None:
        """Log a warning once: a device that does not fit its settings would flood the log."""
        if text not in self._told and len(self._told) < MOST_TOLD:
            self._told.add(text)
            self.context.log("warning", text)


def _availability(payload: bytes, field: str) -> Any:
    """Return the availability in a payload: older versions of Zigbee2MQTT publish it without JSON."""
    try:
        return value_at(payload, field)
    except BadPayload:
        return value_at(payload, "")


def refuse_virtual_time(context: DeviceContext) -> None:
    """Raise PancakesError if the agent runs in virtual time, which a broker cannot follow."""
    if context.virtual:
        raise PancakesError(
            f"{context.agent}/device/{context.device} needs a broker, which has no virtual time:"
            " give it a null driver there, such as null.temperature"
        )


class MqttTemperature(MqttSensor):
    """A thermometer (`mqtt.temperature`)."""

    type = "temperature"
    kind = "temperature"

    @dataclass(kw_only=True)
    class Settings(MqttSensor.Settings):
        """Where and how it publishes.

        Attributes:
            unit: the unit of its readings; without it, C, or the TempUnit of a Tasmota.
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
        """Where and how it publishes.

        Attributes:
            true_values: its values for yes, such as `closed`, besides those that always mean yes (`on`, `open`, ...).
            false_values: its values for no.
            invert: whether to swap yes and no, as for a contact that publishes `true` when it is closed.
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
    """A battery (`mqtt.battery`). Its voltage is NaN if the device does not publish it."""

    type = "battery"
    kind = "battery"

    @dataclass(kw_only=True)
    class Settings(MqttSensor.Settings):
        """Where and how it publishes.

        Attributes:
            full: its value when the battery is full: 100 for percent, 1 for fractions. Values beyond it, or below 0,
                are not readings.
            voltage: the path of the voltage in its JSON; empty: none.
            voltage_unit: the unit of the voltage; Zigbee2MQTT uses mV.
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
        """Return the voltage; NaN if it is missing or not a number: the level is still a reading."""
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
        """Where and how it publishes.

        Attributes:
            metres: metres for each of its units; a Tasmota uses centimetres (0.01).
            max_range_m: its full range: also published for anything farther away or not heard (0 and below).
            bearing_rad: its direction, in the frame of the body.
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
    """A pose in JSON, as a tracker publishes it (`mqtt.pose`)."""

    type = "pose"

    @dataclass(kw_only=True)
    class Settings(MqttSensor.Settings):
        """Where and how it publishes.

        Attributes:
            x: the path of x in its JSON, below `field` if that is set; metres.
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
        """Where and how it publishes.

        Attributes:
            unit: the unit, for people; it is part of each reading.
        """

        unit: str = ""

    def body(self, payload: bytes, field: str) -> Number | None:
        number = number_of(value_at(payload, field))
        return Number(number, self.settings.unit) if number is not None else None
