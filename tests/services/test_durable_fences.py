"""An old copy of a task moves no wheel, whoever was started again meanwhile; and without commands wheels stand."""

import pytest

from pancakes.control import Migrate, Restart, Stop
from pancakes.devices import Twist
from pancakes.devices.driver import Actuator
from pancakes.journal import Disk, JournalEntry, MemoryJournal, VirtualStore
from pancakes.mesh.memory_network import Quality
from pancakes.packet import Fence, Packet
from pancakes.services.fence import Fences
from pancakes.services.fence_rule import Mark
from pancakes.sim.world_state import WorldState
from pancakes.simulation.fleet import DISK_FULL
from pancakes.task import Task, every
from pancakes.testing import Fleet


class Wheels(Actuator):
    """Writes down what it is told."""

    type = "motors"
    told: list = []

    def write(self, command, ttl_s, source):
        self.told.append((self.context.agent, command.v_mps))

    def safe_stop(self):
        pass


class Circle(Task):
    requires = ("motors",)

    @every(hz=10)
    def drive(self, tick):
        self.publish("ctrl", Twist(0.1, 0.0))


class Still(Task):
    requires = ("motors",)


CLASSES = {"test.Circle": Circle, "test.Still": Still}
ZOMBIE_MPS = 9.0


@pytest.fixture
def fleet():
    Wheels.told = []
    with Fleet(3, classes=CLASSES) as made:
        yield made


def command(epoch, source="a/client/Still", task_id="b/Still", v_mps=0.5):
    return Packet("ctrl", "motors", source, "", 0.0, 1, Twist(v_mps, 0.0), fence=Fence(task_id, epoch))


def give(fleet, agent, *packets, for_s=0.05):
    for packet in packets:
        agent.kernel.stream.publish(packet)
    fleet.run_for(for_s)


def test_the_mark_outlives_the_agent(fleet):
    a = fleet.start("a", devices={"wheels": Wheels}, tasks={"Still": Still})
    give(fleet, a, command((2, "b")))
    fleet.crash("a")
    a = fleet.restart("a")
    give(fleet, a, command((1, "c"), v_mps=ZOMBIE_MPS))
    assert Wheels.told == [("a", 0.5)]
    assert a.events("command_refused")[0]["reason"] == "epoch 1 of b/Still has passed, 2 has been seen"
    give(fleet, a, command((2, "b"), v_mps=0.6), command((3, "a"), v_mps=0.7))
    assert Wheels.told == [("a", 0.5), ("a", 0.6), ("a", 0.7)]


def test_the_mark_outlives_the_device_service(fleet):
    a = fleet.start("a", devices={"wheels": Wheels}, tasks={"Still": Still})
    give(fleet, a, command((2, "b")))
    assert a.ask(Restart("device")).ok
    fleet.run_for(1.0)
    give(fleet, a, command((1, "c"), v_mps=ZOMBIE_MPS))
    assert Wheels.told == [("a", 0.5)]


def test_no_command_of_a_new_epoch_is_obeyed_before_the_mark_is_on_disk(fleet):
    a = fleet.start("a", devices={"wheels": Wheels}, tasks={"Still": Still})
    give(fleet, a, command((2, "b"), v_mps=0.1), command((2, "b"), v_mps=0.2), for_s=0.001)
    assert Wheels.told == []
    # Had it been obeyed, a crash now would let an older epoch in.
    assert not any("fence" in name for name in fleet.disk("a"))
    fleet.run_for(0.01)
    # The newest has waited; what it replaced is stale.
    assert Wheels.told == [("a", 0.2)]
    fleet.crash("a")
    assert any("fence" in name for name in fleet.disk("a"))


