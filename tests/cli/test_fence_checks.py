"""The findings of `pancakes doctor` about the fences of actuators."""

from pancakes.tools.cli.verbs.agent_checks import check_fences
from pancakes.tools.cli.verbs.checks import Facts

ROW = {"actuator": "a/device/wheels", "task_id": "a/Circle", "brought_by": "z", "owner": "a", "reason": ""}


def found_in(row):
    facts = Facts(fences=lambda agent, target: [row] if (agent, target) == ("a", "device/wheels") else [])
    assert list(check_fences("a", {"task": "wheels", "service": "client"}, facts)) == [], "it is no device"
    return list(check_fences("a", {"task": "wheels", "service": "device"}, facts))


def test_fence_check_accepts_tasks_that_are_obeyed():
    for seen, owner_has, obeyed in (
        ("4@a", "4@a", True),
        ("4@a", "9@b", False),  # it has moved, and has not commanded the actuator yet
        ("4@a", "4@b", False),
        ("4@a", "", None),  # no agent that is linked has it
    ):
        row = {**ROW, "seen": seen, "owner_has": owner_has, "obeyed": obeyed}
        assert list(found_in(row)) == [], row


def test_fence_check_reports_a_refused_task():
    for seen, owner_has in (("10@z", "9@a"), ("9@b", "9@a")):
        (finding,) = found_in({**ROW, "seen": seen, "owner_has": owner_has, "obeyed": False})
        assert (finding.level, finding.about) == ("error", "a/device/wheels")
        why = f"refuses a/Circle, which a has under epoch {owner_has}: it has seen epoch {seen}, brought by z"
        assert finding.text == why
        assert finding.advice.endswith("pancakes task recover a/Circle")
