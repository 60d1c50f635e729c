"""`async def` methods of tasks: awaited between turns, one at a time, frozen, cancelled."""

from __future__ import annotations

import asyncio
import gc
import threading
from dataclasses import dataclass, field

import pytest

from pancakes.control import Configure, Describe, Migrate, Start, Stop
from pancakes.errors import ClassError
from pancakes.kernel.actor import core_of
from pancakes.kernel.awaiting import CANCEL_S
from pancakes.kernel.mailbox import Call, tell
from pancakes.packet import SYSTEM, Packet, packet_type
from pancakes.service import Service
from pancakes.supervision.messages import GoOn
from pancakes.task import Task, Tick, every, on


@packet_type("awaiting.ask")
@dataclass(frozen=True)
class Ask:
    """What a task is asked."""

    number: int
    wait_s: float = 0.02


@packet_type("awaiting.answer")
@dataclass(frozen=True)
class Answer:
    """What it answers."""

    number: int


class Fetch(Task):
    """Answers what it is asked, after a while."""

    @dataclass
    class State:
        log: list[str] = field(default_factory=list)
        asked: int = 0

    state: State

    @on(SYSTEM)
    async def fetch(self, ask: Ask, packet: Packet[Ask]) -> None:
        self.state.asked += 1
        self.state.log.append(f"begins {ask.number}")
        try:
            await asyncio.sleep(ask.wait_s)
        except asyncio.CancelledError:
            self.log.info(f"cancelled {ask.number}")
            raise
        self.state.log.append(f"ends {ask.number}")
        self.publish(SYSTEM, Answer(ask.number))

    @on(SYSTEM, Answer)
    def take(self, packet: Packet[Answer]) -> None:
        self.state.log.append(f"hears {packet.body.number}")


def log_of(agent, name="Fetch"):
    return agent.task(name).state.log


def ask(agent, *numbers, wait_s=0.02):
    for number in numbers:
        agent.publish(SYSTEM, Ask(number, wait_s))


def test_async_handlers_run_one_at_a_time(any_agent):
    agent = any_agent(tasks={"Fetch": Fetch})
    ask(agent, 1, 2)
    agent.wait_until(lambda: log_of(agent)[-1:] == ["hears 2"])
    first = ["begins 1", "ends 1", "begins 2", "ends 2"]
    assert [it for it in log_of(agent) if not it.startswith("hears")] == first
    assert [it for it in log_of(agent) if it.startswith("hears")] == ["hears 1", "hears 2"]


def test_async_answer_names_its_cause(any_agent):
    agent = any_agent(tasks={"Fetch": Fetch})
    asked = agent.publish(SYSTEM, Ask(1))
    answer = agent.wait_for(Answer)
    assert answer.cause == (asked.source, asked.seq)


def test_async_sleep_takes_virtual_time(virtual_agent):
    agent = virtual_agent(tasks={"Fetch": Fetch})
    before_s = agent.kernel.now()
    ask(agent, 1, wait_s=30.0)
    answer = agent.wait_for(Answer, timeout_s=60.0)
    assert answer.stamp_s - before_s == pytest.approx(30.0, abs=0.1)


class Poll(Task):
    """Polls something slow."""

    @dataclass
    class State:
        begun: int = 0
        ended: int = 0
        missed: int = 0

    state: State

    async def on_start(self) -> None:
        await asyncio.sleep(0.01)
        self.client = threading.get_ident()

    async def on_stop(self) -> None:
        await asyncio.sleep(0.01)
        self.event("closed", same_thread=self.client == threading.get_ident())

    @every(hz=100)
    async def poll(self, tick: Tick) -> None:
        assert self.state.begun == self.state.ended
        self.state.begun += 1
        self.state.missed += tick.missed
        await asyncio.sleep(0.035)
        self.state.ended += 1


def test_async_ticks_do_not_overlap_and_count_as_missed(any_agent):
    agent = any_agent(tasks={"Poll": Poll})
    agent.wait_until(lambda: agent.task("Poll").state.ended >= 3)
    assert agent.task("Poll").state.missed >= 4


def test_async_hooks_are_awaited_in_the_same_thread(any_agent):
    agent = any_agent(tasks={"Poll": Poll})
    agent.wait_until(lambda: agent.task("Poll").state.ended >= 1)
    assert agent.ask(Stop("client/Poll")).ok
    assert agent.wait_for_event("closed")["same_thread"]


