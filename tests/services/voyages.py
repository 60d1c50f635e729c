"""A task that is sent numbers while it moves, fails, and loses its links and its agents."""

import random

from services.numbered import HOSTS, Sink, Source, fails, numbers, sent_by, upto

from pancakes.control import Migrate, Stop
from pancakes.mesh.memory_network import Quality
from pancakes.packet import SYSCTRL
from pancakes.testing import Fleet


class Voyage:
    """A sink that moves about between three agents while a fourth sends it numbers.

    Args:
        seed: draws the links and the troubles.
        durability: of the sink.
        source: the class of the task that sends the numbers.
    """

    def __init__(self, seed, durability, source=Source):
        self.random = random.Random(f"voyage/{seed}")
        latency_s = self.random.choice([0.0005, 0.01, 0.08])
        self.fleet = Fleet(
            seed,
            classes={f"test.{source.__name__}": source},
            quality=Quality(latency_s=latency_s, jitter_s=self.random.random() * 0.05),
        )
        for name in HOSTS:
            sink = {"type": Sink, "durability": durability, "restart": {"policy": "always", "at_most": 1000}}
            self.fleet.start(name, tasks={"Sink": sink} if name == "a" else {})
        self.sender = self.fleet.start("s", tasks={"Source": source})
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

    def __init__(self, seed, durability, source=Source):
        super().__init__(seed, durability, source)
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


def least(source):
    """Returns how many numbers a source sends at least in a voyage; fewer, and it shows little."""
    return 500 if source is Source else 200


def moves_of_the_source(seed, durability, source=Source):
    """Check that what a task sends from its new host comes after what it sent from the old one."""
    nomads = Nomads(4000 + seed, durability, source)
    nomads.sail([nomads.break_link, nomads.part, nomads.migrate, nomads.fail])
    sent, got, moves = nomads.arrive()
    assert moves > 2 and sent > least(source) and got == upto(sent)
    nomads.fleet.close()


def _all_arrive(voyage, troubles, source):
    voyage.sail(troubles)
    sent, got = voyage.arrive()
    assert sent > least(source) and got == upto(sent)
    voyage.fleet.close()


def bad_links(seed, durability, source=Source):
    """Check that each number has its effect once and in order over links that break and networks that part."""
    voyage = Voyage(seed, durability, source)
    _all_arrive(voyage, [voyage.break_link, voyage.part, voyage.migrate], source)


def failures_of_the_task(seed, durability, source=Source):
    """The same while the receiving task fails again and again."""
    voyage = Voyage(3000 + seed, durability, source)
    _all_arrive(voyage, [voyage.fail, voyage.fail, voyage.fail, voyage.break_link, voyage.part], source)


def killed_agents(seed, source=Source):
    """The same while agents are killed: with the durability `each`, nothing is lost."""
    voyage = Voyage(1000 + seed, "each", source)
    _all_arrive(voyage, [voyage.kill, voyage.kill, voyage.break_link, voyage.part], source)


def killed_agents_of_a_lazy_task(seed, source=Source):
    """Check that a lazy task may lose what it had not written when it was killed, but doubles nothing."""
    voyage = Voyage(2000 + seed, "lazy", source)
    voyage.sail([voyage.kill, voyage.kill, voyage.break_link, voyage.part])
    sent, got = voyage.arrive()
    assert got == sorted(set(got)) and got[-1] == sent
    voyage.fleet.close()
