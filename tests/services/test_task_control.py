"""Tasks under a service: started, stopped, restarted, rescheduled and configured by packets, each with its reply."""

from dataclasses import dataclass

import pytest
from seeded import for_each

from pancakes.control import Configure, Describe, Reschedule, Restart, Start, Stop
from pancakes.devices import Load, Pose
from pancakes.events import LogLine
from pancakes.packet import SYSCTRL
from pancakes.service import Service
from pancakes.task import Task, every, on, reliable
from pancakes.testing import Fleet, threaded_agent


def said(reply):
    """What a reply says, apart from its number."""
    return reply.ok, reply.reason, reply.result


class Count(Task):
    """Counts its ticks."""

    @dataclass
    class Settings:
        step: int = 1
        at_most: float = 1e9

    @dataclass
    class State:
        n: int = 0

    @every(hz=10)
    def tick(self, tick):
        self.state.n += self.settings.step
        self.publish("system", Load(float(self.state.n)))

    @every(hz=0)
    def rest(self, tick):
        self.log("info", "rest")

    def on_settings(self):
        self.log("info", f"step is {self.settings.step}")
        if self.settings.step == 12:
            raise ValueError("a dozen is too much")
        if self.settings.step == 13:
            raise RuntimeError("unlucky settings")


class Fragile(Task):
    """Fails when it is told to."""

    @dataclass
    class Settings:
        fail_at_start: bool = False

    def on_start(self):
        if self.settings.fail_at_start:
            raise RuntimeError("no luck")

    @on("system", Pose, queue=reliable(50))
    def pose(self, packet):
        if packet.body.x_m < 0:
            raise RuntimeError("negative")
        if packet.body.x_m > 100:
            self.stop()
        self.log("info", f"got {packet.body.x_m:g}")


class Plain(Service):
    """A user's own service, whose tasks are not durable."""


@pytest.fixture(params=["client", "plain"])
def service(request):
    """Control works alike in a service with durable tasks and in one without."""
    return request.param


@pytest.fixture
def fleet():
    with Fleet(seed=3, classes={"test.plain": Plain}) as made:
        yield made


def start(fleet, service, **tasks):
    services = {} if service == "client" else {"plain": {"type": "test.plain"}}
    made = {}
    for name, what in tasks.items():
        fields = {"type": what} if isinstance(what, type) else what
        made[name] = {**fields, "service": service}
    agent = fleet.start("a", tasks=made, services=services)
    agent.service = service
    return agent


def test_a_task_that_is_not_to_start_waits_for_a_packet(fleet, service):
    agent = start(fleet, service, Count={"type": Count, "start": False})
    assert agent.running(service) == []
    assert said(agent.ask(Start("Count"))) == (True, "", None)
    assert agent.running(service) == ["Count"]
    fleet.run_for(1.0)
    assert agent.task("Count", service).state.n == 10
    assert said(agent.ask(Start("Count"))) == (False, f"a/{service}/Count is running already", None)


def test_stop_and_start_go_on_with_the_state(fleet, service):
    agent = start(fleet, service, Count=Count)
    fleet.run_for(1.0)
    assert agent.ask(Stop("Count")).ok
    assert agent.running(service) == []
    assert said(agent.ask(Stop("Count"))) == (False, f"a/{service}/Count is stopped already", None)
    fleet.run_for(5.0)
    assert agent.ask(Start(f"{service}/Count")).ok
    assert agent.task("Count", service).state.n == 10
    fleet.run_for(0.5)
    assert agent.task("Count", service).state.n == 15


def test_a_start_may_bring_settings_and_bad_ones_are_refused(fleet, service):
    agent = start(fleet, service, Count={"type": Count, "start": False, "settings": {"at_most": 7.0}})
    refused = agent.ask(Start("Count", {"stap": 5}))
    assert not refused.ok and "stap: unknown key, did you mean 'step'?" in refused.reason
    assert agent.running(service) == []
    assert agent.ask(Start("Count", {"step": 5})).ok
    settings = agent.task("Count", service).settings
    assert (settings.step, settings.at_most) == (5, 7.0)


