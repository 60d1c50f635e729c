"""What `pancakes doctor` says of the fences of actuators."""

import pytest

from pancakes.tools.cli.verbs.fence_checks import check_fences

ROW = {"actuator": "a/device/wheels", "task_id": "a/Circle", "brought_by": "z", "owner": "a", "reason": ""}


@pytest.mark.parametrize(
    ("seen", "owner_has", "obeyed"),
    [
        ("4@a", "4@a", True),
        ("4@a", "9@b", False),  # it has moved, and has not commanded the actuator yet
        ("4@a", "4@b", False),
        ("4@a", "", None),  # no agent that is linked has it
    ],
)
def test_an_actuator_that_obeys_a_task_or_will_is_in_order(seen, owner_has, obeyed):
    assert list(check_fences([{**ROW, "seen": seen, "owner_has": owner_has, "obeyed": obeyed}])) == []


@pytest.mark.parametrize(("seen", "owner_has"), [("10@z", "9@a"), ("9@b", "9@a")])
def test_a_task_that_an_actuator_refuses_is_named(seen, owner_has):
    (finding,) = check_fences([{**ROW, "seen": seen, "owner_has": owner_has, "obeyed": False}])
    assert (finding.level, finding.about) == ("error", "a/device/wheels")
    why = f"refuses a/Circle, which a has under epoch {owner_has}: it has seen epoch {seen}, brought by z"
    assert finding.text == why
    assert finding.advice.endswith("pancakes task fence a/device/wheels --set a/Circle")
