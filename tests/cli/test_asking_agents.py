"""Tasks on running agents ask each other, while one migrates and the agent of the other is killed."""

import signal

from cli.processes import Rig

SOURCE = """
import asyncio
from dataclasses import dataclass

from pancakes import Answer, Pending, Request, RequestError, Task, Tick, answers, every, packet_type, task_address


@packet_type("plugin.count_to")
class CountTo(Request[str, int], frozen=True):
    n: int


@packet_type("plugin.name")
class Name(Request[str], frozen=True):
    after_s: float


class Counter(Task):
    @dataclass
    class State:
        goal: Pending[str, int] | None = None
        n: int = 0
        to: int = 0

    @answers(CountTo)
    def count_to(self, request: CountTo, pending: Pending[str, int]) -> None:
        self.state.goal, self.state.n, self.state.to = pending, 0, request.n  # a killed asker may ask again

    @answers(Name)
    async def tell_name(self, request: Name) -> str:
        await asyncio.sleep(request.after_s)
        return self.agent

    @every(hz=10)
    def count(self, tick: Tick) -> None:
        if self.state.goal is None:
            return
        self.state.n += 1
        self.state.goal.feedback(self.state.n)
        if self.state.n == self.state.to:
            self.state.goal.answer(f"counted on {self.agent}")
            self.state.goal = None


class Asker(Task):
    @dataclass
    class State:
        asked: bool = False

    @every(hz=5)
    def ask_once(self, tick: Tick) -> None:
        if not self.state.asked:
            self.state.asked = True
            self.ask(task_address("a/Counter"), CountTo(40), then=self.done, timeout_s=60.0, feedback=self.felt)

    def felt(self, n: int) -> None:
        self.event("felt", n=n)

    def done(self, answer: Answer[str]) -> None:
        self.event("answered", text=answer.result())


class Waiter(Task):
    @every(hz=2)
    async def tick(self, tick: Tick) -> None:
        try:
            self.event("named", text=await self.ask(task_address("a/Counter"), Name(0.01), timeout_s=20.0))
            await self.ask(task_address("a/Counter"), Name(60.0), timeout_s=0.1)
        except RequestError as error:
            self.event("refused", error=type(error).__name__)
"""
ENTRY_POINTS = """
[pancakes.tasks]
asking.Counter = plugin_asking:Counter
asking.Asker = plugin_asking:Asker
asking.Waiter = plugin_asking:Waiter
[pancakes.packets]
asking = plugin_asking
"""
COUNTER = '[task.Counter]\ntype = "asking.Counter"\n'
ASKER = '[task.Asker]\ntype = "asking.Asker"\n\n[task.Waiter]\ntype = "asking.Waiter"\n'


def test_answer_comes_although_one_task_migrates_and_the_agent_of_the_other_is_killed(rig: Rig) -> None:
    rig.install("asking", ENTRY_POINTS, SOURCE)
    a = rig.ready("a", COUNTER)
    peers = f'peers = ["{rig.address(a)}"]'
    b = rig.ready("b", agent=peers)
    a.hear("peer_up peer=b")
    c = rig.ready("c", ASKER, agent=peers)
    c.hear("felt n=3")
    assert rig.pancakes("task", "migrate", "a/Counter", "--to", "b").returncode == 0
    c.hear("named text=b")
    c.hear("refused error=RequestTimeoutError")
    c.signalled(signal.SIGKILL)
    c = rig.ready("c", ASKER, agent=f'peers = ["{rig.address(a)}", "{rig.address(b)}"]')
    c.hear("answered text=counted on b")
