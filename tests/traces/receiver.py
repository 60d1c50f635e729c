"""A receiver of OTLP over HTTP in a process of its own, which reads what comes with the protocol of OpenTelemetry."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from typing import Any

PROGRAM = """
import gzip, json, sys
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from opentelemetry.proto.collector.trace.v1 import trace_service_pb2 as otlp

class Receiver(BaseHTTPRequestHandler):
    def do_POST(self):
        data = self.rfile.read(int(self.headers["Content-Length"]))
        if self.headers.get("Content-Encoding") == "gzip":
            data = gzip.decompress(data)
        ok = self.path == "/v1/traces" and self.headers["Content-Type"] == "application/x-protobuf"
        for group in otlp.ExportTraceServiceRequest.FromString(data).resource_spans if ok else ():
            resource = {it.key: it.value.string_value for it in group.resource.attributes}
            for scope in group.scope_spans:
                for it in scope.spans:
                    values = {a.key: getattr(a.value, a.value.WhichOneof("value")) for a in it.attributes}
                    ids = [it.trace_id.hex(), it.span_id.hex(), it.parent_span_id.hex()]
                    times = [it.start_time_unix_nano, it.end_time_unix_nano]
                    print(json.dumps([resource["service.name"], it.name, it.kind, *ids, *times, values]), flush=True)
        self.send_response(int(sys.argv[1]) if ok else 404)
        self.send_header("Content-Type", "application/x-protobuf")
        self.end_headers()
        self.wfile.write(otlp.ExportTraceServiceResponse().SerializeToString())
    def log_message(self, *arguments): pass

server = ThreadingHTTPServer(("127.0.0.1", 0), Receiver)
print(server.server_port, flush=True)
server.serve_forever()
"""


class Received:
    """A span as it came: agent, name, kind, ids, times, attributes."""

    def __init__(self, row: list[Any]) -> None:
        self.agent, self.name, self.kind, self.trace, self.id, self.parent, self.start_ns, self.end_ns, self.says = row


class Receiver:
    """The process.

    Args:
        status: what it answers.
    """

    def __init__(self, status: int = 200) -> None:
        command = [sys.executable, "-c", PROGRAM, str(status)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self._process.stdout is not None
        self.endpoint = f"http://127.0.0.1:{int(self._process.stdout.readline())}/v1/traces"
        self.spans: list[Received] = []
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.spans.append(Received(json.loads(line)))

    def __enter__(self) -> Receiver:
        return self

    def __exit__(self, *error: object) -> None:
        self._process.kill()
        self._process.wait()
        self._thread.join()
        if self._process.stdout is not None:
            self._process.stdout.close()
