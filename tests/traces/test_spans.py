"""Spans are made of packets: the same trace on all agents, with the cause as the parent."""

from __future__ import annotations

import pytest

from pancakes.tools.traces.spans import (
    HOLD_S,
    REMEMBERED,
    Heard,
    RootNote,
    SpanMaker,
    is_sampled,
    span_id_of,
    trace_id_of,
)

READING, FILTERED, PLAN, COMMAND = ("a/device/pose", 7), ("a/client/F", 3), ("a/client/P", 4), ("b/client/C", 9)


def heard(key, time_s, cause=None, to="", channel="system", type_="pose"):
    return Heard(time_s, channel, type_, key[0], to, key[1], cause, time_s)


def by_name(spans):
    return {(span.attributes["pancakes.source"], span.attributes["pancakes.number"]): span for span in spans}


def two_agents(ratio=1.0, noted=True):
    """The spans of a reading on a, whose plan becomes a command on b."""
    a, b = SpanMaker("a", ratio), SpanMaker("b", ratio)
    a.hear(heard(READING, 1.0))
    a.hear(heard(FILTERED, 1.1, READING))
    plan = heard(PLAN, 1.2, FILTERED, "b", "network", "plan")
    a.hear(plan)
    b.hear(plan._replace(time_s=51.25))  # its host clock is another one
    b.hear(heard(COMMAND, 51.3, PLAN, "", "ctrl", "motors"))
    for note in a.take_notes(1.3) if noted else ():
        assert note.to == "b"
        b.hear_root(note.packet, note.root)
    return by_name([*a.take_spans(100.0), *b.take_spans(100.0)])


def test_a_reading_and_its_command_elsewhere_are_one_trace_with_causes_as_parents():
    spans = two_agents()
    assert {span.trace_id for span in spans.values()} == {trace_id_of(READING)}
    assert [spans[key].parent_id for key in (READING, FILTERED, PLAN, COMMAND)] == [
        0,
        *map(span_id_of, (READING, FILTERED, PLAN)),
    ]
    assert [spans[key].kind for key in (READING, FILTERED, PLAN, COMMAND)] == [
        "internal",
        "internal",
        "producer",
        "consumer",
    ]
    assert spans[COMMAND].is_parent_elsewhere and spans[COMMAND].attributes["pancakes.command"]
    assert (spans[FILTERED].start_s, spans[FILTERED].end_s) == (1.0, 1.1), "from its cause to itself"
    assert (spans[COMMAND].start_s, spans[COMMAND].end_s) == (51.25, 51.3), "the way between is a gap"


@pytest.mark.parametrize("ratio", [0.0, 0.2, 0.5, 1.0])
def test_all_agents_send_a_trace_or_none_does(ratio):
    for number in range(200):
        key = ("a/device/pose", number)
        a, b = SpanMaker("a", ratio), SpanMaker("b", ratio)
        middle, plan, command = (("a/client/F", number), ("a/client/P", number), ("b/client/C", number))
        sent = heard(plan, 1.2, middle, "b")
        for packet in (heard(key, 1.0), heard(middle, 1.1, key), sent):
            a.hear(packet)
        b.hear(sent)
        b.hear(heard(command, 1.3, plan))
        for note in a.take_notes(1.3):
            b.hear_root(note.packet, note.root)
        assert [len(a.take_spans(9.0)), len(b.take_spans(9.0))] == ([3, 1] if is_sampled(key, ratio) else [0, 0])


def test_the_share_of_sampled_traces_is_the_ratio():
    sampled = sum(is_sampled(("a/device/pose", number), 0.1) for number in range(20_000))
    assert 0.09 < sampled / 20_000 < 0.11


def test_a_first_cause_is_passed_on_over_a_third_agent():
    """On c neither the reading nor the plan of a is known, only what b made of it."""
    b, c = SpanMaker("b", 1.0), SpanMaker("c", 1.0)
    b.hear(heard(PLAN, 1.0, FILTERED, "b"))
    passed = heard(("b/client/X", 1), 1.1, PLAN, "c")
    b.hear(passed)
    assert b.take_notes(1.2) == [], "the note of its cause may be on its way"
    b.hear_root(PLAN, READING)
    assert b.take_notes(1.3) == [RootNote("c", ("b/client/X", 1), READING)]
    c.hear(passed)
    c.hear_root(("b/client/X", 1), READING)
    c.hear(heard(("c/client/C", 1), 1.5, ("b/client/X", 1)))
    (span,) = c.take_spans(9.0)
    assert (span.trace_id, span.parent_id) == (trace_id_of(READING), span_id_of(("b/client/X", 1)))


def test_without_a_note_the_first_packet_that_is_known_of_begins_the_trace():
    spans = two_agents(noted=False)
    assert spans[COMMAND].trace_id == trace_id_of(FILTERED)
    assert spans[COMMAND].parent_id == span_id_of(PLAN)


def test_a_note_is_told_at_last_even_if_the_first_cause_stays_unknown():
    b = SpanMaker("b", 1.0)
    b.hear(heard(PLAN, 1.0, FILTERED, "b"))
    b.hear(heard(("b/client/X", 1), 1.1, PLAN, "*"))
    assert b.take_notes(1.1 + HOLD_S) == [RootNote("*", ("b/client/X", 1), FILTERED)]
    assert b.take_notes(9.0) == []


def test_what_goes_to_a_task_wherever_it_is_is_told_to_all_neighbours():
    a = SpanMaker("a", 1.0)
    a.hear(heard(READING, 1.0))
    a.hear(heard(PLAN, 1.1, READING, "task:b/Fetch"))
    assert [note.to for note in a.take_notes(1.1)] == ["*"]


def test_a_packet_that_is_seen_twice_is_one_span():
    a = SpanMaker("a", 1.0)
    a.hear(heard(READING, 1.0))
    a.hear(heard(READING, 1.1))
    assert len(a.take_spans(9.0)) == 1


def test_a_task_that_answers_itself_makes_no_endless_chain_and_memory_is_bounded():
    a = SpanMaker("a", 1.0)
    for number in range(REMEMBERED + 100):
        a.hear(heard(("a/client/T", number), 1.0, ("a/client/T", number - 1) if number else None))
        a.hear_root(("b/x/y", number), READING)
        if number % 100 == 0:
            a.take_spans(9.0)
    a.take_spans(9.0)
    assert max(len(it) for it in vars(a).values() if hasattr(it, "keys")) == REMEMBERED


def test_a_packet_that_is_its_own_cause_ends_somewhere():
    a = SpanMaker("a", 1.0)
    a.hear(heard(READING, 1.0, READING))
    assert len(a.take_spans(9.0)) == 1