def test_a_restart_keeps_the_state_or_drops_it(fleet, service):
    agent = start(fleet, service, Count=Count)
    fleet.run_for(1.0)
    first = agent.task("Count", service)
    assert agent.ask(Restart("Count")).ok
    assert agent.task("Count", service) is not first
    assert agent.task("Count", service).state.n == 10
    assert agent.ask(Restart("Count", keep_state=False)).ok
    assert agent.task("Count", service).state.n == 0
    assert agent.slot("Count", service).life.incarnation == 3


def test_a_restart_that_drops_the_state_begins_as_the_configuration_says(fleet, service):
    agent = start(fleet, service, Count={"type": Count, "settings": {"step": 2}})
    assert agent.ask(Configure("Count", {"step": 3})).ok
    assert agent.ask(Reschedule("Count", 2.0)).ok
    assert agent.ask(Restart("Count", keep_state=False)).ok
    fleet.run_for(1.0)
    assert agent.task("Count", service).state.n == 10 * 2


def test_a_restart_starts_what_was_stopped(fleet, service):
    agent = start(fleet, service, Count={"type": Count, "start": False})
    assert agent.ask(Restart("Count")).ok
    assert agent.running(service) == ["Count"]


def test_a_restart_loses_no_packet_that_waited(fleet, service):
    agent = start(fleet, service, Fragile=Fragile)
    for number in range(5):
        agent.publish("system", Pose(number, 0.0, 0.0))
    agent.ask(Restart("Fragile"))
    fleet.run_for(0.1)
    assert [line for line in agent.lines("info") if line.startswith("got")] == [f"got {n}" for n in range(5)]


def test_a_new_rate_holds_from_the_next_tick_on(fleet, service):
    agent = start(fleet, service, Count=Count)
    fleet.run_for(1.0)
    assert said(agent.ask(Reschedule("Count", 2.0))) == (True, "", {"timer": "tick", "rate_hz": 2.0, "before_hz": 10.0})
    agent.probe.forget()
    fleet.run_for(4.0)
    assert len(agent.probe.packets(Load)) == 8
    assert agent.ask(Describe("Count")).result["rate_hz"] == 2.0


def test_a_second_timer_is_named(fleet, service):
    agent = start(fleet, service, Count=Count)
    assert agent.ask(Reschedule("Count", 4.0, timer="rest")).ok
    fleet.run_for(1.0)
    assert len([line for line in agent.lines() if line == "rest"]) == 4
    refused = agent.ask(Reschedule("Count", 4.0, timer="tock"))
    assert said(refused) == (False, f"a/{service}/Count has no timer 'tock', only tick, rest", None)


@pytest.mark.parametrize("rate_hz", [-1.0, float("nan"), float("inf"), 1e12])
def test_a_rate_that_is_none_is_refused_and_the_timer_goes_on(fleet, service, rate_hz):
    agent = start(fleet, service, Count=Count)
    assert not agent.ask(Reschedule("Count", rate_hz)).ok
    fleet.run_for(1.0)
    assert agent.task("Count", service).state.n >= 10


def test_settings_change_while_it_runs_all_or_none(fleet, service):
    agent = start(fleet, service, Count=Count)
    assert said(agent.ask(Configure("Count", {"step": 4}))) == (True, "", {"settings": {"step": 4}})
    assert agent.task("Count", service).settings == Count.Settings(step=4)
    assert "step is 4" in agent.lines("info")
    refused = agent.ask(Configure("Count", {"step": 9, "at_most": "much"}))
    assert not refused.ok and "at_most" in refused.reason
    assert agent.task("Count", service).settings == Count.Settings(step=4)


def test_who_asks_for_settings_that_the_task_fails_on_is_answered_too(fleet, service):
    agent = start(fleet, service, Count=Count)
    refused = agent.ask(Configure("Count", {"step": 13}))
    assert not refused.ok and "unlucky settings" in refused.reason
    agent.wait_for_event("task_started", task="Count", incarnation=2)


def test_settings_that_the_task_itself_refuses_change_nothing(fleet, service):
    agent = start(fleet, service, Count=Count)
    assert agent.ask(Configure("Count", {"step": 12})).reason == "a dozen is too much"
    assert agent.task("Count", service).settings.step == 1


