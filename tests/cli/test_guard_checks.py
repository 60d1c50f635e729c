"""The findings of `pancakes doctor` about guarded tasks."""

from pancakes.tools.cli.verbs.agent_checks import check_guards
from pancakes.tools.cli.verbs.checks import Facts


def guards(agent, **others):
    row = {"task_id": "a/Scan", "agent": agent, "owner": "a", "epoch": "0@a", "lease": True, "wanted": True}
    row |= {"silent_s": 0.5, "lease_left_s": 1.5}
    return {**row, **others}


def owns(agent="a", **others):
    return guards(agent, guardians=["a", "b", "c"], guard=3, permit_s=1.5, **others)


def found(*rows):
    return [
        (finding.level, finding.about, finding.text, finding.advice) for finding in check_guards(Facts(guards=rows))
    ]


def test_guard_check_accepts_a_fully_guarded_task():
    assert found(owns(), guards("b"), guards("c")) == []


def test_guard_check_ignores_a_former_owner():
    before = {**owns(epoch="9@a"), "permit_s": 0.0, "lease": False}
    assert found(before, guards("b", epoch="10@b", lease=False)) != []
    assert found(before, {**owns("b", epoch="10@b"), "guardians": ["a", "b"], "guard": 2}) == []


def test_guard_check_reports_a_silent_guardian():
    ((level, about, text, _),) = found(owns(), guards("b"))
    assert (level, about) == ("warning", "a/Scan") and text.endswith("does not answer: c")


def test_guard_check_reports_too_few_guardians():
    ((level, _, text, advice),) = found({**owns(), "guardians": ["a"]})
    assert level == "warning" and "has 1 of the 3 guardians that it needs" in text and "such as a witness" in advice


def test_guard_check_reports_a_missing_permit():
    ((level, _, text, _),) = found({**owns(), "permit_s": 0.0}, guards("b"))
    assert level == "error" and "is paused" in text
    assert found({**owns(wanted=False), "permit_s": 0.0}, guards("b"), guards("c")) == []


def test_guard_check_reports_a_silent_owner():
    ((level, about, text, advice),) = found(guards("b", lease=False), guards("c", lease=False))
    assert (level, about) == ("error", "a/Scan") and "its owner a is silent" in text
    assert "pancakes task recover b/Scan" in advice
    assert found(guards("b", lease=False, wanted=False)) == []
    assert found(guards("b"), guards("c", lease=False)) == []


def test_guard_check_reports_leases_that_must_end():
    """After two backups were restored one after the other, each guardian waits a whole lease from its start."""
    waits = {"silent_s": 20.0, "lease_left_s": 10.0}
    ((level, about, text, _),) = found(guards("b", **waits), guards("c", lease=False, lease_left_s=None))
    assert (level, about) == ("warning", "a/Scan") and text.endswith("the lease of a ends: b (10 s)")
    assert found(guards("b", **waits), guards("c")) == [], "its owner has renewed the other one"


def test_guard_check_reports_a_missing_dead_man_switch():
    ((level, about, text, advice),) = found(owns(no_dead_man=["lamp", "motors"]), guards("b"), guards("c"))
    assert (level, about) == ("warning", "a/Scan") and text.startswith("commands lamp, motors, whose hardware has no")
    assert "docs/writing-a-driver.md" in advice


def test_guard_check_reports_a_clock_set_forward():
    ((level, _, text, advice),) = found(owns(clock_steps=1), guards("b"), guards("c"))
    assert level == "warning" and text == "was paused once because the time of day of a was set forward"
    assert advice == "make sure that its clock is set before the agent starts"
    ((_, _, text, _),) = found(owns(clock_steps=3), guards("b"), guards("c"))
    assert "was paused 3 times" in text
    assert found(owns(clock_steps=0, no_dead_man=[]), guards("b"), guards("c")) == []
