"""Send spans to a collector of OpenTelemetry (OTLP over HTTP), in a thread of its own. Needs the SDK.

What waits is bounded. A span that finds no room, or whose batch the collector does not take in time, is lost and
counted: no task waits for a collector.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

import requests
from opentelemetry.context import Context
from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
from opentelemetry.sdk.resources import Resource
from opentelemetry.sdk.trace import ReadableSpan, SpanProcessor, TracerProvider
from opentelemetry.sdk.trace.export import SpanExportResult
from opentelemetry.sdk.trace.id_generator import IdGenerator
from opentelemetry.sdk.trace.sampling import ALWAYS_ON
from opentelemetry.trace import NonRecordingSpan, SpanContext, SpanKind, TraceFlags, set_span_in_context

from pancakes import __version__
from pancakes.errors import LONGEST_TEXT
from pancakes.tools.traces.spans import Span
from pancakes.util.text import printable

BATCH: Final = 512
"""Most spans in one request."""
LONGEST_ANSWER: Final = 65536
"""The most bytes of an answer of the collector that are read. It says little, and no more of it is needed."""
KINDS: Final = {"internal": SpanKind.INTERNAL, "producer": SpanKind.PRODUCER, "consumer": SpanKind.CONSUMER}
LOGGER: Final = "opentelemetry"
"""The logger below which the SDK says why it could not export."""


class _Ids(IdGenerator):
    """Gives a span the ids that it has by its packet."""

    trace_id = span_id = 1

    def generate_trace_id(self) -> int:
        return self.trace_id

    def generate_span_id(self) -> int:
        return self.span_id


class _Ended(SpanProcessor):
    """Collects the spans that have ended."""

    def __init__(self) -> None:
        self.spans: list[ReadableSpan] = []

    def on_end(self, span: ReadableSpan) -> None:
        self.spans.append(span)


class _Said(logging.Handler):
    """Keeps the last thing that the SDK said, which would else go to the terminal."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.text = ""

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage().partition("\n")[0]
        self.text = printable(text[:LONGEST_TEXT])


class _Session(requests.Session):
    """Takes no answer that is no collector's: neither the body of a stream without an end, nor a redirection."""

    def request(self, *args: Any, **others: Any) -> requests.Response:
        answer = super().request(*args, **{**others, "stream": True, "allow_redirects": False})
        length = answer.headers.get("Content-Length", "")
        if length.isdecimal() and int(length) <= LONGEST_ANSWER:
            _ = answer.content  # then the connection is free for the next batch
        else:
            answer.close()
            answer.raw = None  # so that nobody reads it
        if answer.is_redirect:
            raise requests.RequestException(f"it redirects to {answer.headers['Location']}: name that as the endpoint")
        return answer

    def get_redirect_target(self, resp: requests.Response) -> None:
        """Follow none: to find where it leads, `requests` would read the whole body."""


class Encoder:
    """Turns spans into those of the SDK. In one thread.

    Args:
        agent: the name of the agent, which is the name of the service (`service.name`).
    """

    def __init__(self, agent: str) -> None:
        self._ids, self._ended = _Ids(), _Ended()
        about = Resource.create({"service.name": agent, "service.version": __version__})
        provider = TracerProvider(ALWAYS_ON, about, shutdown_on_exit=False, id_generator=self._ids)
        provider.add_span_processor(self._ended)
        self._tracer = provider.get_tracer("pancakes", __version__)

    def encode(self, spans: Iterable[Span], epoch_ns: int) -> list[ReadableSpan]:
        """Return the spans of the SDK.

        Args:
            spans: the spans.
            epoch_ns: the time of day at the host time 0.
        """
        for it in spans:
            self._ids.trace_id, self._ids.span_id = it.trace_id, it.span_id
            context = Context()
            if it.parent_id:
                parent = SpanContext(it.trace_id, it.parent_id, it.is_parent_elsewhere, TraceFlags(TraceFlags.SAMPLED))
                context = set_span_in_context(NonRecordingSpan(parent), context)
            span = self._tracer.start_span(
                it.name, context, KINDS[it.kind], it.attributes, start_time=epoch_ns + int(it.start_s * 1e9)
            )
            span.end(epoch_ns + int(it.end_s * 1e9))
        ended, self._ended.spans = self._ended.spans, []
        return ended


class SpanExport:
    """Sends spans to a collector, in a thread of its own, until it is closed.

    Args:
        agent: the name of the agent.
        endpoint: the URL of the collector, with its path.
        timeout_s: how long the collector may take for a batch, with all retries, in seconds of the host.
        most: the most spans that wait.
        epoch_ns: returns the time of day at the host time 0.
    """

    def __init__(self, agent: str, endpoint: str, timeout_s: float, most: int, epoch_ns: Callable[[], int]) -> None:
        self._most = most
        self._epoch_ns = epoch_ns
        self._said = _Said()
        self._encoder = Encoder(agent)
        self._exporter = OTLPSpanExporter(endpoint, timeout=timeout_s, session=_Session())
        logging.getLogger(LOGGER).addHandler(self._said)
        self._waiting: deque[Span] = deque()
        self._news = threading.Condition()
        self._closing = False
        self._sent = self._lost = 0
        self._why = ""
        self._thread = threading.Thread(target=self._run, name=f"{agent}-spans", daemon=True)
        self._thread.start()

    def put(self, spans: Sequence[Span]) -> None:
        """Send spans, the oldest first; what finds no room is lost. Any thread."""
        with self._news:
            room = self._most - len(self._waiting)
            self._waiting.extend(spans[: max(0, room)])
            if len(spans) > room:
                self._lost += len(spans) - max(0, room)
                self._why = self._why or f"{self._most} spans wait already"
            self._news.notify()

    def counts(self) -> tuple[int, int, str]:
        """Return how many spans were sent and lost so far, and why the last ones were lost. Any thread."""
        with self._news:
            return self._sent, self._lost, self._why

    def close(self, wait_s: float) -> None:
        """Send what waits, and end. Blocks for at most `wait_s` seconds of the host."""
        with self._news:
            self._closing = True
            self._news.notify()
        self._thread.join(wait_s)
        self._exporter.shutdown()  # if the thread still sends, it gives that up

    def _run(self) -> None:
        try:
            self._send()
        finally:
            logging.getLogger(LOGGER).removeHandler(self._said)

    def _send(self) -> None:
        while True:
            with self._news:
                while not self._waiting and not self._closing:
                    self._news.wait()
                batch = [self._waiting.popleft() for _ in range(min(BATCH, len(self._waiting)))]
            if not batch:
                return
            self._said.text = ""
            try:
                result = self._exporter.export(self._encoder.encode(batch, self._epoch_ns()))
            except Exception as error:  # of what only the network or a variable of OpenTelemetry brings: it goes on
                result, self._said.text = SpanExportResult.FAILURE, printable(repr(error)[:LONGEST_TEXT])
            taken = result is SpanExportResult.SUCCESS
            with self._news:
                if taken:
                    self._sent, self._why = self._sent + len(batch), ""
                else:
                    self._lost += len(batch)
                    self._why = self._said.text or "the collector did not take them"