@pytest.mark.parametrize("asked", [Reschedule("Count", 1.0), Configure("Count", {"step": 2})])
def test_what_needs_a_running_task_is_refused_where_there_is_none(fleet, service, asked):
    agent = start(fleet, service, Count={"type": Count, "start": False})
    assert said(agent.ask(asked)) == (False, f"a/{service}/Count is stopped, not running", None)


def test_contradictory_commands_are_applied_in_the_order_of_their_numbers(fleet, service):
    """Also where they come faster than a task can follow: the last one holds, and each gets its answer."""
    agent = start(fleet, service, Count={"type": Count, "start": False})
    asked = [agent.publish(SYSCTRL, body) for body in (Start("Count"), Stop("Count"), Start("Count"), Stop("Count"))]
    replies = [agent.reply_to(packet) for packet in asked]
    fleet.run_for(1.0)
    assert replies[-1].ok
    assert agent.running(service) == []
    numbers = [event["number"] for event in agent.events("asked", task="Count")]
    assert numbers == sorted(numbers) and len(set(numbers)) == len(numbers)


def test_a_start_that_is_followed_by_a_stop_is_answered(fleet, service):
    agent = start(fleet, service, Count={"type": Count, "start": False})
    started = agent.publish(SYSCTRL, Start("Count"))
    stopped = agent.publish(SYSCTRL, Stop("Count"))
    agent.reply_to(started)
    assert agent.reply_to(stopped).ok
    assert agent.running(service) == []
    # And it is not stuck half-way: it can be started again.
    assert agent.ask(Start("Count")).ok
    fleet.run_for(1.0)
    assert agent.task("Count", service).state.n == 10


def test_commands_in_a_hail_end_as_the_last_one_said(service):
    """Every order of the actors: nobody is left without an answer, and the task is where the last command put it."""
    for_each(range(3), lambda seed: hail_of_commands(seed, service))


def hail_of_commands(seed, service):
    with Fleet(seed, classes={"test.plain": Plain}) as fleet:
        agent = start(fleet, service, Count=Count)
        random = agent.kernel.random_for(f"hail/{seed}")
        for last in (Start("Count"), Stop("Count")):
            asked = []
            for _ in range(12):
                body = random.choice([Start("Count"), Stop("Count"), Restart("Count"), Restart("Count", False)])
                asked.append(agent.publish(SYSCTRL, body))
                if random.random() < 0.5:
                    fleet.run_for(random.choice([0.0, 0.0005, 0.002, 0.05]))
            asked.append(agent.publish(SYSCTRL, last))
            for packet in asked:
                agent.reply_to(packet)
            assert agent.running(service) == (["Count"] if isinstance(last, Start) else [])
        assert agent.ask(Start("Count")).ok
        fleet.run_for(0.5)
        assert agent.task("Count", service).state.n > 0


# Supervision ---------------------------------------------------------------------------------------------------


def test_a_task_that_fails_is_started_again_and_both_are_told(fleet, service):
    agent = start(fleet, service, Fragile=Fragile)
    agent.publish("system", Pose(1.0, 0.0, 0.0))
    # It comes under a reliable subscription, so three times: so often it fails.
    agent.publish("system", Pose(-1.0, 0.0, 0.0))
    agent.publish("system", Pose(2.0, 0.0, 0.0))
    fleet.run_for(1.0)
    failed = agent.events("task_failed", task="Fragile")
    assert [event["then"] for event in failed] == ["restart", "restart", "restart"]
    assert "RuntimeError: negative" in failed[0]["error"] and "test_task_control.py" in failed[0]["error"]
    assert agent.kernel.dead_letters.count == 1
    assert [line for line in agent.lines("info") if line.startswith("got")] == ["got 1", "got 2"]
    assert agent.slot("Fragile", service).life.incarnation == 4


