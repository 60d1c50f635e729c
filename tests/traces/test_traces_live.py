"""What a receiver of OpenTelemetry gets of agents that run."""

from __future__ import annotations

import contextlib
import logging
import socket
import sys
import threading
import time
import urllib.request

import pytest
from traces.receiver import Receiver

from pancakes.devices import Load, Pose, Temperature, Twist
from pancakes.settings import check_settings
from pancakes.task import Task, every, on
from pancakes.testing import Fleet, threaded_agent
from pancakes.tools.traces import traces_service
from pancakes.tools.traces.spans import Span
from pancakes.tools.traces.traces_service import TracesService

SPAN = Span(1, 2, 0, False, "client/Read load", "internal", 0.0, 0.0, {"pancakes.source": "a/client/Read"})


class Read(Task):
    """Publishes readings."""

    @every(hz=20)
    def read(self, tick):
        self.publish("system", Load(0.5))


class Smooth(Task):
    """Passes readings on, within the agent."""

    @on("system", Load)
    def heard(self, packet):
        self.publish("system", Temperature(20.0))


class Plan(Task):
    """Passes them on to all neighbours."""

    @on("system", Temperature)
    def heard(self, packet):
        self.publish("network", Pose(1.0, 2.0, 0.0), to="*")


class Steer(Task):
    """Commands the wheels."""

    requires = ("motors",)

    @on("network", Pose)
    def heard(self, packet):
        self.publish("ctrl", Twist(0.1, 0.0))


def traces(endpoint, **settings):
    return {"traces": {"type": "traces", "settings": {"endpoint": endpoint, "ratio": 1.0, **settings}}}


def whole_chains(receiver):
    """The commands to actuators that came so far, each behind its causes up to the first one."""
    spans = {it.id: it for it in list(receiver.spans)}
    chains = []
    for command in [it for it in spans.values() if it.says["pancakes.command"]]:
        chain = [command]
        while chain[-1].parent in spans:
            chain.append(spans[chain[-1].parent])
        if not chain[-1].parent:  # else it began before its first cause was heard, or that is still on its way
            chains.append(list(reversed(chain)))
    return chains


class Odd:
    """A collector that begins an answer as it is told, and then sends bytes without an end."""

    def __init__(self, head):
        self._head, self._socket = head, socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"http://127.0.0.1:{self._socket.getsockname()[1]}/v1/traces"
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        while not self._ends.is_set():
            link, _ = self._socket.accept()
            with link, contextlib.suppress(OSError):
                link.settimeout(1.0)
                link.recv(65536)
                link.sendall(self._head)
                while not self._ends.is_set():
                    link.sendall(b"x" * 65536)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._ends.set()
        socket.create_connection(self._socket.getsockname()).close()
        self._thread.join()
        self._socket.close()


def read_more(agent):
    """Waits for some readings more."""
    timer = agent.component("client/Read").timers["read"]
    ticks = timer.ticks
    agent.wait_until(lambda: timer.ticks > ticks + 3)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_a_reading_and_its_command_on_another_agent_are_one_trace_at_the_receiver():
    pytest.importorskip("opentelemetry.exporter.otlp.proto.http")
    with Receiver() as receiver:
        services = traces(receiver.endpoint)
        tasks = {"Read": Read, "Smooth": Smooth, "Plan": Plan}
        with threaded_agent("b", services=services, devices={"motors": "null.motors"}, tasks={"Steer": Steer}):
            with threaded_agent("a", services=services, peers=("local://b",), tasks=tasks) as a:
                a.wait_until(lambda: len(whole_chains(receiver)) >= 3)
        now_ns = time.time_ns()
        for chain in whole_chains(receiver):
            assert [(it.agent, it.name) for it in chain] == [
                ("a", "client/Read load"),
                ("a", "client/Smooth temperature"),
                ("a", "client/Plan pose"),
                ("b", "client/Steer motors"),
            ]
            assert len({it.trace for it in chain}) == 1
            assert all(now_ns - 300e9 < it.start_ns <= it.end_ns <= now_ns for it in chain)


def test_the_last_spans_are_sent_when_the_agent_stops():
    pytest.importorskip("opentelemetry.exporter.otlp.proto.http")
    with Receiver() as receiver:
        with threaded_agent("a", services=traces(receiver.endpoint), tasks={"Read": Read}) as a:
            read_more(a)
        a_has = [it.name for it in receiver.spans]
        limit_s = time.monotonic() + 10.0
        while not a_has and time.monotonic() < limit_s:
            a_has = [it.name for it in receiver.spans]
    assert set(a_has) >= {"client/Read load"}