def test_async_task_answers_while_it_awaits(any_agent):
    agent = any_agent(tasks={"Fetch": Fetch})
    ask(agent, 1, wait_s=1000.0)
    agent.wait_until(lambda: log_of(agent) == ["begins 1"])
    reply = agent.ask(Describe("client/Fetch", state=True))
    assert reply.result["state"]["asked"] == 1
    assert agent.ask(Stop("client/Fetch")).ok
    agent.wait_until(lambda: any("cancelled 1" in line for line in agent.lines("info")))


class Careful(Fetch):
    """Notes a change of its settings."""

    @dataclass
    class Settings:
        gain: float = 1.0

    def on_settings(self) -> None:
        self.state.log.append("settings")


def test_async_handler_ends_before_settings_change(any_agent):
    agent = any_agent(tasks={"Careful": Careful})
    ask(agent, 1, wait_s=0.2)
    agent.wait_until(lambda: log_of(agent, "Careful") == ["begins 1"])
    assert agent.ask(Configure("client/Careful", {"gain": 2.0})).ok
    assert log_of(agent, "Careful")[:2] == ["begins 1", "ends 1"] and "settings" in log_of(agent, "Careful")


class Broken(Task):
    """Fails while it awaits."""

    @on(SYSTEM)
    async def fetch(self, ask: Ask) -> None:
        await asyncio.sleep(0.0)
        raise ValueError(f"no answer to {ask.number}")


def test_async_failure_is_that_of_the_task(any_agent):
    agent = any_agent(tasks={"Broken": Broken})
    ask(agent, 7)
    agent.wait_until(lambda: any("no answer to 7" in line for line in agent.lines()))
    agent.wait_for_event("task_failed", task="Broken")


def test_async_task_that_migrates_is_frozen_between_awaits(fleet):
    a, b = fleet.start("a", tasks={"Fetch": Fetch}), fleet.start("b")
    fleet.connect()
    ask(a, 1, wait_s=1000.0)
    a.wait_until(lambda: log_of(a) == ["begins 1"])
    assert a.ask(Migrate("client/Fetch")).ok
    b.wait_until(lambda: "Fetch" in b.running())
    assert log_of(b) == ["begins 1"], "its state moved, and no code of its ran after the snapshot"
    a.wait_until(lambda: "Fetch" not in a.running())
    ask(b, 2)
    b.wait_for(Answer)
    assert log_of(b)[:3] == ["begins 1", "begins 2", "ends 2"]


def test_frozen_coroutine_goes_on_when_the_migration_fails(any_agent):
    agent = any_agent(tasks={"Fetch": Fetch})
    core = core_of(agent.task("Fetch"))
    ask(agent, 1, wait_s=0.05)
    agent.wait_until(lambda: log_of(agent) == ["begins 1"])
    core.actor_inbox.put(Call(core, core.freeze, is_own=True))
    ask(agent, 2, wait_s=0.0)
    agent.wait_until(lambda: core.is_frozen)
    until_s = agent.kernel.host.now() + 0.2
    agent.wait_until(lambda: agent.kernel.host.now() > until_s)
    assert log_of(agent) == ["begins 1"]
    tell(core, GoOn())
    agent.wait_until(lambda: "ends 2" in log_of(agent))
    assert [it for it in log_of(agent) if "hears" not in it] == ["begins 1", "ends 1", "begins 2", "ends 2"]


class Chain(Task):
    """Hands coroutines to `call` and `after`."""

    @dataclass
    class State:
        log: list[str] = field(default_factory=list)

    state: State

    def on_start(self) -> None:
        self.call(lambda: self.later("call"))
        self.after(0.0, lambda: self.later("after"))

    async def later(self, what: str) -> None:
        self.state.log.append(f"{what} begins")
        await asyncio.sleep(0.02)
        self.state.log.append(f"{what} ends")

    @on(SYSTEM)
    async def fetch(self, ask: Ask) -> None:
        """Makes it a task that awaits."""


def test_async_calls_are_awaited(any_agent):
    agent = any_agent(tasks={"Chain": Chain})
    agent.wait_until(lambda: len(log_of(agent, "Chain")) == 4)
    assert log_of(agent, "Chain") in (
        ["call begins", "call ends", "after begins", "after ends"],
        ["after begins", "after ends", "call begins", "call ends"],
    )


class NoThread(Task):
    """Hands over a coroutine, and has no method that awaits."""

    def on_start(self) -> None:
        self.call(self.later)

    async def later(self) -> None:
        await asyncio.sleep(0)


