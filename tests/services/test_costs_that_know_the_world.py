"""Cost functions of others: they get readings of the bidder and what the task offers, and may fail in any way."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest

from pancakes.control import Migrate
from pancakes.devices import Pose, Temperature, Twist
from pancakes.durable.bidding_messages import MIGRATOR
from pancakes.durable.messages import Solicit
from pancakes.durable.record import TaskId
from pancakes.durable.snapshot import OFFER_BYTES
from pancakes.errors import ClassError
from pancakes.migration import Cost, CostFacts
from pancakes.packet import CTRL
from pancakes.task import Task, every
from pancakes.testing import Fleet, threaded_agent

BUS = "tcp://127.0.0.1:7499"
ROBOTS = {"a": (0.0, 0.0), "b": (1.0, 0.8), "c": (-1.0, 0.8), "d": (-1.0, -0.8), "e": (1.0, -0.8)}


class Patrol(Task):
    """Is to be near a place."""

    offers: ClassVar[tuple[str, ...]] = ("place_m",)

    @dataclass
    class Settings:
        weight: float = 1.0

    @dataclass
    class State:
        place_m: tuple[float, float] = (0.0, 0.0)
        secret: str = "not told"

    state: State

    @every(hz=5)
    def look(self, tick: Any) -> None:
        """Has something to write down."""
        self.state.secret = f"{tick}"


class Nearest(Cost):
    """The distance to the place."""

    name = "nearest"
    reads = ("pose",)

    def terms(self, facts: CostFacts) -> Mapping[str, float]:
        pose, (x_m, y_m) = facts.reading("pose"), facts.offered("place_m")
        return {"metres": facts.settings.get("weight", 1.0) * math.hypot(pose.x_m - x_m, pose.y_m - y_m)}


class Roam(Task):
    """Drives about, each robot in its own way."""

    requires = ("motors",)

    @every(hz=10)
    def drive(self, tick: Any) -> None:
        """Drives on a circle of its own."""
        self.publish(CTRL, Twist(0.15, 0.3 + 0.2 * (ord(self.agent) % 5)))


@pytest.fixture
def robots() -> Iterator[Fleet]:
    """Five robots that drive about in the simulator; the motion capture tells each its pose."""
    world = {
        "bus": BUS,
        "robots": {name: {"x_m": x, "y_m": y, "spread_m": 0.0, "spread_rad": 0.0} for name, (x, y) in ROBOTS.items()},
        "sensors": {},
        "movers": {},
    }
    capture = {"targets": {name: f"{name}/device/pose" for name in ROBOTS}, "send_hz": 10}
    classes = {"test.Patrol": Patrol, "nearest": Nearest}
    with Fleet(seed=5, classes=classes) as fleet:
        for name in ROBOTS:
            wheels = {"type": "sim.differential_drive", "settings": {"world": BUS}}
            tasks = {"Roam": Roam, **({"Patrol": {"type": "test.Patrol"}} if name == "a" else {})}
            fleet.start(name, devices={"motors": wheels, "pose": {"type": "network.pose"}}, tasks=tasks)
        tasks = {
            "World": {"type": "sim.world", "settings": world},
            "Capture": {"type": "sim.motion_capture", "settings": capture},
        }
        fleet.start("world", tasks=tasks, role="environment")
        fleet.run_for(6.0)
        yield fleet


def distances(fleet: Fleet, place_m: tuple[float, float]) -> dict[str, float]:
    """Returns how far each robot is from a place in truth."""
    seen: dict[str, float] = {}

    def see(packet: Any) -> None:
        for body in packet.body.bodies:
            seen[body.name] = math.hypot(body.x_m - place_m[0], body.y_m - place_m[1])

    stream = fleet.agents["world"].kernel.stream
    stream.tap("system", see, ("world_state",))
    fleet.run_for(0.3)
    stream.untap("system", see)
    return {name: distance for name, distance in seen.items() if name in ROBOTS}


def test_of_five_robots_that_drive_about_the_nearest_takes_the_task(robots: Fleet):
    winners = set()
    for place_m in ((1.2, 0.9), (-1.2, 0.9), (-1.2, -0.9), (1.2, -0.9)):
        home = next(name for name in ROBOTS if "Patrol" in robots.agents[name].running())
        robots.agents[home].task("Patrol").state.place_m = place_m
        robots.run_for(2.5)
        far = {name: distance for name, distance in distances(robots, place_m).items() if name != home}
        reply = robots.agents[home].ask(Migrate("Patrol", cost="nearest"))
        assert reply.ok, reply.reason
        lines = {line["peer"]: line for line in reply.result["lines"]}
        told = {name: lines[name]["terms"]["metres"] for name in far}
        assert told == pytest.approx(far, abs=0.15), "what they say is so"
        assert reply.result["winner"] == min(told, key=lambda name: told[name])
        winners.add(reply.result["winner"])
        robots.run_for(0.5)
    assert len(winners) >= 3


def test_bidders_are_told_what_the_class_offers_and_no_more(robots: Fleet):
    asked: list[Solicit] = []
    robots.agents["b"].kernel.stream.tap("network", lambda packet: asked.append(packet.body), ("migration.solicit",))
    for cost in ("nearest", "tasks"):
        robots.agents["a"].ask(Migrate("Patrol", cost=cost, dry_run=True))
    assert b"place_m" in asked[0].offer and b"secret" not in asked[0].offer
    assert asked[1].offer == b"", "the core's functions know nothing of the task"


def test_bidders_are_asked_for_what_the_class_needs_now(robots: Fleet, monkeypatch: pytest.MonkeyPatch):
    """Its last checkpoint may be of an older version."""
    asked: list[Solicit] = []
    robots.agents["b"].kernel.stream.tap("network", lambda packet: asked.append(packet.body), ("migration.solicit",))
    monkeypatch.setattr(robots.agents["a"].slot("Patrol").spec.cls, "requires", ("motors",))
    robots.agents["a"].ask(Migrate("Patrol", dry_run=True))
    assert asked[0].requires == ("motors",)


def one(cost: type[Cost], task: type[Task] = Patrol, **others: Any) -> str:
    """Returns why the only neighbour refuses."""
    with Fleet(4, classes={"test.Patrol": task, "odd": cost}) as fleet:
        a = fleet.start("a", tasks={"Patrol": {"type": "test.Patrol", **others}})
        fleet.start("b")
        fleet.connect()
        fleet.run_for(2.0)
        reply = a.ask(Migrate("Patrol", cost="odd"))
        assert not reply.ok and a.running() == ["Patrol"]
        return str(reply.reason)


@pytest.mark.parametrize(
    ("told", "reason"),
    [
        ({"metres": math.nan}, "its cost function 'odd' is of no use: its cost is nan"),
        ({"metres": -1.0}, "its cost function 'odd' is of no use: its cost is negative (-1)"),
        ({"metres": 2**2000}, "its cost function 'odd' failed: OverflowError"),
        ({"metres": "far"}, "its cost function 'odd' failed: TypeError"),
        ({1: 2.0}, "its cost function 'odd' told no numbers by name, but {1: 2.0}"),
        ([3.0], "its cost function 'odd' failed: TypeError"),
        (None, "its cost function 'odd' failed: TypeError"),
    ],
)
def test_a_function_that_tells_nonsense_is_a_refusal_with_the_reason(told: Any, reason: str):
    class Odd(Cost):
        name = "odd"

        def terms(self, facts: CostFacts) -> Mapping[str, float]:
            return told

    assert reason in one(Odd)


def test_what_has_not_been_read_or_is_not_offered_is_a_refusal_with_the_reason():
    class Warm(Cost):
        name = "odd"
        reads = ("temperature",)

        def terms(self, facts: CostFacts) -> Mapping[str, float]:
            return {"degrees": facts.reading("temperature").degrees_c}

    class Hidden(Cost):
        name = "odd"

        def terms(self, facts: CostFacts) -> Mapping[str, float]:
            return {"secrets": float(len(facts.offered("secret")))}

    assert "cannot tell its cost: its temperature has not been read yet" in one(Warm)
    assert "cannot tell its cost: the task does not tell its secret" in one(Hidden)


def test_a_reading_of_another_agent_counts_for_nothing():
    class Warm(Cost):
        name = "odd"
        reads = ("temperature",)

        def terms(self, facts: CostFacts) -> Mapping[str, float]:
            return {"degrees": facts.reading("temperature").celsius}

    with Fleet(4, classes={"test.Patrol": Patrol, "odd": Warm}) as fleet:
        a = fleet.start("a", tasks={"Patrol": {"type": "test.Patrol"}})
        b = fleet.start("b")
        fleet.connect()
        b.publish("system", Temperature(20.0))
        a.publish("system", Temperature(99.0), to="*")
        fleet.run_for(2.0)
        reply = a.ask(Migrate("Patrol", cost="odd", dry_run=True))
        assert reply.ok and reply.result["lines"][0]["cost"] == 20.0


def test_what_is_too_much_to_tell_stays_and_says_so():
    class Big(Patrol):
        offers = ("place_m", "secret")

        @every(hz=5)
        def look(self, tick: Any) -> None:
            self.state.secret = "x" * (OFFER_BYTES + 1)

    class Near(Nearest):
        name = "odd"

    reason = one(Near, Big)
    assert "a/Patrol cannot move for the cost odd: the settings of a/Patrol and what it offers" in reason
    assert f"bidders are told {OFFER_BYTES} at most" in reason


def test_an_offer_that_cannot_be_read_is_a_refusal():
    class Near(Nearest):
        name = "odd"

    with Fleet(4, classes={"test.Patrol": Patrol, "odd": Near}) as fleet:
        a = fleet.start("a")
        b = fleet.start("b")
        fleet.connect()
        journal = b.agent.mesh.identity.journal
        asked = Solicit(
            TaskId("a", "Patrol"), 1, "test.Patrol", "", "client", cost="odd", offer=b"\xc1", journal=journal
        )
        a.publish("network", asked, to=f"b/{MIGRATOR}")
        told = b.wait_for_event("migration_refused")
        assert "cannot tell its cost: what is told of the task cannot be read" in told["reason"]


def test_guardians_tell_bidders_for_a_lost_task_what_its_class_offers():
    rule = {"when": "battery", "below": 0.1, "cost": "nearest"}
    task = {"type": "test.Patrol", "guard": {"copies": 3, "guardians": ["b", "c"]}, "migrate": rule}
    with Fleet(4, classes={"test.Patrol": Patrol, "nearest": Nearest}) as fleet:
        a = fleet.start("a", tasks={"Patrol": task})
        for name, x_m in (("b", 3.0), ("c", 2.0), ("d", 1.0)):
            fleet.start(name).publish("system", Pose(x_m, 0.0, 0.0))
        fleet.connect()
        fleet.run_for(4.0)
        assert a.events("permit_given")
        a.task("Patrol").state.place_m = (2.1, 0.0)
        fleet.run_for(3.0)
        fleet.crash("a")
        assert fleet.run_until(lambda: any(it.running() for it in fleet.agents.values()), 15.0)
        assert [name for name, it in fleet.agents.items() if it.running()] == ["c"]


def test_a_class_offers_what_its_state_has():
    with pytest.raises(ClassError, match="'speed' is no field of its State, which has place_m, secret"):

        class Wrong(Patrol):
            offers = ("speed",)


GO_ON = threading.Event()
INSECURE = "[service.network]\nsettings = { insecure = true }\n"


class Waits(Cost):
    """Waits for something that does not come in time."""

    name = "waits"

    def terms(self, facts: CostFacts) -> Mapping[str, float]:
        GO_ON.wait(20.0)
        return {"patience": 1.0}


def test_a_function_that_waits_is_a_refusal_and_holds_up_nothing_else():
    GO_ON.clear()
    classes = {"test.Patrol": Patrol, "waits": Waits}
    tasks = {"Patrol": {"type": "test.Patrol"}}
    with threaded_agent("b", INSECURE, classes=classes, listen="tcp://127.0.0.1:0") as b:
        peers = tuple(b.agent.mesh.listen)
        with threaded_agent("a", INSECURE, classes=classes, tasks=tasks, peers=peers) as a:
            a.wait_until(lambda: a.agent.mesh.neighbours() == ["b"] and a.running() == ["Patrol"])
            for _ in range(2):
                reply = a.ask(Migrate("Patrol", cost="waits"))
                assert "its cost function 'waits' did not answer within 0.4 s" in reply.reason
            assert a.ask(Migrate("Patrol", cost="tasks", dry_run=True)).result["winner"] == "b"
            GO_ON.set()
            assert a.ask(Migrate("Patrol", cost="waits", dry_run=True)).result["winner"] == "b"
