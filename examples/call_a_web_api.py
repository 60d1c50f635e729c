"""Call a web API from a task, without making other tasks wait.

The task awaits each request (`async def`). The agent runs on threads and in real time here, because a real server
answers.

$ python examples/call_a_web_api.py
POST /load {"cpu":0.25}
POST /load {"cpu":0.25}
reported at least twice: True
"""

from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Event, Thread

import httpx

from pancakes import SYSTEM, Sensor, Task, on
from pancakes.devices import Load
from pancakes.testing import threaded_agent


@dataclass
class UplinkSettings:
    url: str


@dataclass
class UplinkState:
    reported: int = 0


class Uplink(Task[UplinkSettings, UplinkState]):
    async def on_start(self) -> None:
        self._http = httpx.AsyncClient(timeout=5.0)

    @on(SYSTEM, queue="latest")
    async def report(self, load: Load) -> None:
        answer = await self._http.post(self.settings.url, json={"cpu": load.cpu})
        answer.raise_for_status()
        self.state.reported += 1

    async def on_stop(self) -> None:
        await self._http.aclose()


class Computer(Sensor):
    """Stands for `host.load`, so that the output is always the same."""

    type = "load"

    def read(self) -> Load:
        return Load(0.25)


class WebApi(BaseHTTPRequestHandler):
    """The server: a program of somebody else."""

    requests = 0
    heard_two = Event()

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"])).decode()
        WebApi.requests += 1
        if WebApi.requests <= 2:
            print("POST", self.path, body)
        self.send_response(204)
        self.end_headers()
        if WebApi.requests == 2:
            WebApi.heard_two.set()

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


with ThreadingHTTPServer(("127.0.0.1", 0), WebApi) as server:
    thread = Thread(target=server.serve_forever)
    thread.start()
    uplink = {"type": Uplink, "settings": {"url": f"http://127.0.0.1:{server.server_port}/load"}}
    load = {"type": Computer, "rate_hz": 5}
    with threaded_agent("robot1", tasks={"Uplink": uplink}, devices={"load": load}) as agent:
        WebApi.heard_two.wait(10.0)
        agent.wait_until(lambda: agent.task("Uplink").state.reported >= 2)
        print("reported at least twice: True")
    server.shutdown()
    thread.join()
