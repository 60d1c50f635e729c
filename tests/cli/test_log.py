"""`pancakes log`: the past log lines and events of agents, and new ones with `--follow`."""

from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import pytest
from cli.live_output import LiveOutput, on_a_terminal
from cli.processes import Rig, Running

from pancakes.tools.cli.verbs.log import Known, wants, words_of

SOURCE = """
from pancakes.task import Task, every

class Talk(Task):
    n = 0

    @every(hz=20)
    def speak(self, tick):
        self.n += 1
        self.log("debug", f"whisper {self.n}")
        self.log("info", f"word {self.n}")
        if self.n == 1:
            self.log("warning", "a warning")
            self.log("error", "an error")
            self.event("spoke", word="hello")

class Chatter(Task):
    def on_start(self):
        for n in range(1800):
            self.log("info", f"{n} " + "x" * 150)
"""
ENTRY_POINTS = "[pancakes.tasks]\ntalk.Talk = plugin_talk:Talk\ntalk.Chatter = plugin_talk:Chatter\n"
TALK = '[task.Talk]\ntype = "talk.Talk"\n'
QUIET = '[task.Talk]\ntype = "talk.Talk"\nrate_hz = 0.2\n'

Start = Callable[..., LiveOutput]


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Rig, Running]]:
    """An agent that logs all the time, and a quiet one whose mission began later; no test changes them."""
    with closing(Rig(tmp_path_factory.mktemp("shared"))) as rig:
        rig.install("talk", ENTRY_POINTS, SOURCE)
        agent = rig.ready("a", TALK)
        agent.hear("word 3")
        rig.ready("b", QUIET).hear("a warning")
        yield rig, agent


def records(rig: Rig, *arguments: str) -> list[dict[str, Any]]:
    return rig.listed("log", *arguments)


def test_log_shows_the_past(shared: tuple[Rig, Running]):
    rig, _ = shared
    found = records(rig, "a", "--level", "debug")
    spoke = next(record for record in found if record["kind"] == "spoke")
    assert (spoke["agent"], spoke["source"], spoke["word"]) == ("a", "a/client/Talk", "hello")
    assert "entry" not in spoke
    lines = [record["text"] for record in found if record["source"] == "a/client/Talk" and record["kind"] == "line"]
    assert lines[:6] == ["whisper 1", "word 1", "a warning", "an error", "whisper 2", "word 2"]
    assert any(record["kind"] == "ready" for record in found)
    assert {record["agent"] for record in records(rig, "b")} == {"b"}


def test_log_filters(shared: tuple[Rig, Running]):
    rig, agent = shared
    talk = ("--from", "a/client")  # the kernel warns where a busy machine holds its threads
    assert [record["text"] for record in records(rig, "--level", "error", *talk)] == ["an error"]
    assert [record["kind"] for record in records(rig, "a", "--grep", "spoke word=h.llo")] == ["spoke"]
    assert records(rig, "--from", "a/client/Tal") == []
    lines = rig.pancakes("log", "--level", "warning", *talk).stdout.splitlines()
    assert [line.split(None, 1)[1] for line in lines] == [
        "warning a/client/Talk: a warning",
        "error   a/client/Talk: an error",
    ]
    if not any("word 40" in line for line in agent.said):
        agent.hear("word 40")
    found = records(rig, "--since", "500ms", *talk)
    assert 5 <= len(found) <= 15
    assert not any(record["kind"] == "spoke" for record in found)


def test_log_merges_agents_by_time(shared: tuple[Rig, Running]):
    """The mission of b began later, so its times are smaller."""
    rig, _ = shared
    told = [f"{record['agent']} {words_of(record)}" for record in records(rig)]
    assert told.index("a word 3") < told.index("b ready") < len(told) - 1
    assert [line for line in told[told.index("b spoke word=hello") :] if line.startswith("a word")]


def test_log_colours_levels_only_on_a_terminal(shared: tuple[Rig, Running]):
    rig, _ = shared
    code, shown = on_a_terminal(rig, 24, 100, "log", "-f", "a", "--level", "warning", until=b"an error")
    assert code == 0
    assert "\x1b[33m" in shown.partition("a warning")[0].rpartition("\n")[2]
    assert "\x1b[31m" in shown.partition("an error")[0].rpartition("\n")[2]
    assert "\x1b" not in rig.pancakes("log").stdout


def test_log_follow_neither_loses_nor_repeats(shared: tuple[Rig, Running]):
    rig, _ = shared
    with closing(LiveOutput(rig, "log", "-f", "a", "--from", "a/client", "--grep", "word [0-9]")) as log:
        numbers = [int(log.line("word").rpartition(" ")[2])]
        numbers += [int(log.line("word").rpartition(" ")[2]) for _ in range(numbers[0] + 60)]
        assert numbers == list(range(1, len(numbers) + 1))
        assert (log.interrupt(), log.said) == (0, [])
        assert not any(" b/" in line for line in log.printed)

    with closing(LiveOutput(rig, "log", "-f", "--since", "200ms", "--from", "a/client", "--format", "json")) as log:
        record = log.record('"word ')
        assert (record["kind"], record["level"]) == ("line", "info"), "one object a line"
        assert log.interrupt() == 0


