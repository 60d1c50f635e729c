"""The broker settings that the drivers and the service share."""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Final, Literal
from urllib.parse import urlsplit

import msgspec

from pancakes import FilePath, PancakesError
from pancakes.util.files import check_plain

PORTS: Final = {"mqtt": 1883, "mqtts": 8883}


@dataclass(kw_only=True)
class BrokerSettings:
    """Which broker to use, and how.

    Attributes:
        broker: its address, such as `mqtt://192.168.1.5:1883`; `mqtts://` is encrypted (TLS).
        user: the name that the broker knows this agent by; empty: none.
        password_file: a file whose first line is the password; empty: none.
        ca: a file with the certificates (PEM) of the authorities for the broker; empty: those of the system.
        certificate: a file with the certificate (PEM) that this agent shows; empty: none.
        key: the file with its key (PEM).
        protocol: the version of MQTT.
        client_id: the name of the connection, of which a broker has one at a time; empty: made of the agent's name.
        keepalive_s: after this silence, in seconds of the host, the broker is pinged.
        session_s: for how long, in seconds of the host, the broker keeps messages (QoS 1 and 2) for this agent while it
            is away; 0: not at all; 4294967295: for ever. With 3.1.1 the broker's own configuration decides.
        queue: the most messages that wait, each way.
        largest_bytes: a message whose payload is larger is not taken. With MQTT 5 the broker does not even send it.
    """

    broker: str = "mqtt://127.0.0.1"
    user: str = ""
    password_file: FilePath = ""
    ca: FilePath = ""
    certificate: FilePath = ""
    key: FilePath = ""
    protocol: Literal["5", "3.1.1"] = "5"
    client_id: str = ""
    keepalive_s: Annotated[int, msgspec.Meta(ge=2, le=3600)] = 15
    session_s: Annotated[int, msgspec.Meta(ge=0, le=0xFFFFFFFF)] = 300
    queue: Annotated[int, msgspec.Meta(ge=1, le=1_000_000)] = 1000
    largest_bytes: Annotated[int, msgspec.Meta(ge=1, le=0x0FFFFFFF)] = 1_048_576

    def __post_init__(self) -> None:
        fault = fault_of_broker(self.broker)
        if not fault and not self.encrypted and (self.ca or self.certificate):
            fault = f"broker = {self.broker!r} is not encrypted, so ca and certificate have no use: write mqtts://"
        if not fault and bool(self.certificate) != bool(self.key):
            fault = "certificate and key go together"
        if not fault and self.password_file and not self.user:
            fault = "password_file goes with user"
        if fault:
            raise ValueError(fault)

    @property
    def host(self) -> str:
        """The broker's host."""
        return urlsplit(self.broker).hostname or ""

    @property
    def port(self) -> int:
        """The broker's port."""
        address = urlsplit(self.broker)
        return address.port or PORTS[address.scheme]

    @property
    def encrypted(self) -> bool:
        """Whether it is spoken to by TLS."""
        return urlsplit(self.broker).scheme == "mqtts"

    @property
    def connection_key(self) -> str:
        """The key of settings that can share one connection."""
        return repr([getattr(self, field.name) for field in fields(BrokerSettings)])


def fault_of_broker(broker: str) -> str:
    """Return why a text is not the address of a broker; empty: it is."""
    try:
        address = urlsplit(broker)
        sound = address.scheme in PORTS and bool(address.hostname) and address.port != 0
    except ValueError:
        sound = False
    if not sound or address.path.strip("/") or address.query:
        return f"broker = {broker!r} is not an address such as 'mqtt://192.168.1.5:1883' or 'mqtts://broker.local'"
    if address.username is not None:
        return "broker contains a name: write it as user, and the password in a file (password_file)"
    return ""


def password_of(settings: BrokerSettings) -> str:
    """Return the password.

    Raises:
        PancakesError: its file cannot be read, or others can read it.
    """
    if not settings.password_file:
        return ""
    path = Path(settings.password_file)
    try:
        mode = path.stat().st_mode
        check_plain(path)
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeError) as error:
        raise PancakesError(f"password_file: {path} cannot be read: {getattr(error, 'strerror', error)}") from None
    if mode & (stat.S_IROTH | stat.S_IWOTH):
        raise PancakesError(f"password_file: every user of this machine can read {path}: chmod 600 {path}")
    if not lines or not lines[0]:
        raise PancakesError(f"password_file: {path} is empty; its first line must be the password")
    return lines[0]


def check_files(settings: BrokerSettings) -> None:
    """Raise PancakesError if a file in the settings cannot be read."""
    for name in ("ca", "certificate", "key"):
        path = getattr(settings, name)
        if path and not os.access(path, os.R_OK):
            raise PancakesError(f"{name}: {path} cannot be read")
        try:
            check_plain(path)
        except OSError as error:
            raise PancakesError(f"{name}: {path} cannot be read: {error.strerror or error}") from None