def test_a_later_epoch_that_comes_while_an_earlier_one_is_written_is_on_disk_before_its_command_is_obeyed(fleet):
    a = fleet.start("a", devices={"wheels": Wheels}, tasks={"Still": Still})
    fleet.faults.slow_disk("a", 0.1)
    give(fleet, a, command((2, "b"), v_mps=0.1), command((3, "b"), v_mps=0.2), for_s=0.6)
    assert Wheels.told == [("a", 0.2)] and a.events("task_failed") == []
    fleet.crash("a")
    a = fleet.restart("a")
    give(fleet, a, command((2, "b"), v_mps=ZOMBIE_MPS), for_s=0.6)
    assert Wheels.told == [("a", 0.2)]


def test_each_epoch_is_written_once(fleet):
    a = fleet.start("a", devices={"wheels": Wheels}, tasks={"Circle": Circle})
    fleet.run_for(1.0)
    fleet.faults.fill_disk("a")
    fleet.run_for(9.0)
    assert a.events("command_refused") == []
    assert len(Wheels.told) >= 99


def test_a_mark_that_cannot_be_written_lets_nothing_through_and_is_tried_again(fleet):
    a = fleet.start("a", devices={"wheels": Wheels}, tasks={"Still": Still})
    end = fleet.faults.fill_disk("a")
    give(fleet, a, command((2, "b")))
    assert Wheels.told == []
    assert a.events("command_refused")[0]["reason"] == f"its epoch is not on disk: {DISK_FULL}"
    end()
    fleet.run_for(1.0)  # an entry that could not be written is left alone for a while
    give(fleet, a, command((2, "b")))
    assert Wheels.told == [("a", 0.5)]


def test_a_command_that_waited_for_a_slow_disk_too_long_is_stale(fleet):
    a = fleet.start("a", devices={"wheels": Wheels}, tasks={"Still": Still})
    fleet.faults.slow_disk("a", 0.6)
    give(fleet, a, command((2, "b")), for_s=1.0)
    assert Wheels.told == []
    give(fleet, a, command((2, "b")))
    assert Wheels.told == [("a", 0.5)]


def test_an_actuator_remembers_each_task_that_it_has_seen():
    disk: dict[str, bytes] = {}
    journal = MemoryJournal(disk, "x")
    store = VirtualStore(journal, lambda delay_s, function: function())
    fences = Fences(Disk(journal, store, []))
    first, second = Fence("b/X", (2, "b")), Fence("b/Y", (1, "b"))
    for fence in (first, second):
        fences.write("wheels", fence.task_id, Mark(*fence.epoch, "a"), lambda: None, pytest.fail)
    store.close()
    journal = MemoryJournal(disk, "x")
    fences = Fences(Disk(journal, VirtualStore(journal, lambda delay_s, function: None), []))
    assert fences.obeys("wheels", first) and fences.obeys("wheels", second)
    assert not fences.obeys("arm", first)


def test_a_damaged_fence_is_told_by_name():
    disk: dict[str, bytes] = {}
    journal = MemoryJournal(disk, "x")
    journal.write(
        [JournalEntry("fence", "wheels", b"\xc1"), JournalEntry("fence", "arm", b"\x81\xa3b/X\x93\x02\xa1b\xa1b")]
    )
    unread: list[str] = []
    fences = Fences(Disk(journal, VirtualStore(journal, lambda delay_s, function: function()), unread))
    assert fences.highest("arm", "b/X") == Mark(2, "b", "b")
    assert fences.highest("wheels", "b/X") is None
    (sentence,) = unread
    assert sentence.startswith("the journal's fence of the actuator wheels is not used: ")


