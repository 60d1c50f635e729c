"""An answer that does not fit a frame is a refusal that says so; what fits is told once."""

from dataclasses import dataclass

import pytest
from cli.processes import INSECURE

from pancakes.control import Configure, Describe, Restart
from pancakes.mesh.codec import MAX_MESSAGE_BYTES
from pancakes.service import Service
from pancakes.supervision.service_core import ServiceCore
from pancakes.task import Task
from pancakes.testing import Fleet, no_thread_left, threaded_agent


class Map(Task):
    """Has a state of the size that it is told."""

    @dataclass
    class Settings:
        size: int = 0

    @dataclass
    class State:
        cells: str = ""

    def on_start(self):
        self.state.cells = "x" * self.settings.size

    on_settings = on_start


class Chatty(ServiceCore, Service):
    """Says more about why it does not start its tasks than fits a frame."""

    __module__ = "pancakes"  # its names are Pancakes' own

    def admit(self, slot):
        return "x" * 300_000


@pytest.fixture
def fleet():
    with Fleet(3) as made:
        made.start("a", tasks={"Map": Map}, services={"chatty": Chatty})
        made.start("b")
        made.connect()
        yield made


def sized(fleet: Fleet, size: int) -> None:
    assert fleet.agents["a"].ask(Configure("Map", {"size": size})).ok


def test_a_state_of_half_a_frame_is_told_once_and_reaches_who_asked_from_elsewhere(fleet):
    sized(fleet, 130_000)
    assert fleet.agents["a"].ask(Restart("Map")).ok  # so that it begins with that, and not only has it now
    reply = fleet.agents["b"].ask(Describe("Map", state=True), to="a")
    assert reply.reason == ""
    assert reply.result["state"] == {"cells": "x" * 130_000}
    assert str(reply.result).count("x" * 130_000) == 1


def test_what_a_task_began_with_is_told_where_that_is_asked_for(fleet):
    sized(fleet, 10)
    told = fleet.agents["b"].ask(Describe("Map", began=True), to="a").result
    assert told["state"] == "running"
    assert told["began"]["state"] == {} and told["began"]["settings"] == {}
    assert "began" not in fleet.agents["b"].ask(Describe("Map", state=True), to="a").result


def test_an_answer_that_does_not_fit_a_frame_is_a_refusal_with_its_size_and_the_limit(fleet):
    sized(fleet, 300_000)
    reply = fleet.agents["b"].ask(Describe("Map", state=True), to="a")
    assert not reply.ok and reply.result is None and reply.number > 0
    assert reply.reason.startswith("the answer is lost: the packet ")
    size, limit = (int(word) for word in reply.reason.split() if word.isdigit() and len(word) > 4)
    assert 300_000 < size < 310_000
    assert MAX_MESSAGE_BYTES - 100 < limit <= MAX_MESSAGE_BYTES


def test_the_root_does_the_same(fleet):
    reply = fleet.agents["b"].ask(Describe(), to="a")
    assert reply.ok  # there is no task yet that could say too much
    fleet.stop("a")
    fleet.start("a", tasks={"Map": {"type": Map, "service": "chatty"}}, services={"chatty": Chatty})
    fleet.connect()
    reply = fleet.agents["b"].ask(Describe(), to="a")
    assert reply.reason.startswith("the answer is lost: ") and "a frame has room" in reply.reason


def test_an_asker_on_the_same_agent_gets_it_whole(fleet):
    sized(fleet, 300_000)
    assert fleet.agents["a"].ask(Describe("Map", state=True)).result["state"] == {"cells": "x" * 300_000}


def test_over_a_link_of_sockets_it_is_a_refusal_too():
    listen = "tcp://127.0.0.1:0"
    tasks = {"Map": {"type": Map, "settings": {"size": 300_000}}}
    with no_thread_left(), threaded_agent("a", INSECURE, tasks=tasks, listen=listen) as a:
        with threaded_agent("b", INSECURE, peers=a.agent.mesh.listen[-1:]) as b:
            b.wait_for_event("peer_up", peer="a")
            reply = b.ask(Describe("Map", state=True), to="a")
            assert "the answer is lost: " in reply.reason and "a frame has room" in reply.reason


def test_an_agent_says_of_itself_once_who_it_is(fleet):
    told = fleet.agents["b"].ask(Describe(), to="a").result
    assert (told["role"], told["fleet"], told["listen"]) == ("agent", "default", ["local://a", "tcp://a:7400"])
    assert not {"name", "role", "fleet", "listen"} & set(told["mesh"])
