"""What a guarded task promises besides: actuators, acknowledgements, guardians that follow an agent that never came."""

from services.counting import Count
from services.numbered import SINK, Numbered, Sink, numbers, upto
from services.strangers import identity, say

from pancakes.control import Describe, Guarding, Migrate, Reply, Stop
from pancakes.devices.driver import Actuator
from pancakes.durable.messages import Accept, Prepare
from pancakes.durable.record import TaskId
from pancakes.durable.register import Epoch, Standing
from pancakes.mesh.memory_network import Quality
from pancakes.task import every
from pancakes.testing import Fleet

GUARD = {"copies": 3, "lease_s": 2.0, "guardians": ["b", "c"]}


class Wheels(Actuator):
    """Wheels that know how often they were brought to their safe hold."""

    type = "motors"
    held = 0

    def write(self, command, ttl_s, source):
        pass

    def safe_stop(self):
        type(self).held += 1


class Drive(Count):
    """Needs the wheels."""

    requires = ("motors",)


class Late(Count):
    """Its permit ends once between the beginning of a turn and what it publishes."""

    in_time = False

    def publishes(self):
        if not Late.in_time:
            Late.in_time = True
            assert self._actor.fence is not None
            self._actor.kernel.permits.revoke(self._actor.fence)
        self.publish("system", Numbered(1))

    @every(hz=2)
    def say(self, tick):
        self.publishes()


def guarded(name, cls, takeover="auto", **others):
    fleet = Fleet(seed=5)
    devices = {"motors": Wheels} if cls is Drive else None
    fleet.start("a", tasks={name: {"type": cls, "guard": {**GUARD, "takeover": takeover}, **others}}, devices=devices)
    for other in "bcd":
        fleet.start(other)
    fleet.connect()
    assert fleet.run_until(lambda: len(record(fleet, name).register.sets) == 1 and record(fleet, name).guarded, 10)
    fleet.run_for(1.0)
    return fleet


def record(fleet, name, agent="a"):
    return fleet.agents[agent].agent.records.get(TaskId("a", name))


def members(fleet, agent):
    return {one.agent for one in record(fleet, "Count", agent).members}


def test_its_actuators_are_held_when_the_permit_is_over():
    with guarded("Drive", Drive) as fleet:
        Wheels.held = 0
        fleet.faults.cut("a")
        assert fleet.run_until(lambda: fleet.agents["a"].events("permit_lost"), 3.0)
        fleet.run_for(0.1)
        assert Wheels.held == 1


def test_nothing_is_acknowledged_that_a_quorum_does_not_have():
    with guarded("Sink", Sink, durability="each") as fleet:
        fleet.faults.cut("a", off=("b", "c"))
        for n in upto(5):
            fleet.agents["d"].publish("system", Numbered(n), to=SINK)
        fleet.run_for(1.0)
        assert fleet.agents["a"].task("Sink").state.numbers == upto(5)
        assert fleet.agents["d"].agent.outbox.waiting() == {"a/Sink": 5}
        fleet.crash("a")
        fleet.run_for(20.0)
        assert numbers(fleet) == upto(5)
        assert not fleet.agents["d"].agent.outbox.waiting()


def test_a_state_that_did_not_change_is_not_sent_again():
    with guarded("Sink", Sink) as fleet:
        keeps = []
        fleet.agents["b"].kernel.stream.tap("network", lambda packet: keeps.append(packet.body), ("task.accept",))
        fleet.run_for(5.0)
        assert len(keeps) >= 8 and all(isinstance(keep, Accept) and keep.state is None for keep in keeps)
        fleet.agents["d"].publish("system", Numbered(1), to=SINK)
        fleet.run_for(5.0)
        assert sum(keep.state is not None for keep in keeps) == 1


def test_a_state_that_is_on_its_way_to_a_guardian_is_not_sent_again():
    with guarded("Sink", Sink) as fleet:
        keeps = []
        fleet.agents["b"].kernel.stream.tap("network", lambda packet: keeps.append(packet.body), ("task.accept",))
        fleet.network.set_quality("a", "b", Quality(latency_s=0.35))  # there and back: longer than from lease to lease
        fleet.agents["d"].publish("system", Numbered(1), to=SINK)
        fleet.run_for(5.0)
        assert sum(keep.state is not None for keep in keeps) == 1


def test_its_guardians_are_chosen_as_soon_as_its_neighbours_have_had_time_to_answer():
    with Fleet(seed=5) as fleet:
        for other in "bcd":
            fleet.start(other)
        fleet.start("a", tasks={"Count": {"type": Count, "guard": GUARD}})
        fleet.connect()
        begin_s = fleet.now()
        assert fleet.run_until(lambda: len(record(fleet, "Count").members) == 3, 10)
        assert fleet.now() - begin_s < 1.5


def test_a_stop_is_answered_once_a_quorum_keeps_to_it():
    with guarded("Count", Count) as fleet:
        a = fleet.agents["a"]
        for other in "bc":
            fleet.faults.delay("a", other, 0.3)
        asked = a.publish("sysctrl", Stop("Count"))
        fleet.run_for(0.5)
        assert a.running() == [] and a.probe.packets(Reply) == []
        assert a.reply_to(asked).ok
        fleet.crash("a")
        fleet.run_for(20.0)
        assert running(fleet, "Count") == []


