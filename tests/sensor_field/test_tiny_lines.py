"""What the drivers of all lines with tiny nodes have in common: on a serial port, over UDP, and in virtual time."""

from __future__ import annotations

import os
import threading
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pancakes_sensor_field.drivers import SerialNodes, TcpNodes, UdpNodes
from pancakes_sensor_field.frame import MOTION, PERIOD, TEMPERATURE, Frame, encode
from pancakes_sensor_field.lines import SerialLine
from pancakes_sensor_field.mote import spoilt
from pancakes_sensor_field.packets import LineReport, ReportPeriod
from sensor_field.tiny_benches import BENCHES, NODES, bench_of

from pancakes.devices import Motion, Temperature
from pancakes.settings import check_settings
from pancakes.testing import threaded_agent


@pytest.fixture(params=list(BENCHES))
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Any]:
    with bench_of(request.param, tmp_path) as made:
        yield made


@pytest.fixture(params=["pty", "virtual"])
def plugged(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Any]:
    """A bench whose line can be unplugged."""
    with bench_of(request.param, tmp_path) as made:
        yield made


def temperature(number: int, celsius: float, node: int = 7) -> bytes:
    return encode(Frame(node, TEMPERATURE, number, round(100 * celsius)))


def test_what_a_tiny_node_says_are_readings_of_virtual_devices(bench: Any) -> None:
    bench.send(temperature(1, -3.25) + encode(Frame(9, MOTION, 1, 1)))
    found = bench.gateway.wait_for(Temperature)
    assert (found.source, found.body) == ("gateway/device/shed_temperature", Temperature(-3.25))
    found = bench.gateway.wait_for(Motion)
    assert (found.source, found.body) == ("gateway/device/gate_motion", Motion(True))


def test_garbage_and_wrong_crcs_are_counted_and_cost_no_good_frame(bench: Any) -> None:
    bench.send(b"\x00\xa5noise" + temperature(1, 20.0) + spoilt(temperature(2, 99.0)) + temperature(3, 21.0))
    bench.gateway.wait_for(Temperature, lambda body: body.celsius == 21.0)
    heard = [
        packet.body.celsius
        for packet in bench.gateway.probe.packets(Temperature, source="gateway/device/shed_temperature")
    ]
    assert heard == [20.0, 21.0]
    report = bench.gateway.wait_for(LineReport, lambda body: body.frames == 2).body
    assert report.connected and report.crc_errors >= 1 and report.skipped_bytes == 7 + 8 and report.missed == 1
    bench.gateway.wait_until(lambda: any("had a wrong CRC" in line for line in bench.gateway.lines("info")))


def ask_for(bench: Any, wish: ReportPeriod) -> None:
    """Publishes a wish, and waits until the line has it: until it complains of the wish that comes next."""
    before = complaints(bench)
    for body in (wish, ReportPeriod(1.0, "nowhere")):
        bench.gateway.publish("system", body, to="gateway/device/line")
    bench.gateway.wait_until(lambda: complaints(bench) > before)


def complaints(bench: Any) -> int:
    return len([line for line in bench.gateway.lines("warning") if "nowhere" in line])


def test_a_report_period_reaches_the_node_just_after_it_has_spoken(bench: Any) -> None:
    ask_for(bench, ReportPeriod(2.5, "shed"))
    bench.send(temperature(1, 20.0))
    assert bench.received(8) == encode(Frame(7, PERIOD, 1, 25))
    bench.send(temperature(1, 20.0, node=9) + encode(Frame(7, PERIOD, 2, 25)) + temperature(3, 21.0))
    bench.gateway.wait_for(Temperature, lambda body: body.celsius == 21.0)
    ask_for(bench, ReportPeriod(3.0))
    bench.send(temperature(2, 22.0, node=9))
    assert bench.received(8) == encode(Frame(9, PERIOD, 2, 30)), "and nothing was said to 7 once it had confirmed"


@pytest.mark.parametrize(
    ("wish", "complaint"),
    [
        (ReportPeriod(1.0, "barn"), "names a tiny node 'barn'; the nodes are shed, gate"),
        (ReportPeriod(0.0), "asks for a report period of 0 s: 0.1 to 3276.7"),
        (Temperature(1.0), "sent 'temperature', which no tiny node understands"),
    ],
)
def test_what_makes_no_sense_is_named(bench: Any, wish: Any, complaint: str) -> None:
    bench.gateway.publish("system", wish, to="gateway/device/line")
    bench.gateway.wait_until(lambda: any(complaint in line for line in bench.gateway.lines("warning")))


def test_a_stranger_is_named_once(bench: Any) -> None:
    bench.send(temperature(1, 20.0, node=8) + temperature(2, 20.0, node=8) + temperature(1, 20.0))
    bench.gateway.wait_for(LineReport, lambda body: body.unknown == 2 and body.frames == 3)
    warnings = [line for line in bench.gateway.lines("warning") if "number 8 speaks" in line]
    assert len(warnings) == 1 and warnings[0].endswith("; the settings do not name it")


