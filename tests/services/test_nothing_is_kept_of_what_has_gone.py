"""An agent keeps the fact that a task was here, and nothing of what it was."""

from __future__ import annotations

import re
from dataclasses import dataclass

from soak.held import held_by

from pancakes.control import Migrate
from pancakes.durable.snapshot import PIECE_BYTES
from pancakes.packet import SYSTEM, packet_type, task_address
from pancakes.task import Task, Tick, every, on

STATE_BYTES = 20 * PIECE_BYTES
SINK = task_address("a/Sink")


class Heavy(Task):
    @dataclass
    class State:
        count: int = 0
        load: bytes = bytes(STATE_BYTES)

    state: State

    @every(hz=5)
    def tick(self, tick: Tick) -> None:
        self.state.count += 1


@packet_type("kept.word")
@dataclass(frozen=True, slots=True)
class Word:
    count: int


class Sink(Task):
    @dataclass
    class State:
        counts: list[int] | None = None

    state: State

    @on(SYSTEM, Word)
    def take(self, packet) -> None:
        self.state.counts = [*(self.state.counts or []), packet.body.count]


class Leaving(Task):
    """Says something in its end, as it leaves."""

    @dataclass
    class State:
        moves: int = 0

    state: State

    def on_stop(self) -> None:
        self.state.moves += 1
        self.publish(SYSTEM, Word(1), to=SINK)


def kept_by(fleet, agent, path):
    """How many bytes a component keeps by itself, besides all that it shares with others."""
    shared = [fleet, fleet.dispatcher, fleet.network, *fleet.journals.values()]
    for whole in (other.agent for other in fleet.agents.values()):
        shared += [whole, whole.kernel, whole.kernel.stream, whole.kernel.registry, whole.kernel.timer]
        shared += [whole.kernel.transport, whole.mesh, whole.records, whole.ledgers, whole.outbox, whole.host_state]
    return held_by(agent.component(path), *shared).size_bytes


def test_state_of_a_task_that_has_gone_is_not_kept(fleet):
    a = fleet.start("a", tasks={"Heavy": Heavy})
    fleet.start("b")
    fleet.connect()
    fleet.run_for(5.0)
    assert kept_by(fleet, a, "client") > STATE_BYTES
    assert a.ask(Migrate("Heavy")).ok
    fleet.run_for(5.0)
    assert a.running() == [] and kept_by(fleet, a, "client") < STATE_BYTES // 2


def test_arrival_of_a_large_state_tells_only_its_size(fleet):
    a = fleet.start("a", tasks={"Heavy": Heavy})
    b = fleet.start("b")
    fleet.connect()
    assert a.ask(Migrate("Heavy")).ok
    told = b.wait_for_event("task_arrived")["state"]
    assert re.fullmatch(r"about \d{7} bytes", told["load"]) and isinstance(told["count"], int)


def test_half_a_snapshot_of_a_gone_agent_is_not_kept(fleet):
    a = fleet.start("a", tasks={"Heavy": Heavy})
    b = fleet.start("b")
    fleet.connect()
    fleet.faults.slow("a", "b", STATE_BYTES / 10)
    a.publish("sysctrl", Migrate("Heavy"))
    client = "kernel/Registrar"
    before = kept_by(fleet, b, client)
    fleet.run_for(5.0)
    assert kept_by(fleet, b, client) > before + STATE_BYTES // 3
    fleet.crash("a")
    b.wait_for_event("peer_down", timeout_s=30.0, peer="a")
    fleet.run_for(1.0)
    assert kept_by(fleet, b, client) < before + PIECE_BYTES


def test_streams_do_not_grow_with_each_move(fleet):
    a = fleet.start("a", tasks={"Sink": Sink, "Leaving": Leaving})
    b = fleet.start("b")
    fleet.connect()
    for _ in range(5):
        for agent in (a, b):
            assert agent.ask(Migrate("Leaving")).ok
            fleet.run_for(1.0)
    assert a.task("Sink").state.counts == [1] * 10
    # Of each life of each agent there is one stream, not one for each move.
    assert len(a.component("client/Sink").carry().heard) == 2