def test_a_task_that_fails_too_often_is_given_up(fleet, service):
    spec = {"type": Fragile, "settings": {"fail_at_start": True}, "restart": {"at_most": 2, "within_s": 5}}
    agent = start(fleet, service, Fragile=spec, Count=Count)
    fleet.run_for(1.0)
    assert [event["then"] for event in agent.events("task_failed")] == ["restart", "restart", "give up"]
    assert agent.events("task_given_up", task="Fragile")
    assert any(f"a/{service}/Fragile is given up: RuntimeError: no luck" in line for line in agent.lines("error"))
    assert agent.ask(Describe("Fragile")).result["state"] == "failed"
    assert agent.running(service) == ["Count"]
    # A person may try once more, with other settings.
    assert not agent.ask(Start("Fragile")).ok
    fleet.run_for(1.0)
    assert agent.ask(Start("Fragile", {"fail_at_start": False})).ok


def test_a_start_that_fails_is_answered_with_the_error(fleet, service):
    spec = {"type": Fragile, "start": False, "settings": {"fail_at_start": True}, "restart": {"policy": "no"}}
    agent = start(fleet, service, Fragile=spec)
    refused = agent.ask(Start("Fragile"))
    assert not refused.ok
    assert f"a/{service}/Fragile failed to start: RuntimeError: no luck" in refused.reason


@pytest.mark.parametrize(
    ("policy", "x_m", "state", "runs"),
    [
        ("always", 101.0, "running", 2),
        ("on-failure", 101.0, "stopped", 1),
        ("no", 101.0, "stopped", 1),
        ("on-failure", -1.0, "running", 4),
        ("no", -1.0, "failed", 1),
    ],
)
def test_the_policy_says_what_follows_an_end(fleet, service, policy, x_m, state, runs):
    """101 makes the task end by itself; -1 makes it fail, as often as a reliable packet comes."""
    agent = start(fleet, service, Fragile={"type": Fragile, "restart": {"policy": policy}})
    agent.publish("system", Pose(x_m, 0.0, 0.0))
    fleet.run_for(1.0)
    assert agent.ask(Describe("Fragile")).result["state"] == state
    assert agent.slot("Fragile", service).life.incarnation == runs


def test_what_a_task_that_was_given_up_had_subscribed_to_holds_nobody_up(fleet, service):
    agent = start(fleet, service, Fragile={"type": Fragile, "restart": {"policy": "no"}})
    agent.publish("system", Pose(-1.0, 0.0, 0.0))
    fleet.run_for(0.1)
    for number in range(100):  # twice what its reliable queue takes
        agent.publish("system", Pose(number, 0.0, 0.0))


def test_a_task_whose_class_cannot_be_made_is_given_up_as_well(fleet, service):
    class Broken(Task):
        def __init__(self, *args, **others):
            super().__init__(*args, **others)
            raise RuntimeError("cannot be made")

    agent = start(fleet, service, Broken=Broken)
    fleet.run_for(30.0)
    assert "cannot be made" in agent.events("task_given_up")[0]["error"]


def test_a_state_that_cannot_be_written_down_does_not_keep_a_task_from_ending(fleet, service):
    class Odd(Task):
        @dataclass
        class State:
            thing: float | None = None

        def on_start(self):
            self.state.thing = object()

    agent = start(fleet, service, Odd=Odd)
    fleet.run_for(3.0)
    assert agent.ask(Stop("Odd")).ok
    assert agent.running(service) == []
    assert any("cannot be written down" in line for line in agent.lines("error"))


# On threads ----------------------------------------------------------------------------------------------------


def test_the_same_on_threads():
    with threaded_agent(tasks={"Count": Count, "Fragile": {"type": Fragile, "restart": {"at_most": 9}}}) as agent:
        agent.wait_for(Load)
        assert agent.ask(Reschedule("Count", 50.0)).ok
        assert agent.ask(Restart("Count")).ok
        assert agent.ask(Stop("Count")).ok
        assert agent.ask(Stop("Count")).reason == "a/client/Count is stopped already"
        agent.publish("system", Pose(-1.0, 0.0, 0.0))
        agent.wait_for_event("task_started", task="Fragile", incarnation=4)
        agent.publish("system", Pose(3.0, 0.0, 0.0))
        agent.wait_for(LogLine, lambda line: line.text == "got 3")
        assert agent.ask(Start("Count")).ok