def test_coroutine_of_a_task_without_a_loop_is_refused(any_agent):
    agent = any_agent(tasks={"NoThread": NoThread})
    agent.wait_until(lambda: any("only a task with an `async def` method" in line for line in agent.lines()))


class Stubborn(Task):
    """Does not end when it is cancelled."""

    @on(SYSTEM)
    async def fetch(self, ask: Ask) -> None:
        self.event("begun")
        while True:
            try:
                await asyncio.sleep(1000.0)
            except asyncio.CancelledError:
                self.event("refused")


def test_coroutine_that_does_not_end_is_named(threaded_agent):
    agent = threaded_agent(tasks={"Stubborn": Stubborn})
    ask(agent, 1)
    agent.wait_for_event("begun")
    assert agent.ask(Stop("client/Stubborn")).ok
    agent.wait_for_event("refused", timeout_s=10 * CANCEL_S)
    agent.wait_until(lambda: any("does not end when it is cancelled" in line for line in agent.lines("warning")))


class Careless(Task):
    """Begins what it does not wait for."""

    @on(SYSTEM)
    async def fetch(self, ask: Ask) -> None:
        asyncio.get_running_loop().create_task(self.lose())
        await asyncio.sleep(0.02)
        gc.collect()

    async def lose(self) -> None:
        raise ValueError("lost")


def test_error_that_nobody_waits_for_is_logged(any_agent):
    agent = any_agent(tasks={"Careless": Careless})
    ask(agent, 1)
    agent.wait_until(lambda: any("never retrieved" in it and "lost" in it for it in agent.lines("error")))


class Both(Task):
    """Has two handlers of the same packets."""

    @dataclass
    class State:
        log: list[str] = field(default_factory=list)

    state: State

    @on(SYSTEM, Ask)
    async def first(self, packet: Packet[Ask]) -> None:
        self.state.log.append("first begins")
        await asyncio.sleep(0.02)
        self.state.log.append("first ends")

    @on(SYSTEM, Ask)
    def second(self, packet: Packet[Ask]) -> None:
        self.state.log.append("second")


def test_handler_behind_an_async_one_waits_for_it(any_agent):
    agent = any_agent(tasks={"Both": Both})
    ask(agent, 1, 2)
    agent.wait_until(lambda: len(log_of(agent, "Both")) == 6)
    assert log_of(agent, "Both") == ["first begins", "first ends", "second"] * 2


class Two(Task):
    """Has two handlers of the same packets, of which the first fails."""

    @on(SYSTEM, Ask)
    async def first(self, packet: Packet[Ask]) -> None:
        await asyncio.sleep(0.0)
        raise ValueError("the first fails")

    @on(SYSTEM, Ask)
    async def second(self, packet: Packet[Ask]) -> None:
        self.event("second")


@pytest.mark.filterwarnings("error")
def test_coroutine_behind_one_that_fails_is_dropped(any_agent):
    agent = any_agent(tasks={"Two": Two})
    ask(agent, 1)
    agent.wait_for_event("task_failed", task="Two")
    gc.collect()
    assert not agent.events("second")


def test_service_awaits_nothing():
    with pytest.raises(ClassError, match="a service awaits nothing"):

        class Waiting(Service):
            @on(SYSTEM, Ask)
            async def take(self, packet: Packet) -> None:
                """Never called."""


def test_hook_that_answers_cannot_be_async():
    with pytest.raises(ClassError, match="async def"):

        class Waiting(Task):
            async def on_settings(self) -> None:  # type: ignore[override]
                """Never called."""


class Brief(Task):
    """Ends its coroutines in their first step."""

    async def on_start(self) -> None:
        """Awaits nothing."""

    @on(SYSTEM)
    async def fetch(self, ask: Ask) -> None:
        if ask.wait_s:
            await asyncio.sleep(ask.wait_s)

    async def on_stop(self) -> None:
        """Awaits nothing."""


def test_async_task_ends_whenever_it_is_stopped(threaded_agent):
    """A turn may interrupt its loop just when a coroutine has ended, and nothing has been told of that yet."""
    agent = threaded_agent(tasks={"Brief": Brief})
    for number in range(40):
        ask(agent, number, wait_s=1000.0 * (number % 2))
        assert agent.ask(Stop("client/Brief")).ok
        assert agent.ask(Start("client/Brief")).ok
