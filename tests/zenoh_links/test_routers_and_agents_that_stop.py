"""Routers that die and come back, and agents that stop, while others go on."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path

import pytest
from net.conftest import Ear
from pancakes_zenoh.credit_pool import LEAST_BYTES, TOTAL_BYTES
from pancakes_zenoh.router_session import session_config, waits_between_tries_s
from zenoh_links.routers import Relay, Router, ZenohRig, link_of

LINKS, SENDERS = 24, 4
ENDED = "its session with the routers has ended"


@pytest.fixture
def own_rig(router: Router, tmp_path: Path) -> Iterator[ZenohRig]:
    """Agents with keys, at a router of the test's own."""
    made = ZenohRig(tmp_path, router, keyed=True)
    yield made
    made.close()


@contextmanager
def swallower(router: Router, address: str, silent_s: float = 2.0) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A process that takes links, and the address at which it does."""
    program = Path(__file__).with_name("swallower.py")
    command = [sys.executable, str(program), router.address, address, str(silent_s)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    yield process, process.stdout.readline().strip()
    process.kill()
    process.wait(10)
    process.stdout.close()


@pytest.fixture
def stopped_address(router: Router) -> Iterator[tuple[subprocess.Popen[str], str]]:
    with swallower(router, "zenoh://swallower:1") as made:
        yield made


def test_of_several_agents_one_that_stops_holds_none_of_the_others(router, tmp_path, stopped_address):
    process, address = stopped_address
    rig = ZenohRig(tmp_path, router)
    try:
        senders = [rig.transport(f"sender{number}") for number in range(SENDERS)]
        ears = [rig.ear() for _ in range(LINKS)]
        for number, ear in enumerate(ears):
            senders[number % SENDERS].dial(address, ear)
        here, there = rig.ear(), rig.ear()
        senders[0].dial(rig.transport("healthy").listen(rig.listen_at, lambda: there), here)
        rig.until(lambda: there.connection and all(ear.connection for ear in [*ears, here]))
        links = [link_of(ear) for ear in ears]
        for link in links:
            link.send(bytes(300_000))  # so that each is lent what it may have
        rig.until(lambda: not any(link.unsent() for link in links))
        os.kill(process.pid, signal.SIGSTOP)
        os.waitpid(process.pid, os.WUNTRACED)
        for link in links:
            link.send(bytes(2_000_000))
        gone = sum(2_000_000 - link.unsent() for link in links)
        assert gone <= TOTAL_BYTES + LINKS * LEAST_BYTES
        for _ in range(1_000):
            link_of(here).send(bytes(10_000))
        rig.until(lambda: len(there.data) == 10_000_000)
        rig.until(lambda: all(ear.closed_for for ear in ears))
        assert {reason.rpartition(": ")[2] for ear in ears for reason in ear.closed_for} == {ENDED}, "by its lease"
        assert not here.closed_for
        os.kill(process.pid, signal.SIGCONT)
    finally:
        rig.close()


def test_one_whose_process_dies_is_told_of_without_a_heartbeat(router, tmp_path, stopped_address):
    process, address = stopped_address
    rig = ZenohRig(tmp_path, router)
    try:
        here: Ear = rig.ear()
        rig.transport("a").dial(address, here)
        rig.until(lambda: here.connection)
        process.kill()
        rig.until(lambda: here.closed_for)
        assert here.closed_for[0].endswith("its session with the routers has ended")
    finally:
        rig.close()


def test_one_that_stops_is_told_of_once_it_was_silent_for_as_long_as_it_may(router, tmp_path):
    rig = ZenohRig(tmp_path, router)
    with (
        swallower(router, "zenoh://short:1", 0.5) as (short, at),
        swallower(router, "zenoh://long:1", 5.0) as (long, to),
    ):
        soon, late = rig.ear(), rig.ear()
        transport = rig.transport("a")
        transport.dial(at, soon)
        transport.dial(to, late)
        rig.until(lambda: soon.connection and late.connection)
        for process in (long, short):
            os.kill(process.pid, signal.SIGSTOP)
            os.waitpid(process.pid, os.WUNTRACED)
        rig.until(lambda: soon.closed_for)
        assert soon.closed_for[0].endswith(ENDED) and not late.closed_for
        rig.until(lambda: late.closed_for)
    rig.close()


def test_a_session_tells_its_router_for_how_long_it_may_be_silent():
    config = session_config("client", ["tcp/127.0.0.1:1"], "", "", silent_s=0.5)
    assert config.get_json("transport/link/tx/lease") == "500"


def test_agents_find_each_other_again_once_their_router_is_back(own_rig, router):
    a = own_rig.agent("a")
    b = own_rig.agent("b", [a.address])
    c = own_rig.agent("c", [a.address])
    own_rig.until(lambda: a.knows("b", "c") and b.knows("a", "c") and c.knows("a", "b"))
    router.kill()
    own_rig.until(lambda: a.knows() and b.knows() and c.knows())
    assert all("its session with the routers has ended" in reason for _, reason, _ in a.downs)
    router.start()
    own_rig.until(lambda: a.knows("b", "c") and b.knows("a", "c") and c.knows("a", "b"))
    a.say("b", "hello")
    own_rig.until(lambda: b.packets)


def test_agents_begin_without_a_router_and_meet_once_there_is_one(own_rig, router):
    router.end()
    a = own_rig.agent("a")
    b = own_rig.agent("b", [a.address])
    own_rig.until(lambda: "no router answers at" in b.log("info"))
    router.start()
    own_rig.until(lambda: a.knows("b") and b.knows("a"))


def test_where_no_router_answers_it_is_tried_again_ever_less_often_and_not_by_all_at_once():
    waits_s = [list(islice(waits_between_tries_s(random.Random(seed)), 8)) for seed in range(20)]
    for one in waits_s:
        assert all(half <= wait_s <= 2 * half for wait_s, half in zip(one, (0.5, 1, 2, 4, 4, 4, 4, 4), strict=True))
    assert len({round(one[0], 3) for one in waits_s}) > 15


def test_a_router_that_stops_holds_no_thread_of_an_agent(router, tmp_path):
    rig = ZenohRig(tmp_path, router)
    try:
        here, there = rig.ear(), rig.ear()
        transport = rig.transport("a")
        transport.dial(rig.transport("b").listen(rig.listen_at, lambda: there), here)
        rig.until(lambda: here.connection and there.connection)
        router.send(signal.SIGSTOP)
        ran: list[int] = []
        for number in range(100):
            link_of(here).send(bytes(100_000))
            transport.call_later(0.0, partial(ran.append, number))
        rig.until(lambda: len(ran) == 100)
        assert link_of(here).unsent()
        router.send(signal.SIGCONT)
        rig.until(lambda: len(there.data) == 10_000_000)
    finally:
        rig.close()


def test_agents_at_two_routers_meet_and_an_agent_that_loses_one_takes_the_other(own_rig, router):
    other = Router(joins=router)
    other.start()
    try:
        own_rig.routers = [router.address]
        a = own_rig.agent("a")
        own_rig.routers = [other.address, router.address]
        b = own_rig.agent("b", [a.address])
        own_rig.until(lambda: a.knows("b") and b.knows("a"))
        other.kill()
        own_rig.until(lambda: a.downs and b.downs)
        own_rig.until(lambda: a.knows("b") and b.knows("a"))
    finally:
        other.end()


def test_one_that_loses_its_router_and_has_another_at_once_ends_its_links_at_the_other_end_too(own_rig, router):
    """The other end hears of no death: the agent has come back before its first router takes it for gone."""
    other = Router(joins=router, more=("--silent", "60"))
    other.start()
    relay = Relay(other)
    try:
        a = own_rig.agent("a")
        own_rig.routers, own_rig.silent_s = [relay.address, router.address], 60.0
        b = own_rig.agent("b", [a.address])
        own_rig.until(lambda: a.knows("b") and b.knows("a"))
        relay.lose()
        own_rig.until(lambda: a.downs and b.downs)
        assert "its session with the routers was lost" in a.downs[0][1] and ENDED in b.downs[0][1]
        own_rig.until(lambda: a.knows("b") and b.knows("a"))
    finally:
        relay.close()
        other.end()
