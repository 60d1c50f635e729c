"""Poses by satellite, from the real gpsd, which gpsfake feeds with sentences of a receiver."""

from __future__ import annotations

import math
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from functools import reduce
from pathlib import Path
from typing import Any

import pytest
from harness.debian_packages import need
from pancakes_pi.gps import GpsPose
from pancakes_pi.gps_reports import Origin, Position, pose_at, position_in, report_in

from pancakes.control import Describe
from pancakes.devices import Pose
from pancakes.testing import AgentHandle, threaded_agent

ORIGIN = {"lat_deg": 48.0, "lon_deg": 11.5}
SLOW_S = 40.0
"""gpsfake may take this long until gpsd knows its receiver, on a busy machine."""


def sentence(body: str) -> str:
    """Returns a sentence of NMEA 0183, with its checksum."""
    return f"${body}*{reduce(lambda total, sign: total ^ sign, body.encode(), 0):02X}\r\n"


def track() -> str:
    """Returns what a receiver says that moves east with 10 knots, from the origin on."""
    told = []
    for number in range(40):
        place, time = f"4800.0000,N,011{30 + 0.006 * number:07.4f},E", f"1200{number:02d}.00"
        told.append(sentence(f"GPGGA,{time},{place},1,08,1.0,500.0,M,46.9,M,,"))
        told.append(sentence(f"GPRMC,{time},A,{place},10.0,90.0,251126,,,A"))
    return "".join(told)


def lost() -> str:
    """Returns what a receiver says that hears no satellite."""
    told = []
    for number in range(40):
        time = f"1200{number:02d}.00"
        told += [sentence(f"GPGGA,{time},,,,,0,00,99.9,,,,,,"), sentence("GPGSA,A,1,,,,,,,,,,,,,99.9,99.9,99.9")]
        told.append(sentence(f"GPRMC,{time},V,,,,,,,251126,,,N"))
    return "".join(told)


class Receiver:
    """A gpsd, with a receiver that says the same again and again.

    Attributes:
        port: where gpsd listens.
    """

    def __init__(self, folder: Path, text: str) -> None:
        self._program = need("gpsfake", "gpsd-clients")
        need("gpsd", "gpsd")
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self._path = folder / "track.nmea"
        self._path.write_text(text)
        self._log = folder / "gpsfake.log"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        places = os.pathsep.join((os.environ["PATH"], "/usr/sbin", "/usr/bin"))
        command = ["/usr/bin/python3", self._program] if sys.prefix != sys.base_prefix else [self._program]
        command += ["-c", "0.02", "-n", "-q", "-P", str(self.port), str(self._path)]
        with open(self._log, "ab") as log:
            self._process = subprocess.Popen(
                command,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env={"PATH": places},
            )

    def end(self) -> None:
        if self._process is not None:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait(10)
            self._process = None


@pytest.fixture
def receiver(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Receiver]:
    """A gpsd that runs; its receiver moves east if the test asks for nothing else."""
    found = Receiver(tmp_path, getattr(request, "param", track()))
    found.start()
    yield found
    found.end()


def device(port: int, **settings: Any) -> dict[str, Any]:
    return {"gps": {"type": GpsPose, "settings": {**ORIGIN, "port": port, **settings}}}


def hears(agent: AgentHandle, times: int) -> None:
    agent.wait_until(lambda: sum("hears gpsd at" in line for line in agent.lines("info")) == times)


def test_gps_poses_are_metres_from_the_origin(receiver: Receiver) -> None:
    with threaded_agent("a", devices=device(receiver.port)) as agent:
        body = agent.wait_for(Pose, lambda body: 100.0 < body.x_m < 250.0, timeout_s=SLOW_S).body
        steps = body.x_m / 7.4578  # 0.006 minutes of longitude at 48 degrees north
        assert steps == pytest.approx(round(steps), abs=0.02)
        assert body.y_m == pytest.approx(0.0, abs=0.01) and body.theta_rad == pytest.approx(0.0, abs=1e-6)


def test_gps_finds_a_gpsd_that_comes_back(receiver: Receiver) -> None:
    with threaded_agent("a", devices=device(receiver.port)) as agent:
        agent.wait_for(Pose, timeout_s=SLOW_S)
        receiver.end()
        agent.wait_until(lambda: any("is gone (" in line for line in agent.lines("error")))
        agent.probe.forget()
        receiver.start()
        agent.wait_for(Pose, timeout_s=SLOW_S)
        assert not agent.events("task_failed") and not agent.lines("error")


def test_gps_finds_a_gpsd_that_starts_later(receiver: Receiver) -> None:
    receiver.end()
    with threaded_agent("a", devices=device(receiver.port)) as agent:
        agent.wait_until(lambda: any("is not there (Connection refused)" in line for line in agent.lines("warning")))
        receiver.start()
        agent.wait_for(Pose, timeout_s=SLOW_S)
        assert len([line for line in agent.lines("warning") if "is not there" in line]) == 1


