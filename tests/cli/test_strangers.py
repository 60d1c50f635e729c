"""Programs that connect to an agent and send no request do not keep an operator out: real processes and sockets."""

from __future__ import annotations

import threading

from cli.processes import INSECURE, PATIENCE_S, Rig
from cli.strangers import Strangers

from pancakes.client.session import FleetSession
from pancakes.control import Describe
from pancakes.mesh.mesh import MAX_HANDSHAKES
from pancakes.mesh.peers import MAX_AGENTS, MAX_CLIENTS
from pancakes.mesh.transport import SocketTransport
from pancakes.util.clock import MonotonicClock
from pancakes.util.plugins import Plugins

# On a machine with much else to do, a thread that answers for hundreds would be late with its answers to pings.
RARE_PINGS = INSECURE.replace("true }", "true, heartbeat_s = 60.0 }")


def asked(rig: Rig, address: str) -> None:
    """Check that an operator gets an answer, by name and by address."""
    for where in ((), ("--at", address)):
        done = rig.pancakes("agent", "info", "a", *where)
        assert done.returncode == 0, done.stderr
        assert "role" in done.stdout


def test_idle_clients_give_way_to_an_operator(rig: Rig):
    address = rig.address(rig.ready("a", RARE_PINGS))
    with Strangers(address, MAX_CLIENTS, "client") as strangers:
        strangers.wait_until_up(MAX_CLIENTS)
        asked(rig, address)
        strangers.wait_until_refused(1)
        (refusal, *_) = strangers.refusals()
        assert "a is full: it has 64 clients, and this one gave its place to another" in refusal


def test_silent_connections_are_closed_oldest_first(rig: Rig):
    count = MAX_HANDSHAKES + 40
    address = rig.address(rig.ready("a", INSECURE))
    with Strangers(address, count) as strangers:
        strangers.wait_until_refused(count - MAX_HANDSHAKES)
        asked(rig, address)
        assert all("is full: 256 connections" in refusal for refusal in strangers.refusals())


def test_strangers_as_agents_do_not_keep_an_operator_out(rig: Rig):
    address = rig.address(rig.ready("a", RARE_PINGS))
    with Strangers(address, MAX_AGENTS + 20, "agent") as strangers:
        strangers.wait_until_up(MAX_AGENTS - 1)
        asked(rig, address)
        strangers.wait_until_refused(20)
        assert set(strangers.refusals()) == {"a is full: it is in a mesh of 256 already"}


def test_active_clients_can_fill_all_places(rig: Rig):
    address = rig.address(rig.ready("a", INSECURE))
    changed = threading.Condition()

    def news() -> None:
        with changed:
            changed.notify_all()

    clock = MonotonicClock()
    transport = SocketTransport(clock, "busy", Plugins(), {"tcp": {"insecure": True}})
    sessions = [FleetSession(f"busy{number}", "test", transport, clock, news) for number in range(MAX_CLIENTS)]
    done_with = threading.Event()

    def use() -> None:
        while not done_with.wait(1.0):  # one that asks nothing for ten seconds gives way to the operator
            for session in sessions:
                session.request("a", Describe())

    user = threading.Thread(target=use)
    try:
        for session in sessions:
            session.learn(address)
        with changed:
            assert changed.wait_for(lambda: all(session.is_connected("a") for session in sessions), PATIENCE_S)
            numbers = [session.request("a", Describe()) for session in sessions]
            assert changed.wait_for(
                lambda: all(session.answer(number) for session, number in zip(sessions, numbers, strict=True)),
                PATIENCE_S,
            )
        user.start()
        done = rig.pancakes("agent", "info", "a")
        assert done.returncode == 3
        assert "a is full: it has 64 clients, and all of them are in use" in done.stderr
        assert "nothing came within" not in done.stderr
    finally:
        done_with.set()
        if user.ident is not None:
            user.join()
        for session in sessions:
            session.close()
        transport.close()
