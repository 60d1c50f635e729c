"""What is told of a task, driver or service that fails: once, with its author's own line, and a traceback on demand."""

import json
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
from msgspec import Meta

from pancakes.control import Configure, Describe, Start
from pancakes.devices.driver import Actuator, Driver, Sensor
from pancakes.errors import LONGEST_TRACEBACK
from pancakes.service import Service
from pancakes.task import Task, every

HERE = Path(__file__).name


def line_of(text):
    """Returns the number of the only line of this file that ends with a comment."""
    (found,) = [n for n, line in enumerate(Path(__file__).read_text().splitlines(), 1) if line.endswith(f"# {text}")]
    return found


def paint(colours):
    try:
        return colours["x"]
    except KeyError as error:
        raise ValueError("bad colour") from error  # bad colour


class Blink(Task):
    @every(hz=1)
    def blink(self, tick):
        paint({})


class Unstarted(Task):
    def on_start(self):
        paint({})


class Unmade(Task):
    def __init__(self, *args, **others):
        super().__init__(*args, **others)
        paint({})


class Unplugged(Sensor):
    type = "load"

    def open(self):
        paint({})

    def read(self):
        return None


class Mapper(Service):
    def on_start(self):
        paint({})


class Lamp(Actuator):
    """Its settings are those that `Driver` brings."""

    type = "motors"

    def write(self, command, ttl_s, source):
        pass

    def safe_stop(self):
        pass


class Probe(Sensor):
    type = "load"

    @dataclass
    class Settings:
        gain: Annotated[float, Meta(gt=0)] = 1.0

    def read(self):
        return None


class Heater(Probe):
    """Has the settings of another driver."""


SAID = f"ValueError: bad colour (from KeyError: 'x') at {HERE}:{line_of('bad colour')} in paint"
TWICE = {"at_most": 2, "within_s": 60}


def told(agent, level=""):
    return [line for line in agent.lines(level) if "bad colour" in line]


def untimed(line):
    """A line without when the next try is."""
    return re.sub(r" in [0-9.]+ s:", ":", line)


@pytest.mark.parametrize("failing", [Blink, Unstarted, Unmade])
def test_a_failed_task_is_told_with_its_authors_line_and_what_led_to_it(fleet, failing):
    agent = fleet.start("a", tasks={"Blink": {"type": failing, "restart": TWICE}})
    fleet.run_for(60.0)
    given_up = f"a/client/Blink is given up: {SAID} "
    assert [untimed(line) for line in told(agent, "warning")] == [f"a/client/Blink is started again: {SAID}"] * 2
    (last,) = told(agent, "error")
    assert last.startswith(given_up)
    assert {event["error"] for event in agent.events("task_failed")} == {SAID}


def test_so_are_a_driver_and_a_service(fleet):
    agent = fleet.start("a", devices={"lamp": {"type": Unplugged, "restart": TWICE}})
    fleet.run_for(60.0)
    assert untimed(told(agent)[0]) == f"a/device/lamp is started again: {SAID}"
    other = fleet.start("b", services={"mapper": {"type": Mapper, "restart": TWICE}})
    fleet.run_for(60.0)
    assert untimed(told(other)[0]) == f"b/mapper is started again: {SAID}"


def start_failing(fleet, **log):
    fails = {"type": Unstarted, "restart": TWICE}
    return fleet.start(
        "a",
        tasks={"Unstarted": fails, "Unmade": {**fails, "type": Unmade}},
        devices={"lamp": {"type": Unplugged, "restart": {**TWICE, "again_s": 0.0}}},
        services={"mapper": {"type": Mapper, "restart": TWICE}, "log": {"settings": log}},
    )


def test_each_failed_start_is_told_once(fleet, capsys):
    agent = start_failing(fleet)
    fleet.run_for(60.0)
    shown = [line for line in capsys.readouterr().err.splitlines() if "bad colour" in line]
    expected = {"a/client/Unstarted": 3, "a/client/Unmade": 3, "a/device/lamp": 3, "a/mapper": 3}
    assert Counter(line.partition(": ")[2].partition(" is ")[0] for line in shown) == expected
    assert len(told(agent)) == len(shown)