@pytest.mark.parametrize("receiver", [lost()], indirect=True, ids=["without satellites"])
def test_gps_names_a_receiver_without_a_position_once(receiver: Receiver) -> None:
    with threaded_agent("a", devices=device(receiver.port)) as agent:
        agent.wait_until(lambda: "gps: the receiver does not know where it is" in agent.lines("warning"), SLOW_S)
        hears(agent, 1)
        assert not agent.probe.packets(Pose)


def test_gps_names_a_server_that_is_no_gpsd() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        with threaded_agent("a", devices=device(server.getsockname()[1])) as agent:
            other, _ = server.accept()
            with other:
                other.sendall(b"\xff{]\n[1]\n" + b"x" * 20_000)
                agent.wait_until(lambda: any("(it does not speak like gpsd)" in it for it in agent.lines("error")))
                assert not agent.events("task_failed")


def test_it_refuses_virtual_time_with_a_sentence(virtual_agent: Any) -> None:
    agent = virtual_agent("a", devices=device(2947))
    assert "knows no virtual time" in agent.wait_for_event("task_failed", task="gps")["error"]


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg", "x_m", "y_m"),
    [
        # Lengths of a degree on the ellipsoid of WGS 84: 111,319.49 m of longitude and 110,574.27 m of latitude at the
        # equator; 111,190.3 m of latitude at 48 degrees north.
        (0.001, 0.001, 111.3195, 110.5743),
        (48.001, 0.0, 0.0, 111.1903),
    ],
)
def test_metres_are_those_of_the_ellipsoid(lat_deg: float, lon_deg: float, x_m: float, y_m: float) -> None:
    origin = Origin(float(round(lat_deg)), 0.0)
    assert origin.metres(lat_deg, lon_deg) == (pytest.approx(x_m, abs=0.01), pytest.approx(y_m, abs=0.01))


def test_the_date_line_is_no_wall() -> None:
    east_m, _ = Origin(0.0, 179.9995).metres(0.0, -179.9995)
    assert east_m == pytest.approx(111.32, abs=0.01)


@pytest.mark.parametrize(
    ("track_deg", "theta_rad"), [(90.0, 0.0), (0.0, math.pi / 2), (180.0, -math.pi / 2), (270.0, math.pi)]
)
def test_a_heading_is_told_from_east_counter_clockwise(track_deg: float, theta_rad: float) -> None:
    pose = pose_at(Position(0.0, 0.0, 1.0, track_deg), Origin(0.0, 0.0), 0.3, 9.0)
    assert abs(pose.theta_rad) == pytest.approx(abs(theta_rad)) and math.sin(pose.theta_rad) == pytest.approx(
        math.sin(theta_rad), abs=1e-9
    )


def test_a_receiver_that_stands_keeps_its_heading() -> None:
    for position in (Position(0.0, 0.0, 0.1, 180.0), Position(0.0, 0.0), Position(0.0, 0.0, 5.0, None)):
        assert pose_at(position, Origin(0.0, 0.0), 0.3, 0.7).theta_rad == 0.7


@pytest.mark.parametrize(
    "line",
    [
        b"noise",
        b"[1]",
        b"{}",
        b'{"class":"SKY"}',
        b'{"class":"TPV","mode":1,"lat":1,"lon":2}',
        b'{"class":"TPV","mode":3,"lat":1}',
        b'{"class":"TPV","mode":3,"lat":"1","lon":2}',
        b'{"class":"TPV","mode":3,"lat":91,"lon":2}',
        b'{"class":"TPV","mode":"3","lat":1,"lon":2}',
        b'{"class":"TPV","lat":1,"lon":2}',
    ],
)
def test_what_tells_no_position_is_none(line: bytes) -> None:
    assert position_in(report_in(line)) is None


class Mute:
    """Something that speaks like gpsd on each connection, for as long as it is told, and never ends one."""

    def __init__(self) -> None:
        self.server = socket.create_server(("127.0.0.1", 0))
        self.port: int = self.server.getsockname()[1]
        self._held: list[socket.socket] = []

    def take(self, speak: bool = True) -> None:
        """Takes the next connection, and tells a position."""
        other, _ = self.server.accept()
        self._held.append(other)
        if speak:
            other.sendall(b'{"class":"TPV","mode":3,"lat":48.0,"lon":11.5}\n')

    def close(self) -> None:
        for held in (*self._held, self.server):
            held.close()


def test_gps_dials_again_when_the_connection_has_died_without_a_word() -> None:
    gpsd = Mute()
    try:
        gps = device(gpsd.port)["gps"]
        with threaded_agent("a", devices={"gps": {**gps, "silent_mission_s": 0.5}}) as agent:
            gpsd.take()
            agent.wait_for(Pose)
            agent.wait_until(lambda: agent.ask(Describe("gps")).result["rest"] == "silent")
            assert any("gps: no reading has come for" in line for line in agent.lines("warning"))
            agent.probe.forget()
            gpsd.take(speak=False)
            gpsd.take()
            agent.wait_for(Pose)
            agent.wait_until(lambda: "gps: readings come again" in agent.lines("info"))
            assert agent.ask(Describe("gps")).result["rest"] == ""
            assert not agent.lines("error") and not agent.events("task_failed")
    finally:
        gpsd.close()
