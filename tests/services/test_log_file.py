"""The log file and the console: how large they become, and what is told where they cannot be written."""

import json
import os
from dataclasses import dataclass
from pathlib import Path

import pytest

from pancakes.control import Configure, History, Stop
from pancakes.events import LogLine
from pancakes.services.log import LogService
from pancakes.settings import check_settings
from pancakes.task import Task, every
from pancakes.testing import threaded_agent


class Chatty(Task):
    """Says far more than its share."""

    @dataclass
    class Settings:
        lines: int = 100

    @every(hz=10)
    def chat(self, tick):
        for number in range(self.settings.lines):
            self.log("info", f"line {number} at {tick.time_s:g} {'x' * 50}")


class Careful(Task):
    """Has one thing to say, and it matters."""

    @every(hz=1)
    def look(self, tick):
        self.log("error" if tick.time_s % 2 else "info", f"the wheel is loose at {tick.time_s:g}")


def log_of(**settings) -> dict[str, dict[str, dict[str, object]]]:
    return {"log": {"settings": {"console": False, **settings}}}


def records(path: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def texts(path: Path, source: str) -> list[str]:
    return [str(it["text"]) for it in records(path) if it["kind"] == "line" and it["source"] == source]


def said_and_left_out(lines: list[str]) -> tuple[int, int]:
    """Returns how many lines were written, and how many are told to have been left out."""
    told = [line for line in lines if line.endswith("were left out")]
    return len(lines) - len(told), sum(int(line.split()[0].replace(",", "")) for line in told)


def test_a_source_that_says_too_much_is_cut_short_with_a_count_and_others_are_heard(fleet, tmp_path):
    path = tmp_path / "a.jsonl"
    agent = fleet.start("a", tasks={"Chatty": Chatty, "Careful": Careful}, services=log_of(file=str(path)))
    fleet.run_for(12.0)
    agent.stop()

    written, left_out = said_and_left_out(texts(path, "a/client/Chatty"))
    assert 1000 < written < 5000
    assert written + left_out == len([line for line in agent.lines() if line.startswith("line ")]) >= 11_900
    assert any("more lines in the last 5 s were left out" in line for line in texts(path, "a/client/Chatty"))
    assert texts(path, "a/client/Careful") == [f"the wheel is loose at {second}" for second in range(1, 13)]
    assert any(record["kind"] == "service_stopped" for record in records(path))


def test_the_errors_of_a_source_that_says_too_much_are_heard_as_well(fleet, tmp_path):
    class Wild(Chatty):
        @every(hz=1)
        def look(self, tick):
            self.log("error", f"the wheel is loose at {tick.time_s:g}")

    path = tmp_path / "a.jsonl"
    agent = fleet.start("a", tasks={"Wild": Wild}, services=log_of(file=str(path)))
    fleet.run_for(4.5)
    agent.stop()
    loose = [line for line in texts(path, "a/client/Wild") if "loose" in line]
    assert loose == [f"the wheel is loose at {second}" for second in range(1, 5)]


def test_the_console_has_the_same_share_and_what_it_does_not_show_does_not_count(fleet, capsys):
    fleet.start("a", tasks={"Chatty": Chatty, "Careful": Careful}, services=log_of(console=True, level="info"))
    fleet.run_for(6.0)
    shown = capsys.readouterr().err.splitlines()
    assert 500 < len([line for line in shown if "Chatty: line" in line]) < 2500
    assert any(line.endswith("more lines in the last 5 s were left out") for line in shown)
    assert len([line for line in shown if "the wheel is loose" in line]) == 6

    fleet.start("b", tasks={"Chatty": Chatty, "Careful": Careful}, services=log_of(console=True, level="error"))
    fleet.run_for(6.0)
    shown = [line for line in capsys.readouterr().err.splitlines() if " b/client" in line]
    assert [line.partition(": ")[2] for line in shown] == [f"the wheel is loose at {second}" for second in (1, 3, 5)]


def test_the_share_is_a_setting_and_without_one_everything_is_written(fleet, tmp_path):
    path, small = tmp_path / "a.jsonl", tmp_path / "b.jsonl"
    a = fleet.start("a", tasks={"Chatty": Chatty}, services=log_of(file=str(path), share_kib_s=0))
    b = fleet.start("b", tasks={"Chatty": Chatty}, services=log_of(file=str(small), share_kib_s=0.1))
    fleet.run_for(3.05)
    a.stop()
    b.stop()
    assert said_and_left_out(texts(path, "a/client/Chatty")) == (3000, 0)
    written, left_out = said_and_left_out(texts(small, "b/client/Chatty"))
    assert 1 <= written < 20 and written + left_out == 3000


def test_what_is_said_is_written_in_its_own_letters(fleet, tmp_path):
    class Says(Task):
        def on_start(self):
            self.log("info", "die Räder sind lose")

    path = tmp_path / "a.jsonl"
    fleet.start("a", tasks={"Says": Says}, services=log_of(file=str(path)))
    fleet.run_for(0.1)
    assert "die Räder sind lose" in path.read_text(encoding="utf-8")


def test_what_the_log_service_remembers_is_not_cut_short(fleet, tmp_path):
    agent = fleet.start("a", tasks={"Chatty": Chatty}, services=log_of(file=str(tmp_path / "a.jsonl")))
    fleet.run_for(3.0)
    page = agent.ask(History()).result
    entries = page[0]["entry"], agent.ask(History(after=3000)).result[-1]["entry"]
    assert entries[1] - entries[0] == 1999
    assert not any("left out" in str(record.get("text")) for record in page)


def test_the_log_takes_no_more_of_the_disk_than_its_settings_say(fleet, tmp_path):
    path = tmp_path / "a.jsonl"
    settings = log_of(file=str(path), file_limit_mib=0.25, files=3, share_kib_s=0)
    fleet.start("a", tasks={"Chatty": Chatty}, services=settings)
    fleet.run_for(10.0)
    names = sorted(found.name for found in tmp_path.iterdir())
    assert names == ["a.jsonl", "a.jsonl.1", "a.jsonl.2"]
    limit, longest = 0.25 * 1024 * 1024, max(map(len, path.read_bytes().splitlines(keepends=True)))
    assert all(found.stat().st_size <= limit for found in tmp_path.iterdir())
    assert all((tmp_path / name).stat().st_size > limit - longest for name in names[1:]), "each is full"
    assert texts(path, "a/client/Chatty")[-1].startswith("line 99 at 10 ")


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"files": 1}, "files: expected an integer >= 2, not 1"),
        ({"file_limit_mib": 0}, "file_limit_mib: expected a number > 0, not 0"),
        ({"share_kib_s": -1}, "share_kib_s: expected a number >= 0, not -1"),
    ],
)
def test_bounds_that_bound_nothing_are_refused(settings, problem):
    assert [str(it) for it in check_settings(LogService.Settings, settings)] == [problem]


