"""Commands that no actuator takes, and how many lost packets are remembered."""

from kernel.virtual_rig import VirtualRig

from pancakes.control import Reply
from pancakes.devices import Battery, Pose
from pancakes.kernel.dead_letters import MOST_TOLD
from pancakes.kernel.registry import DeviceEntry

POSE = Pose(0.0, 0.0, 0.0)


def lost(rig: VirtualRig) -> list[str]:
    return [line for line in rig.lines() if " is lost: " in line]


def test_a_command_that_no_actuator_takes_is_told_once() -> None:
    rig = VirtualRig()
    rig.kernel.registry.add_device(DeviceEntry("mast", "poses", actuator=True))
    rig.send(POSE, POSE, channel="ctrl")
    rig.send(Battery(7.0, 0.5), channel="ctrl")
    rig.send(POSE, channel="system")
    assert lost(rig) == [
        "'pose' of a/client/Source on 'ctrl' is lost: no actuator of a takes it, did you mean 'poses'?",
        "'battery' of a/client/Source on 'ctrl' is lost: no actuator of a takes it",
    ]


def test_answers_that_nobody_reads_are_not_told() -> None:
    rig = VirtualRig()
    rig.send(Reply(None, {}), to="a/client/Gone", channel="sysctrl")
    rig.send(POSE, to="a/client/Gone", channel="network")
    assert lost(rig) == []


def test_one_destination_after_the_other_fills_no_memory() -> None:
    rig = VirtualRig()
    rig.send(POSE, POSE, to="a/client/T0")
    assert len(lost(rig)) == 1
    for number in range(1, MOST_TOLD + 1):
        rig.send(POSE, to=f"a/client/T{number}")
        rig.settle()
    rig.probe.forget()
    rig.send(POSE, to="a/client/T0")
    assert len(lost(rig)) == 1, "what was forgotten is told again"
