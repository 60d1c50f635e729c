"""A broker that refuses, or grants less than was asked for: one sentence, and the agent goes on."""

from __future__ import annotations

import datetime
import ipaddress
import os
import signal
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from mqtt.brokers import Mosquitto, passwords
from pancakes_mqtt.bridge import MqttBridge
from pancakes_mqtt.packets import BrokerTraffic, Number

from pancakes.testing import AgentHandle, threaded_agent


class Authority:
    """One that vouches for a broker and its clients."""

    def __init__(self, folder: Path, name: str) -> None:
        self._folder = folder
        self._name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        self._key = ec.generate_private_key(ec.SECP256R1())
        builder = self._builder(self._name, self._key.public_key())
        certificate = builder.add_extension(x509.BasicConstraints(True, None), True).sign(self._key, hashes.SHA256())
        self.path = folder / f"{name}.pem"
        self.path.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))

    def vouch(self, name: str) -> tuple[Path, Path]:
        """Returns the files of a certificate and its key, for this machine's loopback."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        names = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
        certificate = self._builder(subject, key.public_key()).add_extension(names, False)
        signed = certificate.sign(self._key, hashes.SHA256())
        paths = self._folder / f"{name}.crt", self._folder / f"{name}.key"
        paths[0].write_bytes(signed.public_bytes(serialization.Encoding.PEM))
        paths[1].write_bytes(
            key.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            )
        )
        return paths

    def _builder(self, subject: x509.Name, key: Any) -> x509.CertificateBuilder:
        now = datetime.datetime.now(datetime.UTC)
        day = datetime.timedelta(days=1)
        builder = x509.CertificateBuilder().subject_name(subject).issuer_name(self._name).public_key(key)
        return builder.serial_number(x509.random_serial_number()).not_valid_before(now - day).not_valid_after(now + day)


Brokers = Callable[..., Mosquitto]


def service(address: str, **settings: Any) -> dict[str, Any]:
    publish = [
        {"channel": "one", "type": "mqtt.number", "topic": "out", "qos": 1},
        {"channel": "two", "type": "mqtt.number", "topic": "out", "qos": 2},
    ]
    return {
        "mqtt": {"type": MqttBridge, "settings": {"broker": address, "report_s": 0.1, "publish": publish, **settings}}
    }


def says(agent: AgentHandle, text: str, level: str = "error") -> None:
    agent.wait_until(lambda: any(text in line for line in agent.lines(level)), what=text)


@pytest.fixture
def locked(tmp_path: Path, mosquitto: Brokers) -> Any:
    """A broker that speaks TLS, and wants the password of `robot`."""
    authority = Authority(tmp_path, "ours")
    certificate, key = authority.vouch("broker")
    broker = mosquitto(
        f"certfile {certificate}",
        f"keyfile {key}",
        "allow_anonymous false",
        f"password_file {passwords(tmp_path, robot='secret')}",
    )
    (tmp_path / "password").write_text("secret\n")
    (tmp_path / "password").chmod(0o600)
    settings = {"user": "robot", "password_file": str(tmp_path / "password"), "ca": str(authority.path)}
    return broker, settings


def test_mqtt_speaks_tls_with_a_password(locked: Any) -> None:
    broker, settings = locked
    with threaded_agent("a", services=service(f"mqtts://127.0.0.1:{broker.port}", **settings)) as agent:
        agent.wait_for(BrokerTraffic, lambda body: body.connected)
        agent.publish("two", Number(1.0))
        agent.wait_for(BrokerTraffic, lambda body: body.published == 2)


@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
def test_mqtt_names_a_wrong_password_once(locked: Any, tmp_path: Path, protocol: str) -> None:
    broker, settings = locked
    (tmp_path / "password").write_text("sesame\n")
    address = f"mqtts://127.0.0.1:{broker.port}"
    with threaded_agent("a", services=service(address, protocol=protocol, **settings)) as agent:
        says(agent, f"the broker {address} refuses pancakes-a-mqtt: ")
        agent.wait_until(lambda: broker.log().count("not authorised") >= 3)
        (line,) = agent.lines("error")
        assert "check user and password_file" in line


def test_mqtt_names_a_certificate_of_another_authority(locked: Any, tmp_path: Path) -> None:
    broker, settings = locked
    settings["ca"] = str(Authority(tmp_path, "theirs").path)
    with threaded_agent("a", services=service(f"mqtts://127.0.0.1:{broker.port}", **settings)) as agent:
        says(agent, "is not there (its certificate is not trusted (", "warning")
        says(agent, "check ca, and the host in broker); trying until it is", "warning")


def test_mqtt_names_a_certificate_of_another_host(locked: Any) -> None:
    broker, settings = locked
    with threaded_agent("a", services=service(f"mqtts://localhost:{broker.port}", **settings)) as agent:
        says(agent, "its certificate is not trusted (", "warning")


def test_mqtt_shows_its_certificate_to_a_broker(tmp_path: Path, mosquitto: Brokers) -> None:
    authority = Authority(tmp_path, "ours")
    certificate, key = authority.vouch("broker")
    lines = (f"cafile {authority.path}", f"certfile {certificate}", f"keyfile {key}", "require_certificate true")
    broker = mosquitto(*lines, "allow_anonymous true")
    mine, mine_key = authority.vouch("robot")
    address, ca = f"mqtts://127.0.0.1:{broker.port}", {"ca": str(authority.path)}
    shown = {**ca, "certificate": str(mine), "key": str(mine_key)}
    with threaded_agent("a", services=service(address, **shown)) as agent:
        agent.wait_for(BrokerTraffic, lambda body: body.connected)
    with threaded_agent("b", services=service(address, **ca)) as agent:
        says(agent, "is not there (", "warning")


def test_mqtt_names_a_port_without_tls(broker: Mosquitto) -> None:
    with threaded_agent("a", services=service(f"mqtts://127.0.0.1:{broker.port}")) as agent:
        says(agent, "is not there (", "warning")
        assert any("TLS" in line for line in agent.lines("warning"))


@pytest.mark.parametrize(
    ("mode", "text", "problem"),
    [
        (0o644, "secret", "every user of this machine can read"),
        (0o600, "", "is empty; its first line must be the password"),
        (None, "", "cannot be read: No such file or directory"),
    ],
)
def test_mqtt_names_an_unusable_password_file(tmp_path: Path, mode: int | None, text: str, problem: str) -> None:
    path = tmp_path / "password"
    if mode is not None:
        path.write_text(text)
        path.chmod(mode)
    settings = {"user": "robot", "password_file": str(path)}
    with threaded_agent("a", services=service("mqtt://127.0.0.1:9", **settings)) as agent:
        assert problem in agent.wait_for_event("service_failed", service="mqtt")["error"]


@pytest.mark.parametrize("key", ["password_file", "ca", "certificate"])
def test_mqtt_names_a_pipe_in_the_place_of_a_file(tmp_path: Path, key: str) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path, 0o600)
    settings = {"user": "robot", **({"key": str(path)} if key == "certificate" else {}), key: str(path)}
    with threaded_agent("a", services=service("mqtts://127.0.0.1:9", **settings)) as agent:
        error = agent.wait_for_event("service_failed", service="mqtt")["error"]
        assert f"{key}: {path} cannot be read: it is a pipe, not a file" in error


def test_mqtt_names_a_qos_that_is_not_granted(mosquitto: Brokers) -> None:
    broker = mosquitto("max_qos 1", "allow_anonymous true")
    take = [{"topic": "in", "type": "mqtt.number", "qos": 2}]
    with threaded_agent("a", services=service(broker.address, take=take)) as agent:
        says(agent, "the broker sends in with QoS 1 at the most, not 2", "warning")
        agent.publish("two", Number(1.0))
        says(agent, "the broker takes QoS 1 at the most: out is published with that", "warning")
        agent.wait_for(BrokerTraffic, lambda body: body.published == 2 and not body.waiting)


def test_mqtt_names_a_message_too_large_for_the_broker(mosquitto: Brokers) -> None:
    broker = mosquitto("max_packet_size 200", "allow_anonymous true")
    with threaded_agent("a", services=service(broker.address)) as agent:
        agent.wait_for(BrokerTraffic, lambda body: body.connected)
        agent.publish("two", Number(1.0, "x" * 500))
        says(agent, "bytes; the broker takes 200")
        agent.publish("two", Number(1.0))
        agent.wait_for(BrokerTraffic, lambda body: body.published == 2 and body.unsent == 1)


def test_mqtt_names_what_access_rules_forbid(tmp_path: Path, mosquitto: Brokers) -> None:
    (tmp_path / "acl").write_text("topic write pancakes/#\n")
    broker = mosquitto("allow_anonymous true", f"acl_file {tmp_path / 'acl'}")
    with threaded_agent("a", services=service(broker.address)) as agent:
        agent.wait_for(BrokerTraffic, lambda body: body.connected)
        agent.publish("one", Number(1.0))
        says(agent, "the broker refuses what this agent publishes: not authorized")
        agent.wait_for(BrokerTraffic, lambda body: body.unsent == 1 and not body.waiting)


def test_mqtt_names_two_connections_of_one_name(broker: Mosquitto) -> None:
    with threaded_agent("a", services=service(broker.address)) as agent:
        agent.wait_for(BrokerTraffic, lambda body: body.connected)
        with broker.listening("t", "-i", "pancakes-a-mqtt"):
            says(agent, "is another one called pancakes-a-mqtt, too?", "warning")


def test_mqtt_names_a_server_that_is_no_broker() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        ended = threading.Event()

        def speak() -> None:
            while not ended.is_set():
                server.settimeout(0.1)
                try:
                    other, _ = server.accept()
                except TimeoutError:
                    continue
                with other:
                    other.sendall(b"SSH-2.0-OpenSSH_9.2\r\n" * 10)
                    ended.wait(0.2)

        thread = threading.Thread(target=speak)
        thread.start()
        try:
            with threaded_agent("a", services=service(f"mqtt://127.0.0.1:{server.getsockname()[1]}")) as agent:
                says(agent, "is not there (", "warning")
                assert not agent.events("service_failed")
        finally:
            ended.set()
            thread.join()


def test_mqtt_sends_no_more_than_the_broker_takes(mosquitto: Brokers) -> None:
    broker = mosquitto("max_inflight_messages 3", "allow_anonymous true")
    with threaded_agent("a", services=service(broker.address)) as agent:
        agent.wait_for(BrokerTraffic, lambda body: body.connected)
        broker.signal(signal.SIGSTOP)
        for number in range(100):
            agent.publish("two", Number(float(number)))
        agent.wait_for(BrokerTraffic, lambda body: body.waiting == 100)
        broker.signal(signal.SIGCONT)
        told = agent.wait_for(BrokerTraffic, lambda body: body.published == 101).body
        assert told.connections == 1
