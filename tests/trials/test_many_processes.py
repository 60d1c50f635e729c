"""The benchmarks with many processes and beside peers, and the turns in which all sides are measured."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from benchmarks import crowd
from benchmarks.figure import Figure, Plan, in_turns, in_turns_of_all
from benchmarks.peer_environments import SCRIPTS, Peer, PeerMissing, python_of
from benchmarks.peer_runs import pair


def test_any_number_of_sides_is_measured_in_turns_each_beginning_once():
    order = ""

    def side(name: str) -> list[float]:
        nonlocal order
        order += name
        return [1.0]

    runs: dict[str, list[float]] = {name: [] for name in "abc"}
    sides = [(lambda name=name: side(name), [runs[name]]) for name in "abc"]
    in_turns_of_all(Plan(rounds=3), sides, [Figure("x", "s", "max", 1.0, runs["a"], runs["b"])])
    assert order == "abcbcacab"


@pytest.mark.parametrize(("differs_by", "rounds"), [(1.0, 5), (2.0, 9)])
def test_where_the_rounds_differ_much_there_are_more_of_them(differs_by: float, rounds: int):
    values = iter([1.0, differs_by] * 9)
    plan = Plan(rounds=5, most_rounds=9)
    (figure,) = in_turns(plan, [Figure("x", "s", wanted=2.0)], lambda: [next(values)], lambda: [1.0])
    assert len(figure.runs) == len(figure.bare_runs) == rounds


def test_in_a_crowd_all_that_is_sent_arrives_and_what_is_lost_is_an_error():
    shape = crowd.Shape("few", range(3), range(3), False, 600)
    reports = crowd.pancakes(shape, 600)
    assert shape.deliveries == 3600 == sum(report["received"] for report in reports.values())
    assert crowd.rate(shape, 600, reports) > 0
    reports[1]["received"] -= 1
    with pytest.raises(RuntimeError, match="1199 of 1200 packets arrived at member 1"):
        crowd.rate(shape, 600, reports)


def test_a_peer_that_cannot_be_had_is_named_with_what_to_do_about_it():
    peer = Peer("nowhere", SCRIPTS / "over_nowhere.py", ("no_module_of_this_name",), hint="build it yourself")
    with pytest.raises(PeerMissing, match="no_module_of_this_name.*build it yourself"):
        python_of(peer)


@pytest.mark.parametrize("lost", [0, 1])
def test_a_peer_tells_what_it_measured_and_what_it_lost_is_an_error(tmp_path: Path, lost: int):
    script = tmp_path / "over_nothing.py"
    script.write_text(f"""
import sys
sys.path.insert(0, {str(SCRIPTS)!r})
from talk import BODY, KIND, encode, hear, say, unpack
if sys.argv[1] == "far":
    say(at="here")
else:
    plan = hear()
    packet = unpack(encode("load", plan["packets"], bytes(plan["size"])))
    assert packet[KIND] == "load" and len(packet[BODY]["data"]) == 64
    say(times_s=[], per_s=7.0, received=packet[BODY]["number"] - {lost}, near=sys.argv[2])
hear()
""")
    peer = Peer("nothing", script, ())
    if lost:
        with pytest.raises(RuntimeError, match="99 of 100 packets arrived over nothing"):
            pair(peer, Path(sys.executable), 10, 100, 64)
    else:
        report = pair(peer, Path(sys.executable), 10, 100, 64)
        assert (report["per_s"], report["received"], report["near"]) == (7.0, 100, "here")