def test_an_unplugged_line_is_named_and_found_again(plugged: Any) -> None:
    plugged.send(temperature(1, 20.0) + temperature(2, 20.0)[:4])
    plugged.gateway.wait_for(Temperature)
    plugged.unplug()
    plugged.gateway.wait_until(lambda: any(" is gone (" in line for line in plugged.gateway.lines("error")))
    plugged.gateway.wait_for(LineReport, lambda body: not body.connected)
    before = len([line for line in plugged.gateway.lines("info") if "listens to" in line])
    plugged.plug()
    plugged.gateway.wait_until(
        lambda: len([line for line in plugged.gateway.lines("info") if "listens to" in line]) > before
    )
    plugged.send(temperature(2, 20.0)[4:] + temperature(3, 23.0))
    plugged.gateway.wait_for(Temperature, lambda body: body.celsius == 23.0)
    assert plugged.gateway.probe.packets(LineReport)[-1].body.frames <= 2, "two halves make no whole"
    plugged.gateway.wait_for(LineReport, lambda body: body.frames == 2 and body.skipped_bytes == 8)
    assert len(plugged.gateway.lines("error")) == 1, "it was said once"
    assert not plugged.gateway.events("task_failed"), "the device itself did not fail"


def test_datagrams_share_no_frame(tmp_path: Path) -> None:
    with bench_of("udp", tmp_path) as udp:
        for data in (temperature(1, 99.0)[:4], temperature(1, 99.0)[4:], temperature(2, 20.0)):
            udp.send(data)
        udp.gateway.wait_for(LineReport, lambda body: body.skipped_bytes == 8 and body.frames == 1)
        assert [packet.body.celsius for packet in udp.gateway.probe.packets(Temperature)][-1] == 20.0


def test_a_line_that_stays_away_is_named_once(tmp_path: Path) -> None:
    with bench_of("virtual", tmp_path) as virtual:
        virtual.unplug()
        virtual.fleet.run_for(60.0)
        assert [line.partition(" (")[0] for line in virtual.gateway.lines("error")] == [
            f"line: the line at {virtual.ADDRESS} is gone"
        ]
        assert not any("is not there" in line for line in virtual.gateway.lines("warning"))
        virtual.plug()
        virtual.fleet.run_for(6.0)
        virtual.send(temperature(1, 20.0))
        virtual.gateway.wait_for(Temperature)
        virtual.unplug()
        virtual.fleet.run_for(0.1)
        virtual.plug()
        virtual.fleet.run_for(1.0)
        virtual.send(temperature(2, 21.0))
        virtual.gateway.wait_for(Temperature, lambda body: body.celsius == 21.0)


def test_a_port_that_is_not_there_yet_is_waited_for(tmp_path: Path) -> None:
    port = tmp_path / "none"
    parts = {"line": {"type": SerialNodes, "rate_hz": 20, "settings": {"nodes": NODES, "port": str(port)}}}
    with threaded_agent("gateway", devices=parts) as gateway:
        gateway.wait_for(LineReport, lambda body: not body.connected)
        gateway.wait_until(lambda: bool(gateway.lines("warning")))
        assert gateway.lines("warning") == [
            f"line: the serial port {port} cannot be used (No such file or directory); trying until it can"
        ]


class Hearer:
    """Hears a line without any agent."""

    def __init__(self) -> None:
        self.is_there = threading.Event()

    def found(self) -> None:
        self.is_there.set()

    def heard(self, data: bytes, reply: Any, whole: bool) -> None:
        raise AssertionError(f"{data!r} came from nowhere")

    def lost(self, reason: str) -> None:
        raise AssertionError(reason)


def test_a_serial_port_that_is_silent_can_be_closed_at_once() -> None:
    near, far = os.openpty()
    tty.setraw(far)
    before, hearer, line = threading.enumerate(), Hearer(), SerialLine(os.ttyname(far), 9600)
    line.open(hearer)
    assert hearer.is_there.wait(10.0)
    (thread,) = [thread for thread in threading.enumerate() if thread not in before]
    line.close()
    thread.join(10.0)
    assert not thread.is_alive()
    os.close(near)
    os.close(far)


@pytest.mark.parametrize(
    ("driver", "settings", "problem"),
    [
        (SerialNodes, {"port": "/dev/null"}, "missing"),
        (SerialNodes, {"port": "/dev/null", "nodes": {"a": 7, "b": 7}}, "not the only node with the number 7"),
        (SerialNodes, {"port": "/dev/null", "nodes": {"a": 255}}, "255"),
        (SerialNodes, {"port": "/dev/null", "nodes": {"a": 7}, "period_s": 0.01}, "0.1"),
        (UdpNodes, {"listen": "tcp://127.0.0.1:7421", "nodes": {"a": 7}}, "not an address such as 'udp://"),
        (UdpNodes, {"listen": "udp://127.0.0.1", "nodes": {"a": 7}}, "has no port"),
        (TcpNodes, {"address": "udp://127.0.0.1:7421", "nodes": {"a": 7}}, "not an address such as 'tcp://"),
    ],
)
def test_bad_settings_are_refused_with_a_sentence(driver: Any, settings: dict[str, Any], problem: str) -> None:
    assert any(problem in str(found) for found in check_settings(driver.Settings, settings))