def test_a_source_that_wakes_up_after_a_long_stop_moves_no_wheel(fleet):
    """It never saw that its task was given away, and has come to run elsewhere and home again."""
    a = fleet.start("a", devices={"wheels": Wheels}, tasks={"Circle": Circle})
    b = fleet.start("b", devices={"wheels": Wheels})
    fleet.connect()
    fleet.run_for(0.5)
    sleeper = a.component("client/Circle")  # the old copy, with the right that it had
    assert a.ask(Migrate("Circle")).ok
    fleet.run_for(1.0)

    def wakes_up(agent):
        before = list(Wheels.told)
        packet = command(tuple(sleeper.fence.epoch), "a/client/Circle", sleeper.fence.task_id, ZOMBIE_MPS)
        give(fleet, agent, packet, for_s=0.0)
        assert all(v_mps != ZOMBIE_MPS for _, v_mps in Wheels.told[len(before) :])

    # While it runs on `b`, nobody at home has the right to the wheels.
    wakes_up(a)
    assert b.ask(Migrate("Circle")).ok
    fleet.run_for(1.0)
    # At home again, under the same address: only the epoch tells them apart.
    assert a.kernel.registry.holder("wheels") == "a/client/Circle"
    wakes_up(a)
    fleet.crash("a")
    a = fleet.restart("a")
    assert a.kernel.registry.holder("wheels") == "a/client/Circle"
    wakes_up(a)
    assert "has passed, 2 has been seen" in a.events("command_refused", by="a/client/Circle")[0]["reason"]
    fleet.run_for(0.5)
    assert Wheels.told[-1] == ("a", 0.1)


def test_a_source_that_wakes_up_late_moves_no_wheel_of_another_agent(fleet):
    """What a virtual actuator sends bears the right of the task that commands it, so that the far one can tell."""
    far = fleet.start("far", devices={"wheels": Wheels})
    remote = {"type": "network.motors", "settings": {"target": "far/device/wheels"}}
    a = fleet.start("a", devices={"wheels": remote}, tasks={"Circle": Circle})
    b = fleet.start("b", devices={"wheels": remote})
    fleet.connect()
    fleet.run_for(0.5)
    last = a.probe.packets(Twist, channel="ctrl", source="a/client/Circle")[-1]
    assert Wheels.told[-1] == ("far", 0.1) and far.kernel.registry.holder("wheels") == "a/device/wheels"
    assert a.ask(Migrate("Circle", to="b")).ok
    fleet.run_for(0.5)
    assert far.kernel.registry.holder("wheels") == "b/device/wheels"
    # Its last command was under way all the time, and comes when nobody holds the wheels.
    assert b.ask(Stop("Circle")).ok
    fleet.run_for(1.0)
    assert far.kernel.registry.holder("wheels") == ""
    before = list(Wheels.told)
    late = a.component("device/wheels")
    a.kernel.registry.hold("a/client/Circle", ("motors",))  # its own agent does not know better
    late.call(lambda: late.command(last))
    fleet.run_for(0.2)
    assert Wheels.told == before
    (refused,) = far.events("command_refused", by="a/device/wheels")
    assert refused["reason"] == "epoch 0 of a/Circle has passed, 1 has been seen"
    # And it did not even get hold of them.
    assert far.kernel.registry.holder("wheels") == ""


WORLD = """
[task.World]
type = "sim.world"
[task.World.settings]
bus = "tcp://world:7410"
robots = { a = { x_m = 0.0, y_m = 0.0, spread_m = 0.0, spread_rad = 0.0 } }
"""


def test_a_robot_whose_agent_is_killed_stands_within_half_a_second(fleet):
    """Nobody is left to say so: the command's time to live has travelled to the world's wheels."""
    world = fleet.start("world", WORLD, role="environment")
    drive = {"type": "sim.differential_drive", "settings": {"world": "tcp://world:7410"}, "hold_after_mission_s": 0.5}
    fleet.start("a", devices={"wheels": drive}, tasks={"Circle": Circle})
    fleet.network.set_quality("a", "world", Quality(latency_s=0.001))

    def robot():
        return world.probe.packets(WorldState)[-1].body.bodies[0]

    fleet.run_for(3.0)
    assert robot().driven_by == "Circle"
    assert robot().v_mps == pytest.approx(0.1, rel=0.1)
    fleet.crash("a")
    fleet.run_for(0.3)
    assert robot().driven_by == "Circle", "a command is good for its time"
    fleet.run_for(0.3)
    resting = robot()
    assert (resting.driven_by, resting.v_mps) == ("", pytest.approx(0.0, abs=1e-6))
    fleet.run_for(3.0)
    assert robot().x_m == pytest.approx(resting.x_m, abs=1e-6)
