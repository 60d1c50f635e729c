"""Tasks that cross on their way, over links that are slow and break, between agents that are killed.

After each single step of the fleet a storm counts how many copies of a task run. There may never be two; and when
the network has healed and all agents are back, there is one.
"""

import random
from dataclasses import dataclass

from pancakes.control import Migrate, Restart, Start, Stop
from pancakes.mesh.memory_network import Quality
from pancakes.packet import SYSCTRL
from pancakes.task import Task, every
from pancakes.testing import Fleet

ROBOTS = ("a", "b", "c")


class Wanderer(Task):
    """Counts, so that one can see what it has forgotten; naps now and then, also on its way."""

    @dataclass
    class State:
        n: int = 0

    @every(hz=20)
    def tick(self, tick):
        self.state.n += 1
        if self.state.n % 7 == 0:
            self.pause()
            self.after(0.2, self.wake)

    def wake(self):
        self.state.n += 1
        self.resume()


class Storm:
    """A fleet of three, a task born on each of two, and a check after each step."""

    def __init__(self, seed):
        self.random = random.Random(f"storm/{seed}")
        self.fleet = Fleet(
            seed,
            quality=Quality(latency_s=self.random.choice([0.0005, 0.01, 0.08]), jitter_s=self.random.random() * 0.05),
        )
        self.tasks = {"One": "a", "Two": "b"}
        for name in ROBOTS:
            mine = {task: Wanderer for task, home in self.tasks.items() if home == name}
            self.fleet.start(name, tasks=mine)
        self.fleet.connect()
        self.highest = dict.fromkeys(self.tasks, 0)

    def hosts(self, task):
        running = []
        for agent in self.fleet.agents.values():
            component = agent.component(f"client/{task}")
            if component is not None and not component.is_frozen:
                running.append(agent.name)
        return running

    def run_for(self, duration_s):
        """Runs, and looks after each step."""
        dispatcher = self.fleet.dispatcher
        until_s = self.fleet.now() + duration_s
        dispatcher.call_at(until_s, lambda: None)
        while self.fleet.now() < until_s:
            dispatcher.step()
            dispatcher.settle()
            for task in self.tasks:
                hosts = self.hosts(task)
                assert len(hosts) <= 1, f"{task} runs on {' and on '.join(hosts)} at {self.fleet.now():.3f} s"

    def somebody(self):
        return self.random.choice(list(self.fleet.agents.values()))

    def migrate_all(self):
        for task in self.tasks:
            for host in self.hosts(task):
                self.fleet.agents[host].publish(SYSCTRL, Migrate(f"client/{task}"))

    def break_link(self):
        one, other = self.random.sample(ROBOTS, 2)
        self.fleet.network.break_links(one, other, at_once=self.random.random() < 0.5)

    def part(self):
        self.fleet.network.partition(
            [self.random.choice(ROBOTS)], until_s=self.fleet.now() + self.random.uniform(0.1, 6.0)
        )

    def kill(self):
        if self.fleet.agents:
            self.fleet.crash(self.random.choice(list(self.fleet.agents)))

    def revive(self):
        for name in ROBOTS:
            if name not in self.fleet.agents:
                self.fleet.restart(name, settle=False)

    def command(self):
        for task in self.tasks:
            for host in self.hosts(task):
                self.fleet.agents[host].publish(SYSCTRL, Restart(f"client/{task}"))

    def calm(self):
        """Ends all trouble, and waits until everything is in order."""
        self.fleet.network.heal()
        self.revive()
        self.run_for(40.0)


def change_places_over_bad_links(seed):
    """Check that two tasks that move over bad links each run once in the end."""
    storm = Storm(seed)
    for _ in range(6):
        storm.migrate_all()
        storm.run_for(storm.random.uniform(0.0, 1.5))
        storm.random.choice([storm.break_link, storm.part, storm.migrate_all])()
        storm.run_for(storm.random.uniform(0.0, 2.0))
    storm.calm()
    assert [len(storm.hosts(task)) for task in storm.tasks] == [1, 1]
    storm.fleet.close()


def change_places_while_agents_are_killed(seed):
    """The same while agents are killed; the tasks also run through most of the calm."""
    storm = Storm(1000 + seed)
    troubles = [storm.kill, storm.kill, storm.break_link, storm.part, storm.command, storm.revive]
    for _ in range(6):
        storm.migrate_all()
        storm.run_for(storm.random.uniform(0.0, 0.8))
        storm.random.choice(troubles)()
        storm.run_for(storm.random.uniform(0.0, 1.0))
        storm.revive()
        storm.run_for(storm.random.uniform(0.0, 1.0))
    storm.calm()
    assert [len(storm.hosts(task)) for task in storm.tasks] == [1, 1]
    for task in storm.tasks:
        (host,) = storm.hosts(task)
        assert storm.fleet.agents[host].task(task).state.n > 20 * 20  # it has run through most of the calm
    storm.fleet.close()


def stop_while_they_move(seed):
    """Check that a stop holds over moves and a restart if it was answered with yes, and that a start ends it."""
    storm = Storm(2000 + seed)
    storm.migrate_all()
    storm.run_for(storm.random.uniform(0.0, 1.0))
    stopped = []
    for task in storm.tasks:
        for host in storm.hosts(task):
            asked = storm.fleet.agents[host].publish(SYSCTRL, Stop(f"client/{task}"))
            stopped.append((storm.fleet.agents[host], task, asked))
    storm.run_for(3.0)
    for agent, task, asked in stopped:
        if agent.reply_to(asked).ok:
            storm.calm()
            assert storm.hosts(task) == []
            name = agent.name
            storm.fleet.crash(name)
            storm.revive()
            storm.run_for(5.0)
            assert storm.hosts(task) == []
            assert storm.fleet.agents[name].ask(Start(f"client/{task}")).ok
            storm.run_for(0.1)
            assert storm.hosts(task) == [name]
        else:
            storm.calm()
            assert len(storm.hosts(task)) == 1
    storm.fleet.close()
