"""Actuators: one holder each, and what is kept for a task that is about to arrive."""

import pytest

from pancakes.kernel.registry import DeviceEntry, Registry

CIRCLE, HOME, REMOTE = "a/client/Circle", "a/client/Home", "b/device/wheels"


@pytest.fixture
def registry():
    made = Registry()
    made.add_device(DeviceEntry("wheels", "motors", actuator=True))
    made.add_device(DeviceEntry("arm", "arm", actuator=True))
    made.add_device(DeviceEntry("eye", "ir"))
    return made


def test_what_is_kept_obeys_no_task_and_goes_to_no_other(registry):
    assert registry.reserve(CIRCLE, ("motors", "ir")) == ""
    assert registry.holder("wheels") == ""
    assert registry.hold(HOME, ("motors",)) == f"wheels is kept for {CIRCLE}, which is about to start"
    assert registry.reserve(HOME, ("arm", "motors")) == f"wheels is kept for {CIRCLE}, which is about to start"
    assert registry.claim("wheels", REMOTE) == CIRCLE
    assert registry.holder("wheels") == ""
    assert registry.hold(HOME, ("arm",)) == ""


def test_the_task_that_arrives_takes_it_and_nothing_stays_kept(registry):
    registry.reserve(CIRCLE, ("motors",))
    assert registry.hold(CIRCLE, ("motors",)) == ""
    assert registry.holder("wheels") == CIRCLE
    registry.release(CIRCLE)
    assert registry.hold(HOME, ("motors",)) == ""


def test_what_is_given_back_is_free(registry):
    registry.reserve(CIRCLE, ("motors",))
    registry.unreserve(HOME)
    assert registry.taken("wheels", HOME)
    registry.unreserve(CIRCLE)
    assert registry.taken("wheels", HOME) == ""
    assert registry.claim("wheels", REMOTE) == REMOTE


def test_it_is_known_which_devices_a_task_holds(registry):
    registry.hold(CIRCLE, ("motors", "arm"))
    registry.hold(HOME, ("ir",))
    assert registry.held_by("/".join(("a", "client", "Circle"))) == ["wheels", "arm"]
    assert registry.held_by(HOME) == []


def test_what_one_task_gives_back_leaves_what_is_kept_for_the_others(registry):
    registry.reserve(CIRCLE, ("motors",))
    registry.reserve(HOME, ("arm",))
    registry.unreserve("a/client/Drive")
    assert registry.taken("wheels", "x") and registry.taken("arm", "x")
    registry.unreserve(CIRCLE)
    assert registry.taken("wheels", "x") == "" and registry.taken("arm", "x")


def test_what_another_holds_cannot_be_kept_all_or_none(registry):
    registry.hold(HOME, ("motors",))
    assert registry.reserve(CIRCLE, ("arm", "motors")) == f"wheels is held by {HOME}"
    assert registry.taken("arm", HOME) == ""