def test_a_stop_that_no_guardian_hears_of_is_said_to_hold_here_alone():
    with guarded("Count", Count) as fleet:
        a = fleet.agents["a"]
        fleet.faults.cut("a")
        asked_s = fleet.now()
        stopped = a.ask(Stop("Count"))
        assert not stopped.ok and a.running() == []
        assert 4.0 <= fleet.now() - asked_s < 4.5
        assert "a/Count is stopped on a, but too few of its guardians (b, c) have confirmed that" in stopped.reason


def test_a_turn_that_outlasts_its_permit_is_no_failure_of_the_task():
    Late.in_time = True
    with guarded("Late", Late, restart={"policy": "no"}) as fleet:
        Late.in_time = False
        fleet.run_for(5.0)
        described = fleet.agents["a"].ask(Describe("Late")).result
        assert Late.in_time and (described["state"], described["failures"]) == ("running", 0)


def test_a_member_that_was_promised_the_task_and_is_gone_keeps_it_from_nobody():
    with guarded("Count", Count, takeover="ask") as fleet:
        a, before = fleet.agents["a"], record(fleet, "Count")
        fleet.faults.cut("a")
        fleet.run_for(4.0)
        register, c = before.register, identity(fleet, "c")
        say(fleet, "c", Prepare(before.task_id, before.type, Epoch(1, c), register.stamp, register.sets), "b")
        fleet.run_for(0.5)
        assert record(fleet, "Count", "b").register.promised == Epoch(1, c)
        fleet.crash("c")
        fleet.faults.calm()
        fleet.run_for(12.0)
        assert a.running() == ["Count"] and running(fleet, "Count") == ["a"]
        assert record(fleet, "Count").standing is Standing.OWNER and record(fleet, "Count").epoch.n > 1


def test_a_former_owner_that_returns_keeps_its_guardians_from_no_take_over_where_the_later_owner_is_gone_too():
    with guarded("Count", Count) as fleet:
        fleet.crash("a")
        assert fleet.run_until(lambda: running(fleet, "Count"), 10)
        (later,) = running(fleet, "Count")
        fleet.crash(later)
        if later == "d":
            fleet.crash("b")
        fleet.restart("a")
        assert fleet.run_until(lambda: running(fleet, "Count"), 30), "a still has its own lease"


def running(fleet, name):
    """The agents on which a task acts."""
    return [
        agent
        for agent, one in fleet.agents.items()
        if name in one.running() and one.agent.kernel.permits.may_act(one.component(f"client/{name}").fence)
    ]


def test_a_permit_that_is_over_by_the_clock_lets_nothing_out_although_no_timer_has_come():
    with guarded("Count", Count) as fleet:
        a = fleet.agents["a"]
        fleet.faults.cut("a")
        # As after a suspend: no timer has run meanwhile, but the clock of the permit has gone on.
        permits, moment = a.kernel.permits, a.kernel.permits.moment
        assert permits.left_s(a.component("client/Count").fence) > 1.0
        permits.moment = lambda: moment().later(2.0)
        before = a.task("Count").state.n
        fleet.run_for(0.5)
        assert a.task("Count").state.n == before
        fleet.faults.calm()
        assert fleet.run_until(lambda: running(fleet, "Count"), 20)


def test_the_guardians_of_a_paused_task_are_asked_as_soon_as_they_are_linked_again():
    with guarded("Count", Count, takeover="ask") as fleet:
        a, waited_s = fleet.agents["a"], []
        for _ in range(8):  # at moments of their own between two requests
            fleet.faults.cut("a")
            assert fleet.run_until(lambda: not a.agent.mesh.connected(), 30.0)
            assert running(fleet, "Count") == []
            fleet.faults.calm()
            assert fleet.run_until(a.agent.mesh.connected, 30.0)
            linked_s = fleet.now()
            assert fleet.run_until(lambda: running(fleet, "Count") == ["a"], 5.0)
            waited_s.append(fleet.now() - linked_s)
        assert max(waited_s) < 0.1, "longer than a round trip"


def test_a_former_owner_that_was_replaced_as_a_guardian_while_it_was_away_has_nothing_left_of_the_task():
    with guarded("Count", Count) as fleet:
        a = fleet.agents["a"]
        fleet.faults.cut("a")
        assert fleet.run_until(lambda: set(running(fleet, "Count")) & {*"bcd"}, 10)
        (owner,) = running(fleet, "Count")
        assert fleet.run_until(lambda: all(members(fleet, name) == {"b", "c", "d"} for name in "bcd"), 120.0)
        fleet.faults.calm()
        assert fleet.run_until(lambda: record(fleet, "Count").standing is Standing.RELEASED, 30.0)
        fleet.run_for(1.0)
        assert a.running() == [] and running(fleet, "Count") == [owner] and not record(fleet, "Count").snapshot
        assert a.lines("error") == []
        assert fleet.agents[owner].ask(Migrate("Count", to="a")).ok
        assert fleet.run_until(lambda: running(fleet, "Count") == ["a"], 10.0)


def test_a_task_that_its_file_guards_no_more_has_no_other_member():
    with guarded("Count", Count) as fleet:
        fleet.crash("a")
        a = fleet.start("a", tasks={"Count": Count})
        fleet.connect()
        fleet.run_for(5.0)
        assert record(fleet, "Count").register.unguarded and a.running() == ["Count"]
        assert a.ask(Guarding()).result == []
        fleet.faults.cut("a")
        fleet.run_for(5.0)
        assert running(fleet, "Count") == ["a"], "it needs no lease"
