"""What can be asked of an agent besides changes: dry runs, descriptions, channels, history, its end; and the order."""

from dataclasses import dataclass
from typing import Annotated

import pytest
from msgspec import Meta

from pancakes.control import Channels, Configure, Describe, Follow, History, Reschedule, Restart, Shutdown, Start, Stop
from pancakes.devices import Load, Pose
from pancakes.service import Service
from pancakes.task import Task, every, on
from pancakes.testing import Fleet


class Count(Task):
    """Counts its ticks."""

    @dataclass
    class Settings:
        """How it counts.

        Attributes:
            step: so much at each tick.
        """

        step: Annotated[int, Meta(ge=1, le=100)] = 1

    @dataclass
    class State:
        n: int = 0

    @every(hz=10)
    def tick(self, tick):
        self.state.n += self.settings.step
        self.publish("system", Load(float(self.state.n)))

    @on("system", Pose, queue=3)
    def pose(self, packet):
        pass


class Driver(Task):
    """Wants the wheels for itself."""

    requires = ("motors",)


class Plain(Service):
    """A service whose tasks have no records."""


@pytest.fixture
def fleet():
    with Fleet() as fleet:
        yield fleet


def rate_of(agent, task="Count"):
    return agent.ask(Describe(task)).result["rate_hz"]


def state_of(agent, task="Count"):
    return agent.task(task).state


@pytest.mark.parametrize(
    "body",
    [
        Start("Idle", {"step": 5}, dry_run=True),
        Stop("Count", dry_run=True),
        Restart("Count", keep_state=False, dry_run=True),
        Reschedule("Count", 3.0, dry_run=True),
        Configure("Count", {"step": 7}, dry_run=True),
        Stop("client", dry_run=True),
        Restart("client", dry_run=True),
    ],
    ids=lambda body: f"{type(body).__name__} {body.target}",
)
def test_a_dry_run_says_yes_and_changes_nothing(fleet, body):
    agent = fleet.start("a", tasks={"Count": Count, "Idle": {"type": Count, "start": False}})
    before = agent.ask(Describe("Count")).result
    agent.probe.forget()
    assert agent.ask(body).ok
    fleet.run_for(0.05)
    after = agent.ask(Describe("Count")).result
    for key in ("state", "incarnation", "rate_hz", "settings"):
        assert after[key] == before[key]
    assert agent.ask(Describe("Idle")).result["state"] == "stopped"
    assert agent.ask(Describe("Idle")).result["settings"] == {"step": 1}
    assert [event for event in agent.events() if "number" in event] == []


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (Start("Count", dry_run=True), "a/client/Count is running already"),
        (Start("Idle", {"stepp": 5}, dry_run=True), "stepp: unknown key, did you mean 'step'?"),
        (Start("Wheels", dry_run=True), "a lacks the device types motors, which Wheels requires"),
        (Restart("Wheels", dry_run=True), "a lacks the device types motors, which Wheels requires"),
        (Stop("Idle", dry_run=True), "a/client/Idle is stopped already"),
        (Reschedule("Count", -1.0, dry_run=True), "-1"),
        (Reschedule("Count", 1.0, timer="tock", dry_run=True), "has no timer 'tock', only tick"),
        (Configure("Count", {"step": 1000}, dry_run=True), "step: expected an integer <= 100, not 1000"),
        (Start("client", dry_run=True), "a/client is running already"),
        (Stop("client", for_s=-1.0, dry_run=True), "cannot be stopped for -1.0 s"),
    ],
    ids=lambda value: f"{type(value).__name__} {value.target}" if not isinstance(value, str) else "",
)
def test_a_dry_run_is_refused_for_the_reason_that_the_change_would_be(fleet, body, reason):
    agent = fleet.start(
        "a",
        tasks={
            "Count": Count,
            "Idle": {"type": Count, "start": False},
            "Wheels": {"type": Driver, "start": False},
        },
    )
    reply = agent.ask(body)
    assert not reply.ok
    assert reason in reply.reason


def test_a_task_is_described_with_all_that_is_known_about_it(fleet):
    agent = fleet.start("a", tasks={"Count": {"type": Count, "settings": {"step": 3}}})
    fleet.run_for(1.0)
    told = agent.ask(Describe("Count")).result
    assert told["settings"] == {"step": 3}
    assert told["settings_schema"]["properties"]["step"] == {
        "type": "integer",
        "minimum": 1,
        "maximum": 100,
        "default": 1,
        "description": "so much at each tick.",
    }
    (timer,) = told["timers"]
    assert (timer["timer"], timer["rate_hz"], timer["ticks"]) == ("tick", 10.0, 10)
    (reads,) = told["reads"]
    read = {"channel": "system", "types": ["pose"], "queue": "3", "limit": 3, "waiting": 0, "dropped": 0}
    assert reads.items() >= read.items()
    restart = {"policy": "always", "at_most": 8, "within_s": 60.0}
    assert told["restart"] == {**restart, "pause_s": 0.1, "pause_max_s": 10.0, "again_s": 0.0}
    assert (told["failures"], told["next_try_s"]) == (0, None)
    assert told["durability"] == "lazy"


