"""What led to commands: an agent notes it for as long as somebody asks, and tells what was seen on it."""

from typing import Any

import pytest

from pancakes.control import Reply, Traces
from pancakes.devices import Load, Pose, Twist
from pancakes.packet import Packet
from pancakes.services.traces import (
    CHAINS_STEP,
    LARGE_BYTES,
    LEASE_S,
    MOST_QUESTIONS,
    ROWS_STEP,
    STEP,
    TracedPackets,
    Tracing,
)
from pancakes.task import Task, every, on
from pancakes.testing import Fleet

MS = 1_000_000


def heard(traced, ms, source, seq, kind="pose", cause=None, channel="system", body=None):
    body = body if body is not None else Pose(1.0, 2.0, 0.0)
    traced.hear(ms * MS, Packet(channel, kind, source, "", ms / 1000, seq, body, cause))


def reaction(traced, ms, seq):
    heard(traced, ms, "world/client/Mocap", seq, cause=("world/client/World", seq))
    heard(traced, ms + 1, "a/device/pose", seq, cause=("world/client/Mocap", seq))
    heard(traced, ms + 2, "a/device/ir", seq)  # leads to nothing
    heard(traced, ms + 3, "a/client/Scan", seq, "motors", ("a/device/pose", seq), "ctrl", Twist(0.1, 0.0))


def names(answer):
    return [(row[3], row[4]) for row in answer["rows"]]


def test_only_what_led_to_a_command_is_told_and_each_command_once():
    traced = TracedPackets("a")
    reaction(traced, 100, 1)
    first = traced.answer(Traces(), 200 * MS)
    assert names(first) == [("world/client/Mocap", 1), ("a/device/pose", 1), ("a/client/Scan", 1)]
    assert first["rows"][2] == [
        103 * MS, "ctrl", "motors", "a/client/Scan", 1, 0.103, "a/device/pose", 1, "v_mps 0.1, omega_radps 0",
    ]  # fmt: skip
    assert (first["now_ns"], first["until_ns"], first["left_out"]) == (200 * MS, 103 * MS, 0)
    reaction(traced, 300, 2)
    assert names(traced.answer(Traces(first["until_ns"]), 400 * MS))[-1] == ("a/client/Scan", 2)
    assert traced.answer(Traces(303 * MS), 500 * MS)["rows"] == []


def test_a_packet_that_is_heard_twice_is_told_once_with_those_that_come_after_it():
    traced = TracedPackets("a")
    for _ in range(2):
        heard(traced, 1, "world/client/Mocap", 1)
    heard(traced, 2, "a/client/Scan", 1, "motors", ("world/client/Mocap", 1), "ctrl", Twist(0.1, 0.0))
    rows = traced.answer(Traces(), 5 * MS)["rows"]
    assert names({"rows": rows}) == [("world/client/Mocap", 1), ("a/client/Scan", 1)]
    assert rows[0][6:8] == ["", 0] and rows[1][6:8] == ["world/client/Mocap", 1]


def test_packets_that_led_to_commands_elsewhere_are_asked_for_by_name():
    traced = TracedPackets("world")
    heard(traced, 10, "world/client/World", 7, "world_state")
    heard(traced, 11, "world/client/Mocap", 9, cause=("world/client/World", 7))
    answer = traced.answer(Traces(packets=(("world/client/Mocap", 9), ("world/client/Mocap", 10))), 20 * MS)
    assert names(answer) == [("world/client/World", 7), ("world/client/Mocap", 9)]


def test_of_too_many_commands_some_are_told_the_newest_always_and_the_rest_counted():
    traced = TracedPackets("a")
    for seq in range(1, 1001):
        reaction(traced, 4 * seq, seq)
    answer = traced.answer(Traces(most=10), 5000 * MS)
    told = [row[4] for row in answer["rows"] if row[1] == "ctrl"]
    assert told == [100 * n for n in range(1, 11)]
    assert answer["left_out"] == 990
    all_of_them = traced.answer(Traces(most=1000), 5000 * MS)
    told = [row[4] for row in all_of_them["rows"] if row[1] == "ctrl"]
    assert len(all_of_them["rows"]) == 600
    assert all_of_them["left_out"] == 1000 - len(told) > 0


def test_where_there_is_nothing_new_the_next_question_begins_where_this_one_did():
    traced = TracedPackets("a")
    assert [traced.answer(Traces(since_ns), 5)["until_ns"] for since_ns in (7, 0, -7)] == [7, 0, 0]


def test_old_packets_are_forgotten():
    traced = TracedPackets("a")
    reaction(traced, 100, 1)
    assert traced.answer(Traces(), 20_000 * MS)["rows"] == []


def test_what_large_packets_say_is_not_kept():
    traced = TracedPackets("a")
    heard(traced, 1, "a/device/camera", 1, "image", body={"pixels": [0] * LARGE_BYTES})
    traced.answer(Traces(), 2 * MS)
    heard(traced, 3, "a/device/camera", 2, "image", body={"pixels": [0] * LARGE_BYTES})
    heard(traced, 4, "a/client/Scan", 1, "motors", ("a/device/camera", 2), "ctrl", Twist(0.1, 0.0))
    image, command = traced.answer(Traces(), 5 * MS)["rows"]
    assert (image[3], image[8]) == ("a/device/camera", "")
    assert command[8] != ""


