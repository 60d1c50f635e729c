"""A broker that refuses, or grants less than was asked for: one sentence, and the agent goes on."""

from __future__ import annotations

import datetime
import ipaddress
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

from pancakes.testing import AgentInTest, threaded_agent


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


def broker_with(tmp_path: Path, *lines: str) -> Mosquitto:
    found = Mosquitto(tmp_path / "mosquitto", *lines)
    found.start()
    return found


def service(address: str, **settings: Any) -> dict[str, Any]:
    publish = [
        {"channel": "one", "type": "mqtt.number", "topic": "out", "qos": 1},
        {"channel": "two", "type": "mqtt.number", "topic": "out", "qos": 2},
    ]
    return {
        "mqtt": {"type": MqttBridge, "settings": {"broker": address, "report_s": 0.1, "publish": publish, **settings}}
    }


def says(agent: AgentInTest, text: str, level: str = "error") -> None:
    agent.wait_until(lambda: any(text in line for line in agent.lines(level)), what=text)


@pytest.fixture
def locked(tmp_path: Path) -> Any:
    """A broker that speaks TLS, and wants the password of `robot`."""
    authority = Authority(tmp_path, "ours")
    certificate, key = authority.vouch("broker")
    broker = broker_with(
        tmp_path,
        f"certfile {certificate}",
        f"keyfile {key}",
        "allow_anonymous false",
        f"password_file {passwords(tmp_path, robot='secret')}",
    )
    (tmp_path / "password").write_text("secret\n")
    (tmp_path / "password").chmod(0o600)
    settings = {"user": "robot", "password_file": str(tmp_path / "password"), "ca": str(authority.path)}
    yield broker, settings
    broker.end()


def test_it_speaks_tls_and_shows_its_password(locked: Any) -> None:
    broker, settings = locked
    with threaded_agent("a", services=service(f"mqtts://127.0.0.1:{broker.port}", **settings)) as agent:
        agent.wait_for(BrokerTraffic, lambda body: body.connected)
        agent.publish("two", Number(1.0))
        agent.wait_for(BrokerTraffic, lambda body: body.published == 2)


@pytest.mark.parametrize("protocol", ["5", "3.1.1"])
def test_a_wrong_password_is_named_once(locked: Any, tmp_path: Path, protocol: str) -> None:
    broker, settings = locked
    (tmp_path / "password").write_text("sesame\n")
    address = f"mqtts://127.0.0.1:{broker.port}"
    with threaded_agent("a", services=service(address, protocol=protocol, **settings)) as agent:
        says(agent, f"the broker {address} refuses pancakes-a-mqtt: ")
        agent.wait_until(lambda: broker.log().count("not authorised") >= 3)
        (line,) = agent.lines("error")
        assert "look at user and password_file" in line


def test_a_certificate_of_another_authority_is_named(locked: Any, tmp_path: Path) -> None:
    broker, settings = locked
    settings["ca"] = str(Authority(tmp_path, "theirs").path)
    with threaded_agent("a", services=service(f"mqtts://127.0.0.1:{broker.port}", **settings)) as agent:
        says(agent, "is not there (its certificate is not believed (", "warning")
        says(agent, "look at ca, and at the host in broker); trying until it is", "warning")


def test_a_certificate_for_another_host_is_named(locked: Any) -> None:
    broker, settings = locked
    with threaded_agent("a", services=service(f"mqtts://localhost:{broker.port}", **settings)) as agent:
        says(agent, "its certificate is not believed (", "warning")


def test_a_broker_that_wants_a_certificate_gets_it(tmp_path: Path) -> None:
    authority = Authority(tmp_path, "ours")
    certificate, key = authority.vouch("broker")
    lines = (f"cafile {authority.path}", f"certfile {certificate}", f"keyfile {key}", "require_certificate true")
    broker = broker_with(tmp_path, *lines, "allow_anonymous true")
    mine, mine_key = authority.vouch("robot")
    address, ca = f"mqtts://127.0.0.1:{broker.port}", {"ca": str(authority.path)}
    try:
        shown = {**ca, "certificate": str(mine), "key": str(mine_key)}
        with threaded_agent("a", services=service(address, **shown)) as agent:
            agent.wait_for(BrokerTraffic, lambda body: body.connected)
        with threaded_agent("b", services=service(address, **ca)) as agent:
            says(agent, "is not there (", "warning")
    finally:
        broker.end()