def test_a_log_file_that_cannot_be_opened_is_told_once_and_written_as_soon_as_it_can_be(fleet, tmp_path):
    blocked = tmp_path / "logs"
    blocked.write_text("no directory")
    path = blocked / "a.jsonl"
    agent = fleet.start("a", tasks={"Careful": Careful}, services=log_of(file=str(path)))
    fleet.run_for(20.0)
    (told,) = [line for line in agent.lines("error") if "log file" in line]
    assert told.startswith(f"the log file {path} cannot be written: ")
    assert not agent.events("task_failed") and agent.running("log") == ["File"]

    blocked.unlink()
    fleet.run_for(7.0)
    agent.stop()
    (again,) = [line for line in agent.lines("warning") if "log file" in line]
    said = agent.probe.packets(channel="log")
    first = next(number for number, it in enumerate(said) if it.body == LogLine("error", "the wheel is loose at 25"))
    missing = first - 1  # what the service said as it began came before its task listened
    assert again == f"the log file {path} is written again; {missing} lines are missing"
    assert again in texts(path, "a/log/File")
    assert "the wheel is loose at 27" in texts(path, "a/client/Careful")


def test_a_log_file_that_another_program_moves_is_begun_again_and_told(fleet, tmp_path):
    path = tmp_path / "a.jsonl"
    agent = fleet.start("a", tasks={"Careful": Careful}, services=log_of(file=str(path)))
    fleet.run_for(3.5)
    path.rename(tmp_path / "a.jsonl-20261129")
    fleet.run_for(3.0)
    agent.stop()
    told = f"the log file {path} was moved or removed by another program: a new one begins"
    assert agent.lines("warning").count(told) == 1
    assert texts(path, "a/client/Careful")[0] == "the wheel is loose at 4"
    assert texts(tmp_path / "a.jsonl-20261129", "a/client/Careful")[-1] == "the wheel is loose at 3"