def test_a_packet_that_cannot_be_shown_does_not_keep_the_others_from_being_told():
    class Broken:
        def __str__(self):
            raise RuntimeError("no words")

    traced = TracedPackets("a")
    heard(traced, 1, "a/device/odd", 1, "odd", body={"what": Broken()})
    heard(traced, 2, "a/client/Scan", 1, "motors", ("a/device/odd", 1), "ctrl", Twist(0.1, 0.0))
    odd, command = traced.answer(Traces(), 5 * MS)["rows"]
    assert odd[8] == "it cannot be shown"
    assert command[8] == "v_mps 0.1, omega_radps 0"
    heard(traced, 6, "a/device/odd", 2, "odd", body={"what": Broken()})
    heard(traced, 7, "a/client/Scan", 2, "motors", ("a/device/odd", 2), "ctrl", Twist(0.1, 0.0))
    odd, _ = traced.answer(Traces(5 * MS), 8 * MS)["rows"]
    assert odd[8] == "", "it is not kept, as it may be large"


def tracing_of(agent: Any) -> Tracing:
    """Returns what the Log Service notes packets with, one of the test's own."""
    return Tracing(agent.component("log"))


class Read(Task):
    @every(hz=10)
    def read(self, tick):
        self.publish("system", Load(0.5))


class Steer(Task):
    @on("system", Load)
    def steer(self, packet):
        self.publish("ctrl", Load(packet.body.cpu))


def test_an_agent_notes_nothing_until_it_is_asked_and_ceases_when_nobody_asks_any_more():
    with Fleet(1) as fleet:
        agent = fleet.start("a", tasks={"Read": Read, "Steer": Steer})
        fleet.run_for(1.0)
        assert agent.ask(Traces()).result["rows"] == []
        fleet.run_for(1.05)
        answer = agent.ask(Traces()).result
        assert [row[2:4] for row in answer["rows"][:2]] == [["load", "a/client/Read"], ["load", "a/client/Steer"]]
        assert len(answer["rows"]) >= 20
        assert 1_500_000_000 in [row[0] for row in answer["rows"]], "in virtual time, from its beginning"
        last = agent.ask(Traces(most=1)).result
        assert [row[1] for row in last["rows"]] == ["system", "ctrl"] and last["left_out"] > 0
        again = agent.ask(Traces(answer["until_ns"])).result
        assert again["rows"] == []
        fleet.run_for(LEASE_S - 1.0)
        assert agent.ask(Traces(answer["until_ns"])).result["rows"] != []
        fleet.run_for(LEASE_S + 0.5)
        assert agent.ask(Traces()).result["rows"] == []


def test_who_asks_no_more_may_say_so_and_others_still_get_answers():
    with Fleet(1) as fleet:
        agent = fleet.start("a", tasks={"Read": Read, "Steer": Steer})
        tracing = tracing_of(agent)
        fleet.run_for(0.5)

        def ask(by):
            told: list[Any] = []
            tracing.answer(Traces(), by, told.append)
            fleet.run_for(0.0)
            (answer,) = told
            return answer["rows"]

        def ask_no_more(by):
            told: list[Any] = []
            tracing.answer(Traces(most=0), by, told.append)
            assert told == [None]

        assert ask("page1") == ask("page2") == []
        fleet.run_for(1.05)
        ask_no_more("page1")
        assert len(ask("page2")) >= 20
        ask_no_more("page2")
        assert ask("page3") == [], "it had ended"


def test_after_the_last_question_no_packet_is_looked_at(monkeypatch):
    looked_at: list[Packet] = []
    monkeypatch.setattr(TracedPackets, "hear", lambda traced, ns, packet: looked_at.append(packet))
    with Fleet(1) as fleet:
        agent = fleet.start("a", tasks={"Read": Read, "Steer": Steer})
        assert agent.ask(Traces()).ok
        fleet.run_for(1.0)
        assert {packet.channel for packet in looked_at} >= {"system", "ctrl"}
        agent.ask(Traces(most=0))
        looked_at.clear()
        fleet.run_for(1.0)
        assert looked_at == []


def test_an_answer_is_found_in_short_steps():
    traced = TracedPackets("a")
    for seq in range(1, STEP + 1):
        reaction(traced, 4 * seq, seq)
    steps = list(traced.answering(Traces(), 5000 * MS))
    taken, chains, told = 4 * STEP, STEP, 3 * STEP
    assert len(list(traced.answering(Traces(most=1), 5000 * MS))) == 3 + 1 + 1, "one row is a step of its own"
    before_and_after = 4
    assert len(steps) == taken // STEP + chains // CHAINS_STEP + told // ROWS_STEP + before_and_after


