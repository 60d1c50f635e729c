"""Drivers of third-party actuators that take commands by MQTT.

A command is valid only for a moment. So commands do not wait for a missing broker, and are not retained. Only the safe
hold waits: a device that could not be reached gets it as soon as its broker is back.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from msgspec import Meta

from pancakes import Actuator, DeviceContext, PancakesError
from pancakes.devices import Twist
from pancakes_mqtt.broker_settings import BrokerSettings
from pancakes_mqtt.forms import FORMS, FormName, dark_payload, fault_of_device, light_payload, named
from pancakes_mqtt.message import Message
from pancakes_mqtt.packets import Light, Switch
from pancakes_mqtt.payloads import written
from pancakes_mqtt.sensors import refuse_virtual_time
from pancakes_mqtt.shared_broker import SharedBroker, shared_broker
from pancakes_mqtt.topics import fault_of_topic


class MqttActuator(Actuator):
    """An actuator that takes commands by MQTT; subclass it for another type.

    Attributes:
        kind: the name of its commands in a form; empty: no form has any.
    """

    kind: ClassVar[str] = ""

    @dataclass(kw_only=True)
    class Settings(BrokerSettings):
        """Where it takes commands.

        Attributes:
            form: the program or firmware of the device; without it, `topic` is needed.
            device: its name in that program: `lamp`, or with esphome `node/id`.
            topic: the topic of its commands, if not that of the form.
            holds_after_s: after how long without a command, in seconds, the device goes to its safe hold by itself (its
                firmware's own time-out); without it, it keeps its last command.
        """

        form: FormName = ""
        device: str = ""
        topic: str = ""
        holds_after_s: Annotated[float, Meta(gt=0)] | None = None

        def __post_init__(self) -> None:
            super().__post_init__()
            if fault := fault_of_device(self.form, self.device) or (self.topic and fault_of_topic(self.topic)):
                raise ValueError(fault)
            if not self.form and not self.topic:
                raise ValueError("topic is missing, or form and device")

    settings: Any

    def __init__(self, context: DeviceContext, settings: Any) -> None:
        super().__init__(context, settings)
        of_form = FORMS[settings.form].commands.get(self.kind, "") if settings.form else ""
        self._topic = settings.topic or named(of_form, settings.device)
        self._broker: SharedBroker | None = None
        self._unheard = False

    @abstractmethod
    def command_payload(self, command: Any, ttl_s: float) -> bytes:
        """Return the payload for a command."""

    @abstractmethod
    def hold_payload(self) -> bytes:
        """Return the payload for the safe hold; empty: nothing is sent."""

    def open(self) -> None:
        refuse_virtual_time(self.context)
        if not self._topic:
            raise PancakesError(f"devices of {self.settings.form} take no commands of the type {self.type}: set topic")
        self._broker = shared_broker(self.context, self.settings)
        self._broker.join(self.context.device, self.context.log)

    def close(self) -> None:
        if self._broker is not None:
            self._broker.leave(self.context.device, None)

    def write(self, command: Any, ttl_s: float, source: str) -> None:
        payload = self.command_payload(command, ttl_s)
        if self._broker is None:
            return
        heard = self._broker.publish(Message(self._topic, payload))
        if not heard and not self._unheard:
            self.context.log("warning", "commands are lost: there is no broker that takes them")
        elif heard and self._unheard:
            self.context.log("info", "commands are taken again")
        self._unheard = not heard

    def watchdog_s(self, hold_after_s: float) -> float | None:
        """Return the firmware's time-out in the settings."""
        holds_after_s: float | None = self.settings.holds_after_s
        return holds_after_s

    def safe_stop(self) -> None:
        payload = self.hold_payload()
        if payload and self._broker is not None:
            self._broker.publish(Message(self._topic, payload, qos=1))


class MqttSwitch(MqttActuator):
    """A switch, such as a plug (`mqtt.switch`)."""

    type = "mqtt.switch"
    kind = "switch"

    @dataclass(kw_only=True)
    class Settings(MqttActuator.Settings):
        """Where it takes commands, and which.

        Attributes:
            on: the payload that switches it on; empty: that of the form, or `ON`.
            off: the payload that switches it off.
            hold: its safe hold: off, on, or unchanged.
        """

        on: str = ""
        off: str = ""
        hold: Literal["off", "on", "keep"] = "off"

    def command_payload(self, command: Switch, ttl_s: float) -> bytes:
        return self._payload(command.on)

    def hold_payload(self) -> bytes:
        return b"" if self.settings.hold == "keep" else self._payload(self.settings.hold == "on")

    def _payload(self, on: bool) -> bytes:
        settings = self.settings
        form = FORMS[settings.form] if settings.form else FORMS["tasmota"]
        return ((settings.on or form.on) if on else (settings.off or form.off)).encode()


class MqttLight(MqttActuator):
    """A light that can be dimmed (`mqtt.light`). It goes out at its safe hold."""

    type = "mqtt.light"
    kind = "light"

    @dataclass(kw_only=True)
    class Settings(MqttActuator.Settings):
        """Where it takes commands, and which.

        Attributes:
            command: without a form, the payload of a command, in which `{brightness}` is filled in, from 0 to `full`.
            full: without a form, the value for full brightness.
        """

        command: str = "{brightness}"
        full: Annotated[float, Meta(gt=0)] = 100.0

    def command_payload(self, command: Light, ttl_s: float) -> bytes:
        share = command.brightness
        form = self.settings.form
        if form:
            return (light_payload(form, share) if share > 0 else dark_payload(form)).encode()
        return written(self.settings.command, {"brightness": self.settings.full * share})

    def hold_payload(self) -> bytes:
        return self.command_payload(Light(0.0), 0.0)


class MqttMotors(MqttActuator):
    """Wheels whose controller takes speeds by MQTT (`mqtt.motors`). Their safe hold stops them."""

    type = "motors"

    @dataclass(kw_only=True)
    class Settings(MqttActuator.Settings):
        """Where they take commands, and which.

        Attributes:
            command: the payload, in which `{v_mps}`, `{omega_radps}` and `{ttl_s}` are filled in; the controller should
                stop by itself if no other command comes within `ttl_s` seconds.
        """

        command: str = '{"v_mps": {v_mps}, "omega_radps": {omega_radps}, "ttl_s": {ttl_s}}'

    def command_payload(self, command: Twist, ttl_s: float) -> bytes:
        values = {"v_mps": command.v_mps, "omega_radps": command.omega_radps, "ttl_s": ttl_s}
        return written(self.settings.command, values)

    def hold_payload(self) -> bytes:
        return self.command_payload(Twist(0.0, 0.0), 0.0)

    def watchdog_s(self, hold_after_s: float) -> float | None:
        """Return the time to live if the controller gets it; otherwise its time-out in the settings."""
        stated = super().watchdog_s(hold_after_s)
        return hold_after_s if stated is None and "{ttl_s}" in self.settings.command else stated