def test_the_state_of_a_task_is_told_where_it_is_asked_for(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    fleet.run_for(1.0)
    told = agent.ask(Describe("Count", state=True)).result
    assert told["state"] == {"n": 10}
    assert told["settings"] == {"step": 1}
    assert "ticks" in told


def test_a_state_that_cannot_be_written_down_is_refused_and_the_task_runs(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    agent.task("Count").state.n = object()
    reply = agent.ask(Describe("Count", state=True))
    assert reply.reason.startswith("the state of a/client/Count cannot be written down: ")
    assert agent.running() == ["Count"]


def test_a_task_whose_settings_are_bad_can_still_be_described(fleet):
    agent = fleet.start("a", tasks={"Count": {"type": Count, "settings": {"step": 0}}})
    told = agent.ask(Describe("Count")).result
    assert told["settings"] == {"step": 0}
    assert told["state"] == "failed"


def test_the_channels_of_an_agent_are_described_with_who_reads_them(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    agent.agent.kernel.stream.open("map")
    told = {row["channel"]: row for row in agent.ask(Channels()).result}
    assert list(told)[:2] == ["system", "sysctrl"]
    assert told["system"]["core"]
    assert not told["map"]["core"]
    assert "a/client/Count" in [reader["address"] for reader in told["system"]["subscribers"]]
    assert [row["channel"] for row in agent.ask(Channels("map")).result] == ["map"]
    assert agent.ask(Channels("mapp")).reason.startswith("a has no channel 'mapp', did you mean 'map'?")


def test_what_waits_and_what_fell_out_is_counted_for_each_reader(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    for number in range(5):
        agent.publish("system", Pose(number, 0.0, 0.0))
    (reader,) = [
        reader for reader in agent.agent.kernel.stream.describe("system") if reader["address"] == "a/client/Count"
    ]
    assert (reader["waiting"], reader["dropped"]) == (3, 2)


def test_the_log_service_remembers_what_was_said(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    fleet.run_for(5.0)
    agent.ask(Reschedule("Count", 3.0))
    everything = agent.ask(History()).result
    newest = agent.ask(History(since_s=1.0)).result
    assert "ready" in [record["kind"] for record in everything]
    (record,) = [record for record in newest if record["kind"] == "rate_changed"]
    assert (record["agent"], record["task"], record["rate_hz"]) == ("a", "Count", 3.0)
    assert "ready" not in [record["kind"] for record in newest]


def test_all_that_is_asked_is_numbered_and_the_log_bears_the_numbers(fleet):
    agent = fleet.start("a", tasks={"Count": Count})
    agent.probe.forget()
    replies = [agent.ask(Reschedule("Count", rate_hz)) for rate_hz in (1.0, 2.0, 3.0)]
    refused = agent.ask(Stop("Nobody"))
    numbers = [reply.number for reply in (*replies, refused)]
    assert numbers == list(range(numbers[0], numbers[0] + 4))
    changed = agent.events("rate_changed")
    assert [(told["number"], told["rate_hz"], told["by"]) for told in changed] == [
        (number, rate_hz, "a/test/Probe") for number, rate_hz in zip(numbers, (1.0, 2.0, 3.0), strict=False)
    ]


@pytest.mark.parametrize("keep_state", [True, False])
def test_a_service_restarts_with_the_state_of_its_tasks_or_without(fleet, keep_state):
    agent = fleet.start("a", services={"plain": Plain}, tasks={"Count": {"type": Count, "service": "plain"}})
    fleet.run_for(1.0)
    assert agent.ask(Reschedule("Count", 1.0)).ok
    assert agent.ask(Restart("plain", keep_state)).ok
    task = agent.task("Count", "plain")
    assert (task.state.n >= 10) is keep_state
    assert rate_of(agent) == (1.0 if keep_state else 10.0)


@pytest.mark.parametrize("keep_state", [True, False])
def test_the_client_service_restarts_with_the_state_of_its_tasks_or_without(fleet, keep_state):
    agent = fleet.start("a", tasks={"Count": Count})
    fleet.run_for(1.0)
    assert agent.ask(Reschedule("Count", 1.0), to="a").ok
    other = fleet.start("b")
    fleet.connect()
    assert other.ask(Restart("client", keep_state), to="a").ok
    task = agent.component("client/Count")
    assert (task.facade.state.n >= 10) is keep_state
    assert task.timers["tick"].rate_hz == (1.0 if keep_state else 10.0)


def test_a_service_that_slept_wakes_with_the_rates_that_its_tasks_had(fleet):
    agent = fleet.start("a")
    assert agent.ask(Reschedule("network/Discovery", 0.25)).ok
    assert agent.ask(Stop("network", for_s=2.0)).ok
    fleet.run_for(3.0)
    assert rate_of(agent, "Discovery") == 0.25


def test_an_agent_ends_when_it_is_asked_to_and_says_yes_before(fleet):
    agent = fleet.start("a")
    ended = []
    assert "does not run as a process of its own" in agent.ask(Shutdown()).reason
    agent.agent.on_shutdown(lambda: ended.append("ended"))
    assert agent.ask(Shutdown(dry_run=True)).ok
    assert ended == [] and agent.events("asked", what="shutdown") == []
    assert agent.ask(Shutdown()).ok
    assert ended == ["ended"]
    assert len(agent.events("asked", what="shutdown")) == 1


def test_only_a_client_may_follow_what_others_send(fleet):
    fleet.start("b")
    agent = fleet.start("a")
    fleet.connect()
    reply = agent.ask(Follow("system", include_remote=True), to="b")
    assert reply.reason == "a is no client, so it cannot follow what others send to b"


def test_a_simulated_world_may_not_follow_what_others_send_and_a_client_may(fleet):
    agent = fleet.start("a")
    world = fleet.start("world", role="environment")
    page = fleet.start("page", role="client")
    fleet.connect()
    reply = world.ask(Follow("system", include_remote=True), to="a")
    assert reply.reason == "world is no client, so it cannot follow what others send to a"
    assert page.ask(Follow("system", include_remote=True), to="a").ok
    world.publish("system", Load(0.5), to="a")
    fleet.run_for(0.1)
    assert [packet.body.cpu for packet in page.probe.packets(Load, source="world/test/Probe")] == [0.5]
    assert agent.kernel.stream.followers("system") == ["page/test/Probe"]
