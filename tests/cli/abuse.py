"""Clients that send live agents commands at a high rate, and record the replies and events."""

from __future__ import annotations

import json
import threading
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from cli.processes import PATIENCE_S, Rig, Running

from pancakes.client.session import Answer, FleetSession
from pancakes.control import Follow, Reply
from pancakes.events import Event
from pancakes.mesh.transport import SocketTransport
from pancakes.packet import LOG, Packet
from pancakes.util.clock import MonotonicClock
from pancakes.util.plugins import Plugins

RATE_HZ = 200.0
CLIENTS = 4


@dataclass(frozen=True, order=True)
class Told:
    """An event on `log` that a request caused.

    Attributes:
        number: the request's place in the agent's order.
        source: the component that published it.
        what: the other fields.
    """

    number: int
    source: str
    what: str


@dataclass
class Asked:
    """A command that was sent.

    Attributes:
        client: the index of the client that sent it.
        number: that client's number for it.
        agent: the agent that it was sent to.
        body: the control packet's body.
    """

    client: int
    number: int
    agent: str
    body: Any


@dataclass
class Answered:
    """A command, and the agent's reply to it."""

    asked: Asked
    reply: Reply


@dataclass
class Listener:
    """One client: it sends commands, and follows the `log` of every agent.

    Attributes:
        told: the numbered events, by agent, in the order in which they came.
    """

    session: FleetSession
    transport: SocketTransport
    told: dict[str, list[Told]] = field(default_factory=dict)


class Abuse:
    """Four concurrent clients, each with its own transport and its own link to each agent.

    Args:
        rig: where the agents are.
        agents: the agents, by name.
    """

    def __init__(self, rig: Rig, agents: dict[str, Running]) -> None:
        self.clock = MonotonicClock()
        self._changed = threading.Condition()
        self.clients: list[Listener] = []
        for index in range(CLIENTS):
            transport = SocketTransport(self.clock, f"abuse{index}", Plugins(), {"tcp": {"insecure": True}})
            session = FleetSession(f"abuse{index}", "test", transport, self.clock, self._news)
            client = Listener(session, transport, {name: [] for name in agents})
            session.listen(partial(self._heard, client))
            for running in agents.values():
                session.learn(rig.address(running))
            self.clients.append(client)
        self.wait(lambda: all(client.session.is_connected(name) for client in self.clients for name in agents))
        for index in range(CLIENTS):
            for name in agents:
                assert self.ask(index, name, Follow("log")).ok

    def close(self) -> None:
        """Close all clients."""
        for client in self.clients:
            client.session.close()
            client.transport.close()

    def send(self, client: int, agent: str, body: Any) -> Asked:
        """Send a command, and do not wait."""
        return Asked(client, self.clients[client].session.request(agent, body), agent, body)

    def ask(self, client: int, agent: str, body: Any) -> Reply:
        """Send a command, and wait for its reply."""
        return self.replies([self.send(client, agent, body)])[0].reply

    def offer(self, commands: list[tuple[str, Any]]) -> list[Asked]:
        """Send commands, `RATE_HZ` per second, through each client in turn."""
        begun_s = self.clock.now()
        sent = []
        for index, (agent, body) in enumerate(commands):
            due_s = begun_s + index / RATE_HZ
            with self._changed:
                while (left_s := due_s - self.clock.now()) > 0:
                    self._changed.wait(left_s)
            sent.append(self.send(index % CLIENTS, agent, body))
        return sent

    def replies(self, sent: list[Asked]) -> list[Answered]:
        """Wait for the reply to each command; none may be lost or time out."""

        def answer(asked: Asked) -> Answer | None:
            return self.clients[asked.client].session.answer(asked.number)

        waiting = list(sent)

        def done() -> bool:
            waiting[:] = [asked for asked in waiting if answer(asked) is None]
            return not waiting

        self.wait(done, lambda: f"{len(waiting)} of {len(sent)} commands were never answered: {waiting[:5]}")
        found = []
        for asked in sent:
            reply = answer(asked)
            assert isinstance(reply, Reply), f"{asked} came to nothing: {reply}"
            found.append(Answered(asked, reply))
        return found

    def wait(self, condition: Any, why: Any = lambda: "the condition never held") -> None:
        """Wait until a condition holds."""
        until_s = self.clock.now() + PATIENCE_S
        with self._changed:
            while not condition():
                assert self.clock.now() < until_s, why()
                self._changed.wait(0.1)

    def _news(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _heard(self, client: Listener, agent: str, packet: Packet) -> None:
        body = packet.body
        if packet.channel == LOG and isinstance(body, Event) and "number" in body.fields:
            client.told[agent].append(_told(packet.source, body.kind, body.fields))


def in_file(path: Path) -> list[Told]:
    """Return the numbered events in the file of an agent's Log Service."""
    records = [json.loads(line) for line in path.read_text().splitlines()]
    return [
        _told(record["source"], record["kind"], record) for record in records if "number" in record and "by" in record
    ]


def _told(source: str, kind: str, fields: Any) -> Told:
    what = " ".join(str(fields.get(key, "")) for key in ("what", "task", "by"))
    return Told(fields["number"], source, f"{kind} {what}")
