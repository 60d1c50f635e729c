"""Send traces to a collector of OpenTelemetry.

The program stands for a collector: it takes OTLP over HTTP, and says what it got of the first reading. The agent is
started as `pancakes-agent --config robot1.toml` would start it.

$ python examples/send_traces.py
robot1 sent the span 'device/load load'
it begins a trace: True
it has {'pancakes.channel': 'system', 'pancakes.command': False, 'pancakes.source': 'robot1/device/load'}
"""

import subprocess
import sys
import tempfile
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import (
    ExportTraceServiceRequest,
    ExportTraceServiceResponse,
)

ROBOT1 = """
schema = 1

[agent]
name = "robot1"
fleet = "examples"
state_dir = "{folder}/state"

[device.load]
driver = "host.load"
rate_hz = 10

[service.traces]
type = "traces"
settings = {{ endpoint = "http://127.0.0.1:{port}/v1/traces", ratio = 1.0 }}
"""
SHOWN = ("pancakes.channel", "pancakes.command", "pancakes.source")

requests: list[ExportTraceServiceRequest] = []


class Collector(BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        data = self.rfile.read(int(self.headers["Content-Length"]))
        requests.append(ExportTraceServiceRequest.FromString(data))
        self.send_response(200)
        self.end_headers()
        self.wfile.write(ExportTraceServiceResponse().SerializeToString())

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


with tempfile.TemporaryDirectory() as folder, HTTPServer(("127.0.0.1", 0), Collector) as collector:
    file = Path(folder, "robot1.toml")
    file.write_text(ROBOT1.format(folder=folder, port=collector.server_port))
    program = Path(sys.executable).with_name("pancakes-agent")
    with subprocess.Popen([program, "--config", file], stderr=subprocess.DEVNULL) as agent:
        try:
            collector.handle_request()
        finally:
            agent.terminate()

(group,) = requests[0].resource_spans
names = {it.key: it.value.string_value for it in group.resource.attributes}
span = group.scope_spans[0].spans[0]
print(names["service.name"], "sent the span", repr(span.name))
print("it begins a trace:", not span.parent_span_id)
says = {it.key: it.value.string_value or it.value.bool_value for it in span.attributes if it.key in SHOWN}
print("it has", dict(sorted(says.items())))
