"""200 control commands per second from four clients: each is answered, in one order that all clients see."""

import random
from collections.abc import Iterator
from typing import Any

import pytest
from cli.abuse import Abuse, Answered, Told, in_file
from cli.processes import INSECURE, Rig, Running

from pancakes.control import Configure, Describe, Migrate, Reschedule, Restart, Start, Stop

SOURCE = """
from dataclasses import dataclass
from pancakes.task import Task, every

class Count(Task):
    @dataclass
    class Settings:
        step: int = 1

    @dataclass
    class State:
        n: int = 0

    @every(hz=20)
    def tick(self, tick):
        self.state.n += self.settings.step
"""
TASKS = ("one", "two", "three")
CONFIG = "".join(f'[task.{name}]\ntype = "count.Count"\n\n' for name in TASKS)
COMMANDS = 400


@pytest.fixture
def agents(rig: Rig) -> dict[str, Running]:
    rig.install("count", "[pancakes.tasks]\ncount.Count = plugin_count:Count\n", SOURCE)

    def log(name: str) -> str:
        return f'[service.log]\nsettings = {{ file = "{rig.directory / name}.jsonl", share_kib_s = 0 }}\n'

    first = rig.ready("a", CONFIG + log("a") + INSECURE)
    second = rig.ready("b", log("b") + INSECURE, agent=f'peers = ["{rig.address(first)}"]')
    first.hear("peer_up peer=b")
    return {"a": first, "b": second}


@pytest.fixture
def abuse(rig: Rig, agents: dict[str, Running]) -> Iterator[Abuse]:
    abuse = Abuse(rig, agents)
    yield abuse
    abuse.close()


def of_agent(answered: list[Answered], agent: str) -> list[Answered]:
    """Return the commands to one agent, in the order in which it applied them."""
    return sorted((it for it in answered if it.asked.agent == agent), key=lambda it: it.reply.number)


def one_order_for_all(rig: Rig, abuse: Abuse, answered: list[Answered], agent: str) -> None:
    """Check that numbers are unique, and that all clients and the agent's log file agree."""
    numbers = [it.reply.number for it in of_agent(answered, agent)]
    assert len(set(numbers)) == len(numbers)
    assert 0 < min(numbers) <= max(numbers) < abuse.ask(0, agent, Describe()).number
    stories = [client.told[agent] for client in abuse.clients]
    file = rig.directory / f"{agent}.jsonl"
    abuse.wait(lambda: len({len(story) for story in (*stories, in_file(file))}) == 1)
    assert stories[0]
    by_number = sorted(stories[0])
    for story in (*stories, in_file(file)):
        assert sorted(story) == by_number
        # Two components may speak at once, which is what the numbers are for; each is heard in its own order.
        for source in sorted({told.source for told in by_number}):
            assert said_by(source, story) == said_by(source, stories[0])


def said_by(source: str, story: list[Told]) -> list[Told]:
    """Return the events of one component."""
    return [told for told in story if told.source == source]


def rows(abuse: Abuse, agent: str) -> dict[str, dict[str, Any]]:
    """Return an agent's descriptions of its tasks, by name."""
    return {row["task"]: row for row in abuse.ask(0, agent, Describe()).result["tasks"]}


class Model:
    """A model of a task whose commands are applied one after the other, without other events."""

    def __init__(self) -> None:
        self.runs = True
        self.rate_hz = 20.0
        self.step = 1

    def take(self, body: Any) -> bool:
        """Apply a command; return whether an agent would."""
        match body:
            case Start(settings=settings):
                if self.runs or (settings is not None and "stepp" in settings):
                    return False
                self.runs = True
                self.step = settings["step"] if settings else self.step
            case Stop():
                if not self.runs:
                    return False
                self.runs = False
            case Restart(keep_state=keep):
                self.runs = True
                if not keep:
                    self.rate_hz, self.step = 20.0, 1
            case Reschedule(rate_hz=rate_hz, timer=timer):
                if not self.runs or timer:
                    return False
                self.rate_hz = rate_hz
            case Configure(settings=settings):
                if not self.runs or not isinstance(settings["step"], int):
                    return False
                self.step = settings["step"]
        return True


def contradictions(source: random.Random) -> list[tuple[str, Any]]:
    """Return random commands for three tasks; most of them undo the one before."""

    def draw(task: str) -> Any:
        return source.choice(
            [
                Start(task),
                Start(task, {"step": source.randrange(1, 9)}),
                Start(task, {"stepp": 1}),
                Stop(task),
                Stop(task),
                Restart(task),
                Restart(task, keep_state=False),
                Reschedule(task, float(source.randrange(1, 50))),
                Reschedule(task, 5.0, "no_such_timer"),
                Configure(task, {"step": source.randrange(1, 9)}),
                Configure(task, {"step": "fast"}),
            ]
        )

    return [("a", draw(source.choice(TASKS))) for _ in range(COMMANDS)]


