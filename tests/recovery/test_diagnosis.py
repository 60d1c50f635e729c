"""What `pancakes task recover` makes of what agents report: no agents, only tables."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from pancakes.tools.recovery.diagnosis import (
    Actuator,
    Checkpoint,
    Copy,
    Diagnosis,
    Findings,
    Guard,
    TakeOver,
    diagnose,
)

RUNS = Copy(agent="a", state="running", linked=("b", "c"))
DISPUTED = Copy(agent="a", state="stopped", rest="disputed", other="b", may_run=True)
DISK_LOST = Copy(agent="a", state="stopped", rest="disk lost", reason="b owns a/Scan", may_run=True, may_leave=True)
IN_DOUBT = Copy(agent="a", service="", in_doubt=True, other="b", may_run=True)
DAMAGED = Copy(agent="a", state="stopped", waits=True, reason="it may run elsewhere", may_run=True, may_leave=True)
WAITS = Copy(agent="a", state="stopped", rest="waits → b", waits=True, reason="a/Scan waits to hear from b")
MOVED = Copy(agent="a", state="stopped", rest="moved → b", reason="handed over to b")
PAUSED = replace(RUNS, permit=False)
GUARDIANS = (("a", "b", "c"),)
OWN = Guard("a", "a", 3, 2.0, 0.1)
SILENT = Guard("b", "a", 3, None, 9.0)


def held(agent: str, no: int = 7, guardians: tuple[tuple[str, ...], ...] = GUARDIANS) -> Checkpoint:
    return Checkpoint(agent, (3, "a"), no, f"checkpoint 3@a/{no}, held by {agent}", guardians)


def on(copy: Copy, agent: str, **others: object) -> Copy:
    return replace(copy, agent=agent, **others)


def found(*copies: Copy, answers: str = "abc", asked: str = "a", **others: object) -> Findings:
    return Findings(task_id="a/Scan", asked=asked, answers=tuple(answers), copies=copies, **others)  # type: ignore[arg-type]


CASES = {
    "runs": (found(RUNS), "", "", ""),
    "runs, and is stopped elsewhere": (found(RUNS, on(RUNS, "b", state="stopped")), "", "", ""),
    "two owners, one runs": (found(DISPUTED, on(RUNS, "b")), "two owners", "keep", "b"),
    "two owners, the other is away": (found(DISPUTED, answers="ac"), "two owners", "keep", "a"),
    "two owners of one epoch": (found(DISPUTED, on(DISPUTED, "b", other="a")), "two owners", "", ""),
    "two owners, not linked": (found(RUNS, on(RUNS, "b")), "two owners", "", ""),
    "disk lost, it runs elsewhere": (found(DISK_LOST, on(RUNS, "b")), "lost disk", "leave", "a"),
    "disk lost, it runs nowhere": (found(DISK_LOST), "lost disk", "adopt", "a"),
    "disk lost, its agent decides nothing": (found(replace(DISK_LOST, may_run=False)), "lost disk", "", ""),
    "damaged, it runs elsewhere": (found(DAMAGED, on(RUNS, "b")), "damaged record", "leave", "a"),
    "damaged, it runs nowhere": (found(DAMAGED), "damaged record", "adopt", "a"),
    "old copy": (found(replace(DISK_LOST, rest="old copy")), "restored backup", "adopt", "a"),
    "in doubt, the other is away": (found(IN_DOUBT, answers="ac"), "in doubt", "adopt", "a"),
    "in doubt, both answer": (found(IN_DOUBT), "in doubt", "", ""),
    "in doubt, both are linked": (found(replace(IN_DOUBT, linked=("b",)), answers="ac"), "in doubt", "", ""),
    "in doubt, but it runs": (found(on(RUNS, "b"), replace(IN_DOUBT, may_leave=True)), "", "", ""),
    "in doubt of a lost robot, but it runs": (
        found(RUNS, on(IN_DOUBT, "c", other="x", may_leave=True)),
        "in doubt",
        "leave",
        "c",
    ),
    "waits for others": (found(WAITS), "waits", "", ""),
    "forgotten": (found(replace(DISK_LOST, rest="forgotten")), "", "", ""),
    "given up": (found(Copy(agent="a", state="failed", reason="ValueError: x")), "given up", "start", "a"),
    "given up before a restart": (found(Copy(agent="a", state="stopped", rest="failed")), "given up", "start", "a"),
    "cannot start": (found(Copy(agent="a", state="stopped", waits=True, reason="no motors")), "cannot start", "", ""),
    "given up, and guarded": (found(Copy(agent="a", state="failed"), guards=(OWN,)), "given up", "start", "a"),
    "stopped by a person": (found(Copy(agent="a", state="stopped", rest="stopped")), "", "", ""),
    "guardians gone, the owner is there": (
        found(PAUSED, checkpoints=(held("a"),), answers="ad"),
        "guardians gone",
        "resume",
        "a",
    ),
    "guardians answer, but not the owner": (
        found(PAUSED, checkpoints=(held("a"), held("b"))),
        "guardians gone",
        "",
        "",
    ),
    "guardians gone, and the owner": (
        found(guards=(SILENT,), checkpoints=(held("b"),), able="d", answers="bd"),
        "guardians gone",
        "revive",
        "d",
    ),
    "guardians gone, and nobody can run it": (
        found(guards=(SILENT,), checkpoints=(held("b"),), unable="b cannot", answers="b"),
        "guardians gone",
        "",
        "",
    ),
    "owner silent, guardians take over": (
        found(
            guards=(SILENT, replace(SILENT, agent="c")),
            checkpoints=(held("b"), held("c")),
            take_over=TakeOver("b", "c", "checkpoint 3@a/7"),
        ),
        "silent owner",
        "take",
        "b",
    ),
    "owner silent, no agent takes it": (
        found(
            guards=(SILENT, replace(SILENT, agent="c")),
            checkpoints=(held("b"), held("c")),
            take_over=TakeOver("b", refusal="none bids"),
            able="d",
        ),
        "silent owner",
        "",
        "",
    ),
    "owner silent, its lease runs": (found(guards=(replace(SILENT, lease_left_s=2.0),)), "silent owner", "", ""),
    "owner heard by its guardians only": (found(guards=(Guard("b", "a", 3, 2.0, 0.1),), answers="b"), "", "", ""),
    "copied disk": (found(replace(PAUSED, copied=True), checkpoints=(held("a"),)), "copied disk", "resume", "a"),
    "copied disk, guardians take over": (
        found(replace(PAUSED, copied=True), take_over=TakeOver("b", "b", "checkpoint 3@a/7")),
        "copied disk",
        "take",
        "b",
    ),
    "given to an agent that is away": (found(replace(MOVED, rest="moved → x")), "lost agent", "", ""),
    "given to an agent that lacks it": (found(replace(MOVED, may_run=True)), "lost disk", "adopt", "a"),
    "given away, and configured nowhere": (found(MOVED), "lost disk", "", ""),
    "given on to an agent that is away": (found(MOVED, on(MOVED, "b", rest="moved → x")), "lost agent", "", ""),
    "given in a circle": (found(MOVED, on(MOVED, "b", rest="moved → a")), "lost disk", "", ""),
    "its agent is lost, another can run it": (
        found(checkpoints=(held("b", guardians=()),), able="b", answers="bc"),
        "lost agent",
        "revive",
        "b",
    ),
    "nobody knows it": (found(answers="ab"), "unknown", "", ""),
    "nobody knows it, and its agent is away": (found(answers="bc"), "lost agent", "", ""),
    "an actuator refuses it": (
        found(RUNS, actuators=(Actuator("b", "device/wheels", "7@z", "z", "a", "3@a"),)),
        "disobeyed",
        "obey",
        "a",
    ),
    "an actuator has refused a higher epoch": (
        found(RUNS, actuators=(Actuator("b", "device/wheels", "3@a", "a", "a", "9@a", warned=True),)),
        "disobeyed",
        "obey",
        "a",
    ),
    "an actuator awaits its first command": (
        found(RUNS, actuators=(Actuator("b", "device/wheels", "3@a", "a", "a", "9@a"),)),
        "",
        "",
        "",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_diagnosis_names_trouble_and_mildest_act(case: str):
    findings, trouble, act, agent = CASES[case]
    told = diagnose(findings)
    assert (told.trouble, told.proposal.act, told.proposal.agent) == (trouble, act, agent), told
    assert told.what.endswith(".") and told.proposal.text and not told.proposal.text.endswith(".")


@pytest.mark.parametrize("case", CASES)
def test_diagnosis_is_in_order_or_troubled(case: str):
    told = diagnose(CASES[case][0])
    assert told.proposal.fine is (told.trouble == "")
    for one in (told.proposal, *told.choices):
        assert bool(one.command) is bool(one.act), "what the command does, it can be asked for"


HERE = {
    "runs here": (found(RUNS), "", ""),
    "runs elsewhere": (found(on(RUNS, "b")), "", ""),
    "an agent that does not answer": (found(on(RUNS, "b"), asked="x"), "", ""),
    "the paused one of two owners": (found(DISPUTED, on(RUNS, "b")), "keep", "a"),
    "the running one of two owners": (found(DISPUTED, on(RUNS, "b"), asked="b"), "keep", "b"),
    "in doubt": (found(IN_DOUBT), "adopt", "a"),
    "disk lost": (found(DISK_LOST), "adopt", "a"),
    "forgotten": (found(replace(DISK_LOST, rest="forgotten")), "adopt", "a"),
    "waits": (found(WAITS), "start", "a"),
    "stopped": (found(replace(RUNS, state="stopped")), "start", "a"),
    "given to an agent that lacks it": (found(replace(MOVED, may_run=True)), "adopt", "a"),
    "paused here": (found(PAUSED, checkpoints=(held("a"),)), "resume", "a"),
    "paused here, its guardians answer": (found(PAUSED, checkpoints=(held("a"), held("b"))), "", ""),
    "paused elsewhere": (found(PAUSED, guards=(OWN,), asked="d", answers="ad", able="d"), "", ""),
    "its guardians answer": (
        found(guards=(SILENT,), checkpoints=(held("b"), held("c")), asked="d", answers="bcd", able="d"),
        "",
        "",
    ),
    "its guardians hear it": (found(guards=(Guard("b", "a", 3, 2.0, 0.1),), asked="d", answers="bd", able="d"), "", ""),
    "from a checkpoint": (
        found(guards=(SILENT,), checkpoints=(held("b"),), asked="d", answers="bd", able="d"),
        "revive",
        "d",
    ),
    "from scratch": (found(asked="d", answers="bd", able="d", configuration="a.toml"), "begin", "d"),
    "from nothing": (found(asked="d", answers="bd"), "", ""),
    "a class that it lacks": (found(asked="d", answers="bd", unable="d has no class"), "", ""),
}


@pytest.mark.parametrize("case", HERE)
def test_here_runs_the_task_on_the_agent(case: str):
    findings, act, agent = HERE[case]
    proposal = diagnose(findings, "here").proposal
    assert (proposal.act, proposal.agent) == (act, agent), proposal
    assert proposal.fine is (case == "runs here")
    if act:
        assert proposal.command.endswith(f"{agent}/Scan --here")


NOT_HERE = {
    "nothing is here": (found(on(RUNS, "b")), "", "", True),
    "it runs only here": (found(RUNS), "", "", False),
    "an agent that does not answer": (found(RUNS, asked="x"), "", "", False),
    "the paused one of two owners": (found(DISPUTED, on(RUNS, "b")), "keep", "b", False),
    "the running one of two owners": (found(DISPUTED, on(RUNS, "b"), asked="b"), "keep", "a", False),
    "the only owner that answers": (found(DISPUTED, answers="a"), "", "", False),
    "disk lost": (found(DISK_LOST), "leave", "a", False),
    "in doubt": (found(replace(IN_DOUBT, may_leave=True)), "leave", "a", False),
    "moved": (found(MOVED), "", "", True),
    "waits for others": (found(WAITS), "", "", False),
    "cannot start": (found(replace(DAMAGED, may_run=False, may_leave=False)), "", "", False),
}


@pytest.mark.parametrize("case", NOT_HERE)
def test_not_here_gives_up_what_the_agent_has(case: str):
    findings, act, agent, fine = NOT_HERE[case]
    proposal = diagnose(findings, "not here").proposal
    assert (proposal.act, proposal.agent, proposal.fine) == (act, agent, fine), proposal


LOST = {
    "two owners, one runs": "the state of the copy on a",
    "disk lost, it runs nowhere": "all of its former state",
    "disk lost, it runs elsewhere": "",
    "old copy": "what it did since the backup was made",
    "guardians gone, the owner is there": "",
    "given up": "",
    "an actuator refuses it": "",
}


@pytest.mark.parametrize("case", LOST)
def test_proposal_says_what_is_lost(case: str):
    assert diagnose(CASES[case][0]).proposal.lost == LOST[case]


def test_task_of_a_lost_agent_has_a_way_back():
    (here,) = diagnose(found(replace(MOVED, rest="moved → x", may_run=True))).choices
    assert (here.act, here.agent, here.command) == ("adopt", "a", "pancakes task recover a/Scan --here")
    assert "x is off, and never comes back" in here.only_if


def test_start_without_others_loses_what_they_have():
    (here,) = diagnose(found(WAITS)).choices
    assert here.act == "start" and here.lost and here.only_if
    assert WAITS.reason in diagnose(found(WAITS)).what


def test_state_that_runs_nowhere_is_said_to_be_lost():
    told: Diagnosis = diagnose(CASES["damaged, it runs nowhere"][0])
    (drop,) = told.choices
    assert drop.act == "leave" and "if it runs nowhere else, it is gone" in drop.lost


def test_newest_offer_is_adopted_of_two_in_doubt():
    older, newer = on(IN_DOUBT, "a", other="x"), on(IN_DOUBT, "c", other="x")
    offers = (replace(held("a"), guardians=()), replace(held("c"), epoch=(4, "a"), guardians=()))
    told = diagnose(found(older, newer, answers="ac", checkpoints=offers))
    assert told.proposal.agent == "c"
    assert "x is off, and never comes back with its present disk" in told.proposal.only_if
