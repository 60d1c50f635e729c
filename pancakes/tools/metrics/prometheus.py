"""The metrics of an agent for Prometheus, and the HTTP server for them on the loopback interface.

Some metrics are counted when something happens, the others are read at each request. Needs `prometheus_client`.
"""

from __future__ import annotations

import contextlib
import hmac
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from http import HTTPStatus
from itertools import chain
from socketserver import ThreadingMixIn
from typing import Any, Final
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from prometheus_client import (
    CollectorRegistry,
    Counter,
    GCCollector,
    Histogram,
    PlatformCollector,
    ProcessCollector,
    make_wsgi_app,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from pancakes.errors import describe
from pancakes.events import Event
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Runnable
from pancakes.kernel.timer import TaskTimer
from pancakes.supervision.lifecycle import State
from pancakes.tools.loopback import names_loopback

BUCKETS_S: Final = (0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)


TIMER: Final = "agent service task timer"
GUARDED: Final = "agent service task"
MAILBOX: Final = "agent service task channel"
FAMILIES: Final[Sequence[tuple[str, Any, str, str]]] = (
    ("task_rate_hertz", GaugeMetricFamily, "The wanted rate.", TIMER),
    ("task_ticks", CounterMetricFamily, "Ticks so far.", TIMER),
    ("task_missed_ticks", CounterMetricFamily, "Ticks that were skipped.", TIMER),
    ("mailbox_waiting_packets", GaugeMetricFamily, "Packets that wait.", MAILBOX),
    ("mailbox_handled_packets", CounterMetricFamily, "Packets that were handled.", MAILBOX),
    ("mailbox_dropped_packets", CounterMetricFamily, "Packets that a slow reader lost.", MAILBOX),
    ("task_running", GaugeMetricFamily, "Whether a task runs.", "agent service task"),
    ("task_starts", CounterMetricFamily, "How often a task was started.", "agent service task"),
    ("guard_permit_seconds", GaugeMetricFamily, "How long a guarded task may still act.", GUARDED),
    ("guard_answering_guardians", GaugeMetricFamily, "Guardians that have answered within a lease.", GUARDED),
    ("guard_wanted_guardians", GaugeMetricFamily, "Guardians that a task should have.", GUARDED),
    (
        "guard_checkpoint_age_seconds",
        GaugeMetricFamily,
        "Age of the newest checkpoint that more than half of the guardians of a task hold.",
        GUARDED,
    ),
    ("link_round_trip_seconds", GaugeMetricFamily, "Round trip of a link, smoothed.", "agent peer"),
    ("link_sent_packets", CounterMetricFamily, "Packets sent.", "agent peer"),
    ("link_received_packets", CounterMetricFamily, "Packets received.", "agent peer"),
    ("link_sent_bytes", CounterMetricFamily, "Bytes sent.", "agent peer"),
    ("link_received_bytes", CounterMetricFamily, "Bytes received.", "agent peer"),
    ("link_waiting_packets", GaugeMetricFamily, "Packets that wait for a peer.", "agent peer"),
    ("link_dropped_packets", CounterMetricFamily, "Packets that were dropped for a slow peer.", "agent peer channel"),
    ("undelivered_packets", CounterMetricFamily, "Packets that no subscriber took.", "agent"),
    ("dead_letters", CounterMetricFamily, "Packets whose handler failed.", "agent"),
    ("disk_syncs", CounterMetricFamily, "Waits for the disk (fsync).", "agent"),
    ("disk_written_bytes", CounterMetricFamily, "Bytes written to the agent's journal.", "agent"),
    ("mission_seconds", GaugeMetricFamily, "The agent's mission clock.", "agent"),
    ("battery_level_ratio", GaugeMetricFamily, "The level of the battery, 0 to 1.", "agent"),
)
"""The metrics that are read at each request: name, kind, description, labels."""

_Value = tuple[str, list[str], float]
"""The name of a metric, the values of its labels, and its own value."""


class AgentMetrics(Collector):
    """All metrics of one agent.

    Args:
        kernel: the agent's kernel.

    Attributes:
        registry: the registry that is served.
        battery_level: the last level of the agent's battery, from 0 to 1; None before the first reading.
    """

    def __init__(self, kernel: Kernel) -> None:
        self._kernel = kernel
        self.battery_level: float | None = None
        self.registry = CollectorRegistry()
        # Register it first: its `collect` removes the labels of ended tasks before the other metrics are read.
        self.registry.register(self)
        self._lateness = Histogram(
            "pancakes_task_lateness_seconds",
            "How late ticks of time-driven tasks were, in mission time.",
            ["agent", "service", "task", "timer"],
            buckets=BUCKETS_S,
            registry=self.registry,
        )
        self._late: dict[TaskTimer, Any] = {}
        self._migrations = Counter(
            "pancakes_migrations", "Migrations of tasks from this agent.", ["agent", "outcome"], registry=self.registry
        )
        self._arrivals = Counter(
            "pancakes_task_arrivals", "Tasks that came from other agents.", ["agent"], registry=self.registry
        )
        self._takeovers = Counter(
            "pancakes_guard_takeovers",
            "Take-overs of a guarded task whose agent was lost.",
            ["agent", "service", "task"],
            registry=self.registry,
        )
        self._failures = Counter(
            "pancakes_task_failures",
            "Failures of tasks.",
            ["agent", "service", "task", "then"],
            registry=self.registry,
        )
        self._requests = Counter(
            "pancakes_control_changes",
            "Changes made by control packets.",
            ["agent", "kind"],
            registry=self.registry,
        )
        self._spans_lost = Counter(
            "pancakes_spans_lost", "Spans of traces that no collector took.", ["agent"], registry=self.registry
        )
        ProcessCollector(registry=self.registry)
        PlatformCollector(registry=self.registry)
        GCCollector(registry=self.registry)

    # Counted when it happens -----------------------------------------------------------------------------------

    def ticked(self, timer: TaskTimer, lateness_s: float) -> None:
        """Count a tick. Called in the task's turn, so the labels are looked up only once."""
        child = self._late.get(timer)
        if child is None:
            child = self._late[timer] = self._lateness.labels(*_place(timer.component), timer.method)
        child.observe(lateness_s)

    def happened(self, source: str, event: Event) -> None:
        """Count an event of this agent; `source` is the address that published it."""
        agent, fields = self._kernel.agent, event.fields
        service = (*source.split("/"), "")[1]  # a service publishes the events of its tasks
        if event.kind == "migration" and fields["source"] == agent and not fields.get("dry_run"):
            self._migrations.labels(agent, fields["outcome"]).inc()
        elif event.kind == "task_arrived":
            self._arrivals.labels(agent).inc()
        elif event.kind == "task_taken":
            self._takeovers.labels(agent, service, fields["task"]).inc()
        elif event.kind == "task_failed":
            self._failures.labels(agent, service, fields["task"], fields["then"]).inc()
        elif event.kind == "spans_lost":
            self._spans_lost.labels(agent).inc(fields["count"])
        elif event.kind in ("asked", "rate_changed", "settings_changed"):
            self._requests.labels(agent, str(fields.get("what", event.kind))).inc()

    # Read at each request --------------------------------------------------------------------------------------

    def collect(self) -> Iterator[Metric]:
        """Read the other metrics. Called in the thread of the HTTP server."""
        self._forget()
        families = {name: kind(f"pancakes_{name}", text, labels=names.split()) for name, kind, text, names in FAMILIES}
        parts = (self._timers(), self._mailboxes(), self._tasks(), self._guards(), self._links(), self._agent())
        for name, labels, value in chain(*parts):
            families[name].add_metric(labels, value)
        yield from families.values()

    def describe(self) -> Iterator[Metric]:
        """Describe nothing in advance, because the metrics depend on the agent."""
        return iter(())

    def _forget(self) -> None:
        """Remove the labels of tasks that have ended, so that changing names do not fill the memory."""
        alive = set(self._kernel.task_timers.all())
        known = {timer: (*_place(timer.component), timer.method) for timer in list(self._late)}
        kept = {labels for timer, labels in known.items() if timer in alive}
        for timer, labels in known.items():
            if timer not in alive:
                self._late.pop(timer, None)
                if labels not in kept:
                    self._lateness.remove(*labels)

    def _timers(self) -> Iterator[_Value]:
        for timer in self._kernel.task_timers.all():
            labels = [*_place(timer.component), timer.method]
            yield "task_rate_hertz", labels, timer.rate_hz
            yield "task_ticks", labels, timer.ticks
            yield "task_missed_ticks", labels, timer.missed_total

    def _mailboxes(self) -> Iterator[_Value]:
        for component in self._kernel.registry.components():
            for channel, box in list(component.actor_inbox.queues.items()):
                labels = [*_place(component), channel]
                yield "mailbox_waiting_packets", labels, len(box)
                yield "mailbox_handled_packets", labels, box.handled
                yield "mailbox_dropped_packets", labels, box.dropped()

    def _tasks(self) -> Iterator[_Value]:
        for task in self._kernel.tasks.all():
            labels = [self._kernel.agent, task.service, task.name]
            yield "task_running", labels, task.life.state is State.RUNNING
            yield "task_starts", labels, task.life.incarnation

    def _guards(self) -> Iterator[_Value]:
        now_s = self._kernel.host.now()
        for address, note in self._kernel.guard_notes.all().items():
            labels = address.split("/")
            self._takeovers.labels(*labels)  # so that a task without a take-over is served with the count 0
            guarding = note.plain(now_s, self._kernel.permits.left_s(note.right))
            yield "guard_permit_seconds", labels, guarding["permit_s"]
            yield "guard_answering_guardians", labels, guarding["answering"]
            yield "guard_wanted_guardians", labels, guarding["guard"]
            if guarding["age_s"] is not None:
                yield "guard_checkpoint_age_seconds", labels, guarding["age_s"]

    def _links(self) -> Iterator[_Value]:
        for peer in self._kernel.links():
            labels = [self._kernel.agent, peer["name"]]
            if peer["rtt_s"] is not None:
                yield "link_round_trip_seconds", labels, peer["rtt_s"]
            yield "link_sent_packets", labels, peer["packets_out"]
            yield "link_received_packets", labels, peer["packets_in"]
            yield "link_sent_bytes", labels, peer["bytes_out"]
            yield "link_received_bytes", labels, peer["bytes_in"]
            yield "link_waiting_packets", labels, sum(peer["waiting"].values())
            for channel, count in peer["dropped"].items():
                yield "link_dropped_packets", [*labels, channel], count

    def _agent(self) -> Iterator[_Value]:
        kernel = self._kernel
        yield "undelivered_packets", [kernel.agent], kernel.stream.undelivered
        yield "dead_letters", [kernel.agent], kernel.dead_letters.count
        syncs, written_bytes = kernel.disk_use()
        yield "disk_syncs", [kernel.agent], syncs
        yield "disk_written_bytes", [kernel.agent], written_bytes
        yield "mission_seconds", [kernel.agent], kernel.mission.now()
        if self.battery_level is not None:
            yield "battery_level_ratio", [kernel.agent], self.battery_level


def _place(component: Runnable) -> tuple[str, str, str]:
    """Return agent, service and task of a component; for a service the task is empty."""
    agent, service, task = (*component.address.split("/"), "", "")[:3]
    return agent, service, task


HOST: Final = "127.0.0.1"
"""Only this machine is served, because metrics reveal much about an agent, and any program may request them."""
REQUEST_S: Final = 5.0
"""The time that a request may take to arrive, in host time; then its connection is closed."""
MOST_REQUESTS: Final = 16
"""The most requests that are answered at a time."""
LONGEST_BODY: Final = 64 * 1024
"""The most bytes that are read of a body. No request needs one, but its sender must get to read the answer."""

_Respond = Callable[[str, list[tuple[str, str]]], object]


class MetricsServer:
    """Answer GET requests that name the loopback interface, in its own threads, until it is closed.

    Args:
        port: the port; 0: a free one.
        registry: the metrics to serve.
        token: the token that a request must have, as `Authorization: Bearer TOKEN`; empty: none.

    Attributes:
        port: the port of the server.

    Raises:
        OSError: the port is not available.
    """

    def __init__(self, port: int, registry: CollectorRegistry, token: str) -> None:
        self._server = _Server((HOST, port), _MetricsRequestHandler)
        self._server.set_app(_guarded(make_wsgi_app(registry), token))
        self.port = self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, name="metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the server. Do not call it from one of the server's own threads."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingMixIn, WSGIServer):
    """A server with a thread for each request, and at most `MOST_REQUESTS` at a time."""

    daemon_threads = True

    def __init__(self, *arguments: Any) -> None:
        self._room = threading.Semaphore(MOST_REQUESTS)
        super().__init__(*arguments)

    def process_request(self, request: Any, client_address: Any) -> None:
        if self._room.acquire(blocking=False):
            super().process_request(request, client_address)
            return
        full = HTTPStatus.SERVICE_UNAVAILABLE
        with contextlib.suppress(OSError):
            head = f"HTTP/1.1 {full.value} {full.phrase}\r\nConnection: close\r\n\r\n"
            request.send(f"{head}busy: {MOST_REQUESTS} requests are being answered\n".encode())
        self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log nothing about a request that breaks off or never arrives."""


class _MetricsRequestHandler(WSGIRequestHandler):
    """Read one request, and log nothing."""

    timeout = REQUEST_S

    def log_message(self, format: str, *args: Any) -> None:
        """Do nothing."""


def _guarded(metrics: Callable[..., Iterable[bytes]], token: str) -> Callable[..., Iterable[bytes]]:
    """Return a WSGI application that passes on permitted requests, and refuses others with a reason."""

    def answer(environ: dict[str, Any], respond: _Respond) -> Iterable[bytes]:
        method = environ["REQUEST_METHOD"]
        if not names_loopback([environ.get("HTTP_HOST", "")]):
            return _refuse(environ, respond, HTTPStatus.MISDIRECTED_REQUEST, f"these metrics are at http://{HOST} only")
        if method != "GET":
            sentence = f"{method[:20]} is not supported here: use GET"
            return _refuse(environ, respond, HTTPStatus.METHOD_NOT_ALLOWED, sentence, ("Allow", "GET"))
        if token and not hmac.compare_digest(
            environ.get("HTTP_AUTHORIZATION", "").encode(), f"Bearer {token}".encode()
        ):
            challenge = ("WWW-Authenticate", "Bearer")
            return _refuse(
                environ, respond, HTTPStatus.UNAUTHORIZED, "send the token from the file that the log names", challenge
            )
        try:
            return metrics(environ, respond)
        except Exception as error:  # otherwise the library would print a traceback
            sentence = f"a defect in Pancakes or in prometheus_client: {describe(error)}"
            return _refuse(environ, respond, HTTPStatus.INTERNAL_SERVER_ERROR, sentence)

    return answer


def _refuse(
    environ: dict[str, Any], respond: _Respond, status: HTTPStatus, sentence: str, *headers: tuple[str, str]
) -> Iterable[bytes]:
    length = environ.get("CONTENT_LENGTH", "")
    if length.isascii() and length.isdigit():
        with contextlib.suppress(OSError):  # its sender may have announced more than it sends
            environ["wsgi.input"].read(min(int(length[:9]), LONGEST_BODY))
    respond(f"{status.value} {status.phrase}", [("Content-Type", "text/plain; charset=utf-8"), *headers])
    return [f"{sentence}\n".encode()]
