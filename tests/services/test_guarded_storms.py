"""Guarded tasks in drawn storms: whatever crashes, stops, moves or is cut off, never do two act; at the end one does.

Of any two acts of a task the later one is under the epoch that is not lower: so what the environment sees is one task.
"""

import random
from dataclasses import dataclass

import pytest

from pancakes.control import Migrate
from pancakes.mesh.migration.record import TaskId
from pancakes.runtime.kernel.permits import PermitEnd
from pancakes.runtime.supervision.guardian_messages import GUARDIAN
from pancakes.task import Task, every
from pancakes.testing import FleetInTest

ACT = TaskId("a", "Act")
SEEDS = 150
acts: list[tuple[float, str, tuple[int, str]]] = []


class Act(Task):
    """Notes when it acts, where, and under which epoch."""

    @dataclass
    class State:
        n: int = 0

    @every(hz=20)
    def tick(self, tick):
        self.state.n += 1
        assert self.fence is not None
        acts.append((self.kernel.host.now(), self.agent, self.fence.epoch))


class Storm:
    """One storm: so many mishaps, drawn from a seed."""

    def __init__(self, seed):
        self.random = random.Random(seed)
        self.names = "abcde"[: self.random.choice([3, 4, 5])]
        self.fleet = FleetInTest(seed=seed, classes={"test.Act": Act})
        self.down = []

    def run(self):
        with self.fleet as fleet:
            guarded = {"type": Act, "guard": 3, "lease_s": 3.0, "checkpoint_s": 0.5}
            fleet.start("a", tasks={"Act": guarded})
            for name in self.names[1:]:
                fleet.start(name)
            fleet.connect()
            fleet.run_for(self.random.uniform(0.5, 4.0))
            mishaps = (self.crash, self.stop, self.restart, self.cut, self.calm, self.move, self.links, self.disk)
            for _ in range(self.random.randint(3, 12)):
                self.random.choice(mishaps)(self.random.choice(self.names))
                fleet.run_for(self.random.expovariate(0.7))
            fleet.faults.calm()
            for name in self.down:
                fleet.restart(name)
            fleet.run_for(25.0)
            return fleet.now()

    def crash(self, name):
        if name in self.fleet.agents and len(self.fleet.agents) > 2:
            self.fleet.crash(name)
            self.down.append(name)

    def stop(self, name):
        if name in self.fleet.agents and len(self.fleet.agents) > 2:
            self.fleet.stop(name)
            self.down.append(name)

    def restart(self, name):
        if self.down:
            self.fleet.restart(self.down.pop(self.random.randrange(len(self.down))))

    def cut(self, name):
        self.fleet.faults.cut(name, for_s=self.random.uniform(0.5, 8.0))

    def calm(self, name):
        self.fleet.faults.calm()

    def move(self, name):
        for agent in self.fleet.agents.values():
            if "Act" in agent.running():
                agent.publish("sysctrl", Migrate("Act"))

    def links(self, name):
        self.fleet.faults.break_links(3, 1.0)

    def disk(self, name):
        if name in self.fleet.agents and self.random.random() < 0.5:
            self.fleet.faults.fill_disk(name)
        elif name in self.fleet.agents:
            self.fleet.faults.slow_disk(name, self.random.uniform(0.0, 0.5))


@pytest.mark.parametrize("first", range(0, SEEDS, 15))
def test_never_do_two_act_and_at_the_end_one_does(first):
    for seed in range(first, first + 15):
        acts.clear()
        ended_s = Storm(seed).run()
        epochs = [epoch for _, _, epoch in acts]
        assert epochs == sorted(epochs), f"seed {seed}: two agents act"
        assert len({agent for at_s, agent, _ in acts if at_s > ended_s - 2.0}) == 1, (
            f"seed {seed}: none acts at the end"
        )


def set_rate(agent, rate):
    """Lets the clocks of an agent run at so many times the true rate."""
    kernel = agent.kernel
    kernel.permits.moment = lambda: PermitEnd(kernel.host.now() * rate, 0.0)
    guardian = agent.component(GUARDIAN)
    after_host = guardian.after_host
    guardian.after_host = lambda delay_s, function: after_host(delay_s / rate, function)


@pytest.mark.parametrize(("apart", "holds"), [(0.01, True), (0.05, True), (0.1, False)])
def test_clocks_may_differ_by_five_percent_and_by_no_more_than_a_lease_is_longer_than_a_permit(apart, holds):
    acts.clear()
    with FleetInTest(seed=7, classes={"test.Act": Act}) as fleet:
        fleet.start("a", tasks={"Act": {"type": Act, "guard": 3, "lease_s": 10.0}})
        fleet.start("b")
        fleet.start("c")
        fleet.connect()
        set_rate(fleet.agents["a"], 1.0 - apart)
        set_rate(fleet.agents["b"], 1.0 + apart)
        set_rate(fleet.agents["c"], 1.0 + apart)
        fleet.run_for(9.5)  # the guardians have just answered
        record = fleet.agents["a"].agent.records.get(ACT)
        assert record is not None and record.guards.version == 2
        fleet.faults.cut("a", for_s=14.0)
        fleet.run_for(30.0)
        epochs = [epoch for _, _, epoch in acts]
        assert epochs[-1][0] == 1
        assert (epochs == sorted(epochs)) is holds
