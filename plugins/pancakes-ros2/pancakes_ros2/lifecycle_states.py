"""The life of a task as the life cycle of a managed node of ROS 2. Pure."""

from __future__ import annotations

from typing import Final, NamedTuple

from pancakes.control import Start, Stop
from pancakes.supervision.lifecycle import State


class ManagedState(NamedTuple):
    """A state of a managed node, as lifecycle_msgs/State has it."""

    id: int
    label: str


class ManagedTransition(NamedTuple):
    """A transition that can be asked for, as lifecycle_msgs/Transition has it."""

    id: int
    label: str
    start: ManagedState
    goal: ManagedState


INACTIVE: Final = ManagedState(2, "inactive")
ACTIVE: Final = ManagedState(3, "active")
ACTIVATING: Final = ManagedState(13, "activating")
DEACTIVATING: Final = ManagedState(14, "deactivating")
STATES: Final = (INACTIVE, ACTIVE, ACTIVATING, DEACTIVATING)
TRANSITIONS: Final = (
    ManagedTransition(3, "activate", INACTIVE, ACTIVE),
    ManagedTransition(4, "deactivate", ACTIVE, INACTIVE),
)
_STATE_OF: Final = {
    State.RUNNING: ACTIVE,
    State.ASKED: ACTIVATING,
    State.STARTING: ACTIVATING,
    State.RESTARTING: ACTIVATING,
    State.STOPPING: DEACTIVATING,
    State.STUCK: DEACTIVATING,
}


def state_of(state: State) -> ManagedState:
    """Returns the state of a managed node that a task's state is."""
    return _STATE_OF.get(state, INACTIVE)


def transitions_from(state: ManagedState) -> list[ManagedTransition]:
    """Returns what can be asked for in a state."""
    return [transition for transition in TRANSITIONS if transition.start is state]


def request_for(number: int, label: str, state: ManagedState, target: str) -> Start | Stop | None:
    """Returns what to ask of a task for a transition; None: it is none that its state has.

    Args:
        number: the transition's id.
        label: its label, which is what counts if there is one.
        state: the task's state.
        target: the task, as control packets name it.
    """
    for transition in transitions_from(state):
        if transition.label == label or (not label and transition.id == number):
            return Start(target) if transition.goal is ACTIVE else Stop(target)
    return None
