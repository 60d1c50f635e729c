"""Packets that are addressed to a task reach it in order and once, over bad links, while tasks move and agents die."""

import random

import pytest
from services.numbered import HOSTS, Sink, Source, fails, numbers, sent_by, upto

from pancakes.control import Migrate, Stop
from pancakes.mesh.net.memory import Quality
from pancakes.packet import SYSCTRL
from pancakes.testing import FleetInTest


class Voyage:
    """A sink that moves about between three agents while a fourth sends it numbers."""

    def __init__(self, seed, durability):
        self.random = random.Random(f"voyage/{seed}")
        latency_s = self.random.choice([0.0005, 0.01, 0.08])
        self.fleet = FleetInTest(
            seed,
            classes={"test.Source": Source},
            quality=Quality(latency_s=latency_s, jitter_s=self.random.random() * 0.05),
        )
        for name in HOSTS:
            sink = {"type": Sink, "durability": durability, "restart": {"policy": "permanent", "at_most": 1000}}
            self.fleet.start(name, tasks={"Sink": sink} if name == "a" else {})
        self.sender = self.fleet.start("s", tasks={"Source": Source})
        self.fleet.connect()

    def migrate(self):
        for name in HOSTS:
            agent = self.fleet.agents.get(name)
            if agent is not None and agent.component("client/Sink") is not None:
                agent.publish(SYSCTRL, Migrate("client/Sink", to=self.random.choice(HOSTS)))

    def fail(self):
        for name in HOSTS:
            agent = self.fleet.agents.get(name)
            task = agent.component("client/Sink") if agent is not None else None
            if task is not None:
                task.call(fails)

    def break_link(self):
        one, other = self.random.sample([*HOSTS, "s"], 2)
        self.fleet.network.break_links(one, other, at_once=self.random.random() < 0.5)

    def part(self):
        until_s = self.fleet.now() + self.random.uniform(0.1, 6.0)
        self.fleet.network.partition([self.random.choice([*HOSTS, "s"])], until_s=until_s)

    def kill(self):
        here = [name for name in HOSTS if name in self.fleet.agents]
        if here:
            self.fleet.crash(self.random.choice(here))

    def revive(self):
        for name in HOSTS:
            if name not in self.fleet.agents:
                self.fleet.restart(name, settle=False)

    def sail(self, troubles):
        for _ in range(6):
            self.migrate()
            self.fleet.run_for(self.random.uniform(0.0, 1.2))
            self.random.choice(troubles)()
            self.fleet.run_for(self.random.uniform(0.0, 1.5))
            self.revive()
            self.fleet.run_for(self.random.uniform(0.0, 1.0))

    def arrive(self):
        """Ends all trouble, and waits until everything has come."""
        self.fleet.network.heal()
        self.revive()
        self.fleet.run_for(25.0)
        self.sender.ask(Stop("client/Source"))
        sent = sent_by(self.sender)
        self.fleet.run_for(15.0)
        assert self.sender.agent.outbox.waiting() == {}
        return sent, numbers(self.fleet)


class Nomads(Voyage):
    """The same, and the source moves about too."""

    def __init__(self, seed, durability):
        super().__init__(seed, durability)
        assert self.sender.ask(Migrate("Source", to=self.random.choice(HOSTS))).ok

    def migrate(self):
        super().migrate()
        for agent in self.fleet.agents.values():
            if agent.component("client/Source") is not None:
                agent.publish(SYSCTRL, Migrate("client/Source"))

    def arrive(self):
        self.fleet.network.heal()
        self.fleet.run_for(25.0)
        (host,) = [agent for agent in self.fleet.agents.values() if "Source" in agent.running()]
        assert host.ask(Stop("client/Source")).ok
        sent = sent_by(host)
        self.fleet.run_for(15.0)
        assert [agent.agent.outbox.waiting() for agent in self.fleet.agents.values()] == [{}] * 4
        fence = host.slot("Source").fence
        assert fence is not None
        return sent, numbers(self.fleet), fence.epoch[0]


@pytest.mark.parametrize("durability", ["lazy", "each"])
@pytest.mark.parametrize("seed", range(6))
def test_what_a_task_sends_from_its_new_host_comes_after_what_it_sent_from_the_old_one(seed, durability):
    nomads = Nomads(4000 + seed, durability)
    nomads.sail([nomads.break_link, nomads.part, nomads.migrate, nomads.fail])
    sent, got, moves = nomads.arrive()
    assert moves > 2 and sent > 500 and got == upto(sent)
    nomads.fleet.close()


@pytest.mark.parametrize("durability", ["lazy", "each"])
@pytest.mark.parametrize("seed", range(15))
def test_each_number_has_its_effect_once_and_in_order_over_bad_links(seed, durability):
    voyage = Voyage(seed, durability)
    voyage.sail([voyage.break_link, voyage.part, voyage.migrate])
    sent, got = voyage.arrive()
    assert sent > 500 and got == upto(sent)
    voyage.fleet.close()


@pytest.mark.parametrize("durability", ["lazy", "each"])
@pytest.mark.parametrize("seed", range(8))
def test_so_it_has_while_the_task_fails_again_and_again(seed, durability):
    voyage = Voyage(3000 + seed, durability)
    voyage.sail([voyage.fail, voyage.fail, voyage.fail, voyage.break_link, voyage.part])
    sent, got = voyage.arrive()
    assert sent > 500 and got == upto(sent)
    voyage.fleet.close()


@pytest.mark.parametrize("seed", range(24))
def test_so_it_has_while_agents_are_killed_where_durability_is_each(seed):
    voyage = Voyage(1000 + seed, "each")
    voyage.sail([voyage.kill, voyage.kill, voyage.break_link, voyage.part])
    sent, got = voyage.arrive()
    assert sent > 500 and got == upto(sent)
    voyage.fleet.close()


@pytest.mark.parametrize("seed", range(24))
def test_a_lazy_task_loses_what_it_had_not_written_when_it_was_killed_and_doubles_nothing(seed):
    voyage = Voyage(2000 + seed, "lazy")
    voyage.sail([voyage.kill, voyage.kill, voyage.break_link, voyage.part])
    sent, got = voyage.arrive()
    assert got == sorted(set(got)) and got[-1] == sent
    voyage.fleet.close()