def test_a_start_that_is_asked_for_and_fails_is_answered_and_told_once(fleet):
    agent = fleet.start("a", tasks={"T": {"type": Unstarted, "start": False, "restart": {"policy": "no"}}})
    reply = agent.ask(Start("T"))
    assert (reply.ok, reply.reason) == (False, f"a/client/T failed to start: {SAID}")
    fleet.run_for(1.0)
    assert len(told(agent)) == 1


def test_a_task_that_was_refused_is_told_as_before(fleet):
    class Needy(Task):
        requires = ("motors",)

    agent = fleet.start("a", tasks={"Needy": Needy})
    assert [line for line in agent.lines("error") if "Needy" in line] == [
        "a/client/Needy was not started: a lacks the device types motors, which Needy requires"
    ]


def test_the_whole_traceback_is_in_the_log_file_and_is_known_of_the_task(fleet, tmp_path):
    path = tmp_path / "a.jsonl"
    agent = start_failing(fleet, console=False, file=str(path))
    fleet.run_for(60.0)
    agent.stop()
    records = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    lines = [record for record in records if record["kind"] == "line" and "bad colour" in record["text"]]
    assert len(lines) == 12
    for record in lines:
        assert record["traceback"].startswith("Traceback (most recent call last):")
        assert "KeyError: 'x'" in record["traceback"] and record["traceback"].endswith("ValueError: bad colour")
        assert len(record["traceback"]) <= LONGEST_TRACEBACK
    assert not any("traceback" in record for record in records if record not in lines)


def test_how_a_task_failed_the_last_time_is_known_while_it_runs_again(fleet):
    agent = fleet.start("a", tasks={"Blink": Blink}, devices={"lamp": Unplugged})
    assert agent.ask(Describe("Blink")).result["failure"] is None
    fleet.run_for(1.5)
    fleet.run_until(lambda: agent.running() == ["Blink"])
    failure = agent.ask(Describe("Blink")).result["failure"]
    assert failure["text"] == SAID and 1.0 <= failure["t_s"] < 1.5
    assert "in paint" in failure["traceback"] and failure["traceback"].endswith("ValueError: bad colour")
    assert agent.ask(Describe("lamp")).result["failure"]["text"] == SAID


def test_a_terminal_shows_tracebacks_only_where_they_are_asked_for(fleet, capsys):
    fleet.start("a", tasks={"Blink": {"type": Blink, "restart": TWICE}})
    fleet.run_for(2.0)
    assert "Traceback" not in capsys.readouterr().err
    settings = {"log": {"settings": {"traceback": True}}}
    fleet.start("b", tasks={"Blink": {"type": Blink, "restart": {"policy": "no"}}}, services=settings)
    fleet.run_for(2.0)
    shown = capsys.readouterr().err
    assert shown.count("ValueError: bad colour (from KeyError: 'x')") == 1
    assert "          Traceback (most recent call last):" in shown.splitlines()


@pytest.mark.parametrize(
    ("driver", "change", "problem"),
    [
        (Lamp, {"gain": 2.0}, "bad settings for lamp: gain: unknown key"),
        (Probe, {"gain": -2.5}, "bad settings for lamp: gain: expected a number > 0, not -2.5"),
        (Heater, {"gain": -2.5}, "bad settings for lamp: gain: expected a number > 0, not -2.5"),
    ],
)
def test_settings_that_do_not_fit_name_the_device(fleet, driver, change, problem):
    agent = fleet.start("a", devices={"lamp": driver})
    for dry_run in (True, False):
        refused = agent.ask(Configure("lamp", change, dry_run))
        assert refused.reason == problem
        assert refused.result == {"problems": [{"path": ["gain"], "text": problem.rpartition("gain: ")[2]}]}
    other = fleet.start("b", devices={"lamp": {"type": driver, "settings": change, "restart": TWICE}})
    fleet.run_for(60.0)
    assert other.ask(Describe("lamp")).result["reason"] == problem
    assert other.ask(Start("lamp", {**change, "offset": 1})).reason.startswith("bad settings for lamp: ")
    assert issubclass(driver, Driver)
