"""`pancakes log`: what agents have said and done, and what they say while it is looked."""

import json
from collections.abc import Callable
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
TALK = '[task.Talk]\ntype = "talk.Talk"\n'
QUIET = '[task.Talk]\ntype = "talk.Talk"\nrate_hz = 0.2\n'

Start = Callable[..., LiveOutput]


@pytest.fixture
def talk(rig: Rig) -> None:
    rig.install("talk", "[pancakes.tasks]\ntalk.Talk = plugin_talk:Talk\ntalk.Chatter = plugin_talk:Chatter\n", SOURCE)


@pytest.fixture
def agent(rig: Rig, talk: None) -> Running:
    agent = rig.ready("a", TALK)
    agent.hear("word 3")
    return agent


def records(rig: Rig, *arguments: str) -> list[dict[str, Any]]:
    """Runs `pancakes log` to its end."""
    result = rig.pancakes("log", *arguments, "--format", "json")
    assert result.returncode == 0, result.stderr
    found: list[dict[str, Any]] = json.loads(result.stdout)
    return found


def test_what_was_said_is_still_known(rig: Rig, agent: Running):
    found = records(rig, "--level", "debug")

    spoke = next(record for record in found if record["kind"] == "spoke")
    assert {key: spoke[key] for key in ("agent", "source", "word")} == {
        "agent": "a",
        "source": "a/client/Talk",
        "word": "hello",
    }
    lines = [record["text"] for record in found if record["source"] == "a/client/Talk" and record["kind"] == "line"]
    assert lines[:6] == ["whisper 1", "word 1", "a warning", "an error", "whisper 2", "word 2"]
    assert any(record["kind"] == "ready" for record in found)
    assert "entry" not in spoke


def test_only_what_was_asked_for_is_shown(rig: Rig, agent: Running):
    talk = ("--from", "a/client")  # the kernel warns where a busy machine holds its threads
    assert [record["text"] for record in records(rig, "--level", "warning", *talk)] == ["a warning", "an error"]
    assert [record["text"] for record in records(rig, "--level", "error", *talk)] == ["an error"]
    assert {record["source"] for record in records(rig, "--from", "a/kernel")} == {"a/kernel"}
    assert [record["kind"] for record in records(rig, "--grep", "spoke word=h.llo")] == ["spoke"]
    assert records(rig, "--from", "a/client/Tal") == []


def test_since_counts_back_from_now(rig: Rig, agent: Running):
    agent.hear("word 40")
    found = records(rig, "--since", "500ms", "--from", "a/client")
    assert 5 <= len(found) <= 15
    assert not any(record["kind"] == "spoke" for record in found)


def test_a_line_is_for_people(rig: Rig, agent: Running):
    lines = rig.pancakes("log", "--level", "warning", "--from", "a/client").stdout.splitlines()

    assert [line.split(None, 1)[1] for line in lines] == [
        "warning a/client/Talk: a warning",
        "error   a/client/Talk: an error",
    ]


def test_on_a_terminal_levels_have_colours(rig: Rig, agent: Running):
    code, shown = on_a_terminal(rig, 24, 100, "log", "-f", "--level", "warning", until=b"an error")

    assert code == 0
    assert "\x1b[33m" in shown.partition("a warning")[0].rpartition("\n")[2]
    assert "\x1b[31m" in shown.partition("an error")[0].rpartition("\n")[2]
    assert "\x1b" not in rig.pancakes("log").stdout


def test_more_than_fits_one_packet_comes_in_pages(rig: Rig, talk: None):
    rig.ready("a", '[task.Chatter]\ntype = "talk.Chatter"\n')

    said = [record["text"] for record in records(rig, "--from", "a/client/Chatter")]

    assert [int(text.partition(" ")[0]) for text in said] == list(range(1800))


def test_agents_are_merged_by_when_it_was_said(rig: Rig, agent: Running):
    second = rig.ready("b", QUIET)  # its mission began later, so its times are smaller
    agent.hear("word")
    second.hear("a warning")

    found = records(rig)

    told = [f"{record['agent']} {words_of(record)}" for record in found]
    assert told.index("a word 3") < told.index("b ready") < len(told) - 1  # it was said before b was there,
    assert [line for line in told[told.index("b spoke word=hello") :] if line.startswith("a word")]  # and goes on since
    assert {record["agent"] for record in records(rig, "b")} == {"b"}


def test_it_goes_on_and_nothing_is_lost_or_doubled(agent: Running, start: Start):
    log = start("log", "-f", "--from", "a/client", "--grep", "word [0-9]")
    numbers = [int(log.line("word").rpartition(" ")[2]) for _ in range(60)]

    assert numbers == list(range(1, 61))
    assert log.interrupt() == 0
    assert log.said == []


def test_followed_json_is_one_object_a_line(agent: Running, start: Start):
    log = start("log", "-f", "--since", "200ms", "--format", "json")

    assert log.record("word")["kind"] == "line"
    assert log.record("word")["level"] == "info"
    assert log.interrupt() == 0


def test_agents_that_are_started_later_or_again_are_taken_in(rig: Rig, agent: Running, start: Start):
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
    assert [line.rpartition("/")[2] for line in log.printed if " a/" in line] == [
        "kernel: ready",
        "Talk: spoke word=hello",
    ]


def test_only_the_agents_that_were_named_are_followed(rig: Rig, agent: Running, start: Start):
    rig.ready("b", TALK)
    log = start("log", "-f", "b")
    for _ in range(30):
        assert " b/" in log.line()
    assert log.interrupt() == 0


def test_a_log_service_that_stands_still_is_named(rig: Rig, agent: Running):
    rig.ready("b", QUIET)
    assert rig.pancakes("service", "stop", "a/log").returncode == 0

    result = rig.pancakes("log")
    assert result.returncode == 0
    assert result.stderr.startswith("a does not tell what was said: ")
    assert "b/kernel: ready" in result.stdout

    result = rig.pancakes("log", "a")
    assert (result.returncode, result.stdout) == (1, "")


def test_who_is_not_there_is_told(rig: Rig, agent: Running):
    assert rig.pancakes("log", "b").stderr == "there is no agent 'b', only a\n"
    assert rig.pancakes("log", "b", "-f").returncode == 3


@pytest.mark.parametrize("arguments", [("--grep", "a(b"), ("--level", "loud"), ("--since", "ever")])
def test_what_cannot_be_read_is_exit_code_2(rig: Rig, arguments: tuple[str, ...]):
    assert rig.pancakes("log", *arguments).returncode == 2


def test_it_has_help_with_an_example(rig: Rig):
    assert "pancakes log -f" in rig.pancakes("log", "--help").stdout.partition("Example:")[2]


def test_an_event_counts_as_info_and_reads_as_a_line():
    record = {"t_s": 1.0, "agent": "a", "source": "a/client", "kind": "moved", "to": "b", "error": "", "cost": 0}

    assert words_of(record) == "moved to=b cost=0"
    assert wants(record, "info", (), None)
    assert not wants(record, "warning", (), None)


def test_what_comes_in_two_ways_is_shown_once():
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