def test_other_tasks_have_their_turns_while_an_answer_is_found():
    with Fleet(1) as fleet:
        agent = fleet.start("a", tasks={"Read": Read, "Steer": Steer})
        tracing = tracing_of(agent)
        told: list[Any] = []
        turns: list[str] = []
        tracing.answer(Traces(), "page", told.append)
        fleet.run_for(1.0)
        for number in range(4 * STEP):
            agent.publish("system", Load(number / 1000))
        tracing.answer(Traces(), "page", lambda answer: turns.append("answer"))
        log = agent.component("log")
        assert log is not None
        log.call(lambda: turns.append("another"))
        fleet.run_for(0.0)
        assert turns == ["another", "answer"]


def test_who_asks_faster_than_answers_are_found_is_refused():
    with Fleet(1) as fleet:
        agent = fleet.start("a", tasks={"Read": Read, "Steer": Steer})
        asked = [agent.publish("sysctrl", Traces(), to="a").seq for _ in range(2 * MOST_QUESTIONS)]
        fleet.run_for(1.0)
        replies = {packet.cause[1]: packet.body for packet in agent.probe.packets(Reply) if packet.cause is not None}
        assert sorted(replies) == asked
        refused = [reply.reason for reply in replies.values() if not reply.ok]
        assert refused and all(f"{MOST_QUESTIONS} questions" in reason for reason in refused)
        assert agent.ask(Traces()).ok


def test_who_waits_for_an_answer_gets_it_when_the_service_stops():
    with Fleet(1) as fleet:
        agent = fleet.start("a", tasks={"Read": Read, "Steer": Steer})
        tracing = tracing_of(agent)
        told: list[Any] = []
        tracing.answer(Traces(), "page", lambda answer: None)
        fleet.run_for(2.0)
        for _ in range(2):
            tracing.answer(Traces(), "page", told.append)
        tracing.end()
        assert [len(answer["rows"]) >= 20 for answer in told] == [True, True]


def test_one_that_asks_right_after_the_end_gets_an_answer_and_the_service_goes_on():
    with Fleet(1) as fleet:
        agent = fleet.start("a", tasks={"Read": Read, "Steer": Steer})
        log, tracing = agent.component("log"), tracing_of(agent)
        told: list[Any] = []
        for _ in range(3):
            tracing.answer(Traces(), "page", told.append)
            tracing.end()
        tracing.answer(Traces(), "page", told.append)
        fleet.run_for(0.1)
        assert [answer["rows"] for answer in told] == [[], [], [], []]
        assert agent.component("log") is log


def test_what_small_packets_say_is_kept_however_many_of_their_type_have_come():
    traced = TracedPackets("a")
    reaction(traced, 100, 1)
    traced.answer(Traces(), 200 * MS)
    reaction(traced, 300, 2)
    told = [row[8] for row in traced.answer(Traces(200 * MS), 400 * MS)["rows"]]
    assert told == ["x_m 1, y_m 2, theta_rad 0", "x_m 1, y_m 2, theta_rad 0", "v_mps 0.1, omega_radps 0"]


def test_a_command_that_is_forgotten_is_not_counted_as_left_out():
    traced = TracedPackets("a")
    reaction(traced, 100, 1)
    reaction(traced, 9_000, 2)
    answer = traced.answer(Traces(most=1), 9_100 * MS)
    assert names(answer)[-1] == ("a/client/Scan", 2) and answer["left_out"] == 0


def test_between_two_questions_the_newest_20_000_packets_are_noted():
    traced = TracedPackets("a")
    for seq in range(20_001):
        heard(traced, 1, "a/device/pose", seq)
    asked = Traces(packets=(("a/device/pose", 0), ("a/device/pose", 1)))
    assert names(traced.answer(asked, 2 * MS)) == [("a/device/pose", 1)]


def test_a_packet_is_known_for_8_s():
    traced = TracedPackets("a")
    heard(traced, 100, "a/client/Scan", 1, "motors", None, "ctrl", Twist(0.1, 0.0))
    assert names(traced.answer(Traces(), 8_100 * MS)) == [("a/client/Scan", 1)]
    assert names(traced.answer(Traces(), 8_101 * MS)) == []


@pytest.mark.parametrize(("count", "more_steps"), [(0, 0), (STEP - 1, 0), (STEP, 1), (2 * STEP, 2)])
def test_old_packets_are_forgotten_in_short_steps_and_a_few_in_none_of_their_own(count, more_steps):
    traced = TracedPackets("a")
    for seq in range(count):
        heard(traced, 1, "a/device/pose", seq)
    traced.answer(Traces(), 2 * MS)
    at_rest = len(list(TracedPackets("a").answering(Traces(), 20_000 * MS)))
    assert len(list(traced.answering(Traces(), 20_000 * MS))) == at_rest + more_steps


def test_packets_are_noted_for_10_s_after_the_last_question():
    with Fleet(1) as fleet:
        agent = fleet.start("a", tasks={"Read": Read, "Steer": Steer})
        assert agent.ask(Traces()).result["rows"] == []
        fleet.run_for(9.5)
        assert agent.ask(Traces()).result["rows"] != []
        fleet.run_for(10.5)
        assert agent.ask(Traces()).result["rows"] == []