@pytest.mark.parametrize("status", [0, 400])
def test_spans_that_no_collector_takes_are_lost_and_counted_and_no_task_waits(status):
    pytest.importorskip("opentelemetry.exporter.otlp.proto.http")
    pytest.importorskip("prometheus_client")
    with Receiver(status or 200) as receiver:
        endpoint = receiver.endpoint if status else f"http://127.0.0.1:{free_port()}/v1/traces"
        services = {
            **traces(endpoint, timeout_s=0.2, queue=10),
            "metrics": {"type": "metrics", "settings": {"port": 0}},
        }
        with threaded_agent("a", services=services, tasks={"Read": Read}) as a:
            a.wait_until(lambda: bool(a.events("spans_lost")))
            metrics = f"http://127.0.0.1:{a.component('metrics').facade.port}/metrics"
            a.wait_until(lambda: b"pancakes_spans_lost_total{" in urllib.request.urlopen(metrics, timeout=5).read())
            read_more(a)
            (line, *_) = [it for it in a.lines() if "spans were lost" in it]
            assert "\n" not in line


@pytest.mark.parametrize(
    ("head", "why"),
    [
        (b"HTTP/1.1 200 OK\r\n\r\n", ""),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 1000000000000\r\n\r\n", ""),
        (b"HTTP/1.1 400 Bad\r\n\r\n", "400"),
        (b"HTTP/1.1 302 Found\r\nLocation: http://127.0.0.1:1/x\r\n\r\n", "redirects to http://127.0.0.1:1/x"),
        (b"no HTTP\r\n", ""),
    ],
)
def test_an_answer_without_an_end_or_elsewhere_is_not_read(head, why):
    otlp = pytest.importorskip("pancakes.tools.traces.otlp")
    with Odd(head) as collector:
        export = otlp.SpanExport("a", collector.endpoint, 5.0, 10, time.time_ns)
        export.put([SPAN])
        export.close(20.0)
        sent, lost, said = export.counts()
    assert (sent, lost) == ((1, 0) if b"200" in head else (0, 1))
    assert why in said


def test_an_error_of_the_sdk_ends_no_traces(monkeypatch):
    """Older ones raise what a variable, such as the file of a certificate, brings."""
    otlp = pytest.importorskip("pancakes.tools.traces.otlp")
    with Receiver() as receiver:
        export = otlp.SpanExport("a", receiver.endpoint, 5.0, 10, time.time_ns)
        with monkeypatch.context() as broken:
            raised = threading.Event()

            def export_nothing(*arguments):
                raised.set()
                raise OSError("no certificate")

            broken.setattr(otlp.OTLPSpanExporter, "export", export_nothing)
            export.put([SPAN])
            assert raised.wait(10.0)
        export.put([SPAN])
        export.close(20.0)
        assert export.counts()[:2] == (1, 1)


def test_packets_without_room_are_counted_and_no_others(monkeypatch):
    pytest.importorskip("opentelemetry.exporter.otlp.proto.http")
    monkeypatch.setattr(traces_service, "MOST_HEARD", 0)
    with Receiver() as receiver, threaded_agent("a", services=traces(receiver.endpoint), tasks={"Read": Read}) as a:
        a.wait_until(lambda: bool(a.events("spans_lost")))
        assert any("more than 0 packets came" in it for it in a.lines())


def test_an_agent_whose_collector_is_away_leaves_no_thread_and_no_handler_behind():
    pytest.importorskip("opentelemetry.exporter.otlp.proto.http")
    before = list(logging.getLogger("opentelemetry").handlers)
    endpoint = f"http://127.0.0.1:{free_port()}/v1/traces"
    with threaded_agent("a", services=traces(endpoint, timeout_s=60.0), tasks={"Read": Read}) as a:
        read_more(a)
    for thread in [it for it in threading.enumerate() if it.name == "a-spans"]:
        thread.join(10.0)
        assert not thread.is_alive(), "it does not wait for the whole time of the collector"
    assert [it for it in logging.getLogger("opentelemetry").handlers if it not in before] == []


def test_without_the_extra_the_service_says_what_to_install_and_is_not_started_again(monkeypatch):
    monkeypatch.setitem(sys.modules, "pancakes.tools.traces.otlp", None)
    monkeypatch.setitem(sys.modules, "opentelemetry", None)
    monkeypatch.delitem(sys.modules, "pancakes.tools.traces.otlp")
    for name in [it for it in sys.modules if it.startswith("opentelemetry.")]:
        monkeypatch.delitem(sys.modules, name)
    with threaded_agent("a", services=traces("http://127.0.0.1:1/v1/traces")) as a:
        (failed,) = a.events("service_failed")
        assert failed["then"] == "give up" and failed["error"].endswith("pip install 'pancakes-agents[otel]'")


def test_virtual_time_has_no_traces():
    with Fleet() as fleet:
        a = fleet.start("a", services=traces("http://127.0.0.1:1/v1/traces"))
        fleet.run_for(1.0)
        assert any("sends no traces in virtual time" in it for it in a.lines())


@pytest.mark.parametrize(
    "settings",
    [
        {"endpoint": "127.0.0.1:4318"},
        {"endpoint": "http://127.0.0.1:4318"},
        {"endpoint": "ftp://a/v1/traces"},
        {"ratio": 1.5},
        {"queue": 0},
        {"timeout_s": 0},
        {"sample": 1},
    ],
)
def test_wrong_settings_are_refused(settings):
    assert check_settings(TracesService.Settings, settings)