def test_a_full_disk_is_told_once_and_the_agent_goes_on():
    with threaded_agent("a", tasks={"Chatty": Chatty}, services=log_of(file="/dev/full"), speed=20.0) as agent:
        told = agent.wait_for_event("task_started", task="Chatty")
        assert told["service"] == "client"
        agent.wait_until(lambda: any("cannot be written: No space left on device" in it for it in agent.lines("error")))
        agent.wait_until(lambda: len(agent.lines("info")) > 5000)
        assert agent.ask(Stop("Chatty")).ok
        assert len([line for line in agent.lines("error") if "log file" in line]) == 1
        assert not agent.events("task_failed")


def test_a_pipe_as_log_file_is_told_and_the_agent_ends_as_ever(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with threaded_agent("a", tasks={"Careful": Careful}, services=log_of(file=str(tmp_path / "pipe"))) as agent:
        agent.wait_until(lambda: any("cannot be written: it is a pipe" in it for it in agent.lines("error")))
        assert agent.ask(Stop("Careful")).ok


def test_where_the_file_goes_and_how_large_it_becomes_may_be_changed_while_it_runs(fleet, tmp_path):
    path, other = tmp_path / "a.jsonl", tmp_path / "b.jsonl"
    agent = fleet.start("a", tasks={"Careful": Careful}, services=log_of(file=str(path)))
    fleet.run_for(2.5)
    assert agent.ask(Configure("log/File", {"path": str(other), "files": 2, "limit_mib": 0.0001})).ok
    fleet.run_for(3.0)
    assert texts(path, "a/client/Careful")[-1] == "the wheel is loose at 2"
    assert sorted(found.name for found in tmp_path.iterdir()) == ["a.jsonl", "b.jsonl", "b.jsonl.1"]
    assert texts(other, "a/client/Careful") or texts(tmp_path / "b.jsonl.1", "a/client/Careful")


def test_what_was_left_out_is_told_5_s_after_it_began_each_time_also_where_nothing_follows(fleet, tmp_path):
    path = tmp_path / "a.jsonl"
    agent = fleet.start("a", services=log_of(file=str(path), share_kib_s=0.01))
    for times in (1, 2):
        fleet.run_for(1.0)
        for number in range(10):
            agent.publish("log", LogLine("info", f"line {number} {'x' * 100}"))
        fleet.run_for(4.9)
        assert len(texts(path, "a/test/Probe")) == 2 * times - 1
        fleet.run_for(0.2)
        told = texts(path, "a/test/Probe")
        assert len(told) == 2 * times and told[-1] == "9 more lines in the last 5 s were left out"


def test_4096_lines_wait_for_a_slow_disk_and_the_oldest_of_more_are_lost(fleet, tmp_path):
    path = tmp_path / "a.jsonl"
    agent = fleet.start("a", services=log_of(file=str(path), share_kib_s=0))
    for number in range(4097):
        agent.publish("log", LogLine("info", f"line {number}"))
    fleet.run_for(1.0)
    assert texts(path, "a/test/Probe") == [f"line {number}" for number in range(1, 4097)]


@pytest.mark.parametrize(("size", "lines"), [(5 * 1024 - 1, 2), (5 * 1024, 1)])
def test_a_share_of_1_kib_is_5_kib_in_5_s(size, lines, fleet, tmp_path):
    path = tmp_path / "a.jsonl"
    agent = fleet.start("a", services=log_of(file=str(path), share_kib_s=1))
    fleet.run_for(1.0)
    agent.publish("log", LogLine("info", "empty"))
    fleet.run_for(6.0)
    around = len(path.read_text(encoding="utf-8").splitlines()[-1]) - len("empty")
    agent.publish("log", LogLine("info", "x" * (size - around)))
    agent.publish("log", LogLine("info", "more"))
    fleet.run_for(0.1)
    assert texts(path, "a/test/Probe")[1:] == ["x" * (size - around), "more"][:lines]


def test_a_line_that_could_not_be_written_takes_nothing_of_the_share(fleet, tmp_path):
    blocked = tmp_path / "logs"
    blocked.write_text("no directory")
    path = blocked / "a.jsonl"
    agent = fleet.start("a", services=log_of(file=str(path), share_kib_s=0.0001))
    fleet.run_for(6.0)
    for number in range(3):
        agent.publish("log", LogLine("info", f"line {number}"))
    fleet.run_for(0.1)
    blocked.unlink()
    fleet.run_for(5.0)
    agent.publish("log", LogLine("info", "line 3"))
    fleet.run_for(0.1)
    assert texts(path, "a/test/Probe") == ["line 3"]