def test_long_log_is_read_in_pages(rig: Rig):
    rig.install("talk", ENTRY_POINTS, SOURCE)
    rig.ready("a", '[task.Chatter]\ntype = "talk.Chatter"\n')
    said = [record["text"] for record in records(rig, "--from", "a/client/Chatter")]
    assert [int(text.partition(" ")[0]) for text in said] == list(range(1800))


LIAR = """
from pancakes.events import Event, LogLine
from pancakes.task import Task, every

class Liar(Task):
    n = 0

    @every(hz=5)
    def lie(self, tick):
        self.n += 1
        self.publish("log", LogLine("loud", f"lie {self.n}"), to="*")
        fields = {"agent": "b", "source": "b/kernel", "t_s": "late", "entry": "none", "kind": 7, "n": self.n}
        self.publish("log", Event("line", fields), to="*")
        self.publish("log", Event("command_refused", {}), to="*")
"""


def test_log_ignores_other_agents_on_the_channel(rig: Rig, start: Start):
    rig.install("talk", ENTRY_POINTS, SOURCE)
    rig.install("liar", "[pancakes.tasks]\nliar.Liar = plugin_liar:Liar\n", LIAR)
    heard = rig.ready("b", TALK)
    rig.ready("a", '[task.Liar]\ntype = "liar.Liar"\n', agent=f'peers = ["{rig.address(heard)}"]')
    heard.hear("lie 2")  # it is remembered by b before the command asks

    log = start("log", "-f", "b", "--format", "json")
    first = log.record("lie 2")
    assert (first["agent"], first["source"], first["level"]) == ("a", "a/client/Liar", "loud")
    claimed = log.record('"kind":"line","agent_"')
    assert (claimed["source"], claimed["source_"], claimed["kind_"]) == ("a/client/Liar", "b/kernel", 7)
    word = int(log.record('"word ')["text"].partition(" ")[2])
    log.line(f"word {word + 20}")
    assert log.interrupt() == 0
    heard.hear("lie 8")

    found = [record for record in records(rig, "b", "--level", "debug") if "lie " in record.get("text", "")]
    numbers = [int(record["text"].split()[1]) for record in found]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert "lie 8" in rig.pancakes("log", "b").stdout


def test_log_includes_agents_that_start_later_or_again(rig: Rig, start: Start):
    rig.install("talk", ENTRY_POINTS, SOURCE)
    rig.ready("a", TALK).hear("word 3")
    log = start("log", "-f", "--grep", "spoke|ready")
    log.line("a/kernel: ready")

    other = rig.ready("b", QUIET)
    log.line("b/kernel: ready")
    log.line("b/client/Talk: spoke")
    log.hear("b is here")

    other.process.kill()
    log.hear("b is away: waiting for it to come back")
    rig.ready("b", QUIET)
    log.line("b/kernel: ready")
    log.line("b/client/Talk: spoke")
    assert log.interrupt() == 0
    a_said = [line.rpartition("/")[2] for line in log.printed if " a/" in line]
    assert a_said == ["kernel: ready", "Talk: spoke word=hello"]


def test_log_reports_an_agent_without_its_log_service(rig: Rig):
    rig.install("talk", ENTRY_POINTS, SOURCE)
    for name in ("a", "b"):
        rig.ready(name, QUIET)
    assert rig.pancakes("service", "stop", "a/log").returncode == 0
    result = rig.pancakes("log")
    assert result.returncode == 0 and result.stderr.startswith("a refuses to show its log: ")
    assert "b/kernel: ready" in result.stdout
    result = rig.pancakes("log", "a")
    assert (result.returncode, result.stdout) == (1, "")


def test_log_level_of_events_and_lines():
    record = {"t_s": 1.0, "agent": "a", "source": "a/client", "kind": "moved", "to": "b", "error": "", "cost": 0}
    assert words_of(record) == "moved to=b cost=0"
    assert wants(record, "info", (), None)
    assert not wants(record, "warning", (), None)


def test_log_shows_repeated_records_once():
    def line(n: int) -> dict[str, Any]:
        return {"t_s": float(n), "agent": "a", "source": "a/client", "kind": "line", "level": "info", "text": str(n)}

    known = Known()
    known.ask([line(1), line(2)])
    assert [known.is_new(line(n)) for n in (1, 2)] == [True, True]
    assert not known.comes(line(2))  # it was said after it was followed and before it was asked for
    assert known.comes(line(3))

    # It was away, has said 4 and 5 meanwhile, and 5 has come since.
    known.ask([line(n) for n in (1, 2, 3, 4, 5)])
    assert [known.is_new(line(n)) for n in (1, 2, 3, 4, 5)] == [False, False, False, True, True]
    assert not known.comes(line(5))
    assert known.comes(line(6))
    # The same again is something else.
    assert known.comes(line(6))