def test_tls_at_a_port_without_it_is_named(broker: Mosquitto) -> None:
    with threaded_agent("a", services=service(f"mqtts://127.0.0.1:{broker.port}")) as agent:
        says(agent, "is not there (", "warning")
        assert any("TLS" in line for line in agent.lines("warning"))


@pytest.mark.parametrize(
    ("mode", "text", "problem"),
    [
        (0o644, "secret", "every user of this machine can read"),
        (0o600, "", "is empty; its first line is to be the password"),
        (None, "", "cannot be read: No such file or directory"),
    ],
)
def test_a_password_file_that_cannot_be_used_is_named(
    tmp_path: Path, mode: int | None, text: str, problem: str
) -> None:
    path = tmp_path / "password"
    if mode is not None:
        path.write_text(text)
        path.chmod(mode)
    settings = {"user": "robot", "password_file": str(path)}
    with threaded_agent("a", services=service("mqtt://127.0.0.1:9", **settings)) as agent:
        assert problem in agent.wait_for_event("service_failed", service="mqtt")["error"]


def test_a_qos_that_the_broker_does_not_grant_is_named(tmp_path: Path) -> None:
    broker = broker_with(tmp_path, "max_qos 1", "allow_anonymous true")
    take = [{"topic": "in", "type": "mqtt.number", "qos": 2}]
    try:
        with threaded_agent("a", services=service(broker.address, take=take)) as agent:
            says(agent, "the broker sends in with QoS 1 at the most, not 2", "warning")
            agent.publish("two", Number(1.0))
            says(agent, "the broker takes QoS 1 at the most: out is published with that", "warning")
            agent.wait_for(BrokerTraffic, lambda body: body.published == 2 and not body.waiting)
    finally:
        broker.end()


def test_a_message_that_is_too_large_for_the_broker_is_named_and_the_next_one_goes(tmp_path: Path) -> None:
    broker = broker_with(tmp_path, "max_packet_size 200", "allow_anonymous true")
    try:
        with threaded_agent("a", services=service(broker.address)) as agent:
            agent.wait_for(BrokerTraffic, lambda body: body.connected)
            agent.publish("two", Number(1.0, "x" * 500))
            says(agent, "bytes; the broker takes 200")
            agent.publish("two", Number(1.0))
            agent.wait_for(BrokerTraffic, lambda body: body.published == 2 and body.unsent == 1)
    finally:
        broker.end()


def test_what_the_rules_of_the_broker_forbid_is_named(tmp_path: Path) -> None:
    (tmp_path / "acl").write_text("topic write pancakes/#\n")
    broker = broker_with(tmp_path, "allow_anonymous true", f"acl_file {tmp_path / 'acl'}")
    try:
        with threaded_agent("a", services=service(broker.address)) as agent:
            agent.wait_for(BrokerTraffic, lambda body: body.connected)
            agent.publish("one", Number(1.0))
            says(agent, "the broker refuses what this agent publishes: not authorized")
            agent.wait_for(BrokerTraffic, lambda body: body.unsent == 1 and not body.waiting)
    finally:
        broker.end()


def test_two_connections_of_one_name_are_named(broker: Mosquitto) -> None:
    with threaded_agent("a", services=service(broker.address)) as agent:
        agent.wait_for(BrokerTraffic, lambda body: body.connected)
        with broker.listening("t", "-i", "pancakes-a-mqtt"):
            says(agent, "is another one called pancakes-a-mqtt, too?", "warning")


def test_what_speaks_no_mqtt_is_named(tmp_path: Path) -> None:
    import socket
    import threading

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