def test_commands_of_many_clients_are_applied_in_one_order(rig: Rig, abuse: Abuse):
    answered = abuse.replies(abuse.offer(contradictions(random.Random(5))))

    assert len(answered) == COMMANDS
    models = {name: Model() for name in TASKS}
    for it in of_agent(answered, "a"):
        expected = models[it.asked.body.target].take(it.asked.body)
        assert it.reply.ok is expected, f"{it} was not what the commands before it lead to"
        assert it.reply.ok or it.reply.reason
    found = rows(abuse, "a")
    for name, model in models.items():
        assert found[name]["state"] == ("running" if model.runs else "stopped")
        assert found[name]["rate_hz"] == (model.rate_hz if model.runs else None)
        assert abuse.ask(0, "a", Describe(name)).result["settings"] == {"step": model.step}
    one_order_for_all(rig, abuse, answered, "a")


MOVING = ("moved to", "is being handed over between", "was given to", "is on its way", "is moving")
ELSEWHERE = ("has no task or service 'one'", "has no task 'one'", "does not run here", *MOVING)
"""What an agent says of a task that it does not have now."""
WAITS = "It is done as soon as the journal can write"
HERE = (" already", ", not running", ", so it cannot move", "no neighbour can take one: ", " is stuck: ", WAITS)
"""What an agent says of a task that it has, and that cannot do what is asked for.

It is stuck on a busy machine, or its journal is slow there, and it is starting where it has just arrived.
"""


def stops_and_moves(source: random.Random) -> list[tuple[str, Any]]:
    """Return commands for one task, to both agents; every eighth migrates it."""
    commands: list[tuple[str, Any]] = []
    for index in range(COMMANDS):
        agent, other = source.choice([("a", "b"), ("b", "a")])
        body = source.choice([Stop("one"), Start("one"), Restart("one"), Reschedule("one", 9.0), Describe("one")])
        commands.append((agent, Migrate("one", to=other) if index % 8 == 0 else body))
    return commands


def test_commands_to_a_migrating_task_leave_one_task(rig: Rig, abuse: Abuse):
    source = random.Random(11)
    answered: list[Answered] = []
    moved = met = False
    for _ in range(10):  # on a busy machine an agent may refuse all moves of a round
        answered += abuse.replies(abuse.offer(stops_and_moves(source)))
        refused = [it for it in answered if not it.reply.ok]
        moved = any(it.reply.ok for it in answered if isinstance(it.asked.body, Migrate))
        met = any(reason in it.reply.reason for it in refused for reason in MOVING)
        if moved and met:
            break

    assert moved and met, "it never moved, or no command came while it did"
    for it in refused:
        assert any(reason in it.reply.reason for reason in (*ELSEWHERE, *HERE)), it
    # One of the two agents has it, and it runs there and nowhere else.
    assert sorted(abuse.ask(0, agent, Restart("one")).ok for agent in ("a", "b")) == [False, True]
    states = [rows(abuse, agent).get("one", {"state": "absent"})["state"] for agent in ("a", "b")]
    assert states.count("running") == 1
    for agent in ("a", "b"):
        one_order_for_all(rig, abuse, answered, agent)


def test_commands_to_restarting_services_are_answered(rig: Rig, abuse: Abuse):
    source = random.Random(23)
    commands: list[tuple[str, Any]] = []
    for index in range(COMMANDS):
        if index % 20 == 10:
            commands.append(
                (
                    "a",
                    source.choice([Restart("client/"), Stop("client/"), Start("client/"), Stop("client/", for_s=0.05)]),
                )
            )
        else:
            task = source.choice(TASKS)
            commands.append(
                ("a", source.choice([Start(task), Stop(task), Restart(task), Reschedule(task, 9.0), Describe(task)]))
            )

    answered = abuse.replies(abuse.offer(commands))

    assert len(answered) == COMMANDS
    assert all(it.reply.ok or it.reply.reason for it in answered)
    assert abuse.ask(0, "a", Restart("client/")).ok
    for name in TASKS:
        assert abuse.ask(1, "a", Restart(name)).ok
        assert rows(abuse, "a")[name]["state"] == "running"
    one_order_for_all(rig, abuse, answered, "a")
