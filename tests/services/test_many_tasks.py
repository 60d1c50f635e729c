"""A service that brings many tasks: they are started a few at a time, and nobody notices."""

from dataclasses import dataclass

from pancakes.control import Command, Stop
from pancakes.events import LogLine
from pancakes.packet import SYSCTRL, Packet
from pancakes.service import Service
from pancakes.supervision.lifecycle import State
from pancakes.supervision.service_core import ServiceCore
from pancakes.supervision.slots import STARTED_AT_ONCE
from pancakes.task import Task, TaskSpec, every
from pancakes.testing import Fleet


class Small(Task):
    """Ticks now and then."""

    @every(hz=1)
    def tick(self, tick):
        pass


class Crowd(Service):
    """Brings a crowd of tasks."""

    @dataclass
    class Settings:
        tasks: int

    def own_tasks(self):
        return [TaskSpec(f"Small{number}", Small) for number in range(self.settings.tasks)]


def a_crowd(fleet, tasks):
    """An agent with a crowd of tasks, not yet started."""
    crowd = {"crowd": {"type": Crowd, "settings": {"tasks": tasks}}}
    return fleet.start("a", services=crowd)


def test_all_of_many_tasks_run_once_the_service_is_ready():
    for tasks in (STARTED_AT_ONCE, 3 * STARTED_AT_ONCE + 1):
        with Fleet() as fleet:
            agent = a_crowd(fleet, tasks)
            assert agent.running("crowd") == [f"Small{number}" for number in range(tasks)]
            service = agent.component("crowd")
            assert not any(slot.life.asker or slot.commands for slot in service.slots.values())


class Impatient(ServiceCore, Crowd):
    """Is asked to stop its last task before that has been started."""

    __module__ = "pancakes"  # its names are Pancakes' own

    def after_start(self):
        super().after_start()
        self.was_running = [slot.task is not None for slot in self.slots.values()]
        command = Command(1, ("a/log", 1), f"Small{self.settings.tasks - 1}", Stop("Small"))
        self.on_command(Packet(SYSCTRL, "command", "a/kernel", self.address, 0.0, 1, command))


def test_what_is_asked_of_a_task_before_its_turn_to_start_waits_for_that():
    with Fleet() as fleet:
        tasks = 2 * STARTED_AT_ONCE
        agent = fleet.start("a", services={"crowd": {"type": Impatient, "settings": {"tasks": tasks}}})
        service = agent.component("crowd")
        assert isinstance(service, Impatient)
        assert service.was_running == [number < STARTED_AT_ONCE for number in range(tasks)]
        fleet.run_for(1.0)
        assert agent.slot(f"Small{tasks - 1}", "crowd").life.state is State.STOPPED
        assert len(agent.running("crowd")) == tasks - 1


class Leaving(ServiceCore, Crowd):
    """Is stopped before all of its tasks have been started."""

    __module__ = "pancakes"  # its names are Pancakes' own

    def after_start(self):
        super().after_start()
        self.call(self.close)


def test_a_service_that_is_stopped_meanwhile_starts_no_more_of_them():
    with Fleet() as fleet:
        agent = fleet.start("a", services={"crowd": {"type": Leaving, "settings": {"tasks": 3 * STARTED_AT_ONCE}}})
        fleet.run_for(2.0)
        assert agent.running("crowd") == []
        assert not [packet for packet in agent.probe.packets(LogLine) if packet.body.level == "error"]
