"""A task as a node of ROS 2: its settings are parameters, its life is that of a managed node.

All is called in the thread of `TaskNodes`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

from pancakes.control import Configure, Describe, Reply
from pancakes.errors import PancakesError
from pancakes_ros2.lifecycle_states import STATES, TRANSITIONS, ManagedState, request_for, transitions_from
from pancakes_ros2.parameter_values import changes_of, fill_value, flat, type_of, value_of

Ask = Callable[[Any], Reply]
"""Asks the agent something and waits for its answer; raises `PancakesError` where none comes."""
DEPTH_FIRST: Final = 0
"""`depth` of a request for the names of parameters: all that begin so."""


class TaskView(NamedTuple):
    """A task of the agent, as its node shows it.

    Attributes:
        service: its service.
        name: its name.
        state: its state.
    """

    service: str
    name: str
    state: ManagedState

    @property
    def target(self) -> str:
        """The task, as control packets name it."""
        return f"{self.service}/{self.name}"


class TaskNode:
    """The node of a task.

    Args:
        node: its rclpy node.
        view: the task.
        ask: asks the agent.
    """

    def __init__(self, node: Any, view: TaskView, ask: Ask) -> None:
        from lifecycle_msgs.msg import TransitionEvent
        from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
        from rcl_interfaces.srv import (
            DescribeParameters,
            GetParameters,
            GetParameterTypes,
            ListParameters,
            SetParameters,
            SetParametersAtomically,
        )

        self.node = node
        self.view = view
        self._ask = ask
        served = (
            (ListParameters, "list_parameters", self._list),
            (GetParameters, "get_parameters", self._get),
            (GetParameterTypes, "get_parameter_types", self._types),
            (DescribeParameters, "describe_parameters", self._describe),
            (SetParameters, "set_parameters", self._set),
            (SetParametersAtomically, "set_parameters_atomically", self._set_all),
            (GetState, "get_state", self._state),
            (ChangeState, "change_state", self._change_state),
            (GetAvailableStates, "get_available_states", self._states),
            (GetAvailableTransitions, "get_available_transitions", self._transitions),
            (GetAvailableTransitions, "get_transition_graph", self._graph),
        )
        for kind, name, serve in served:
            node.create_service(kind, f"~/{name}", serve)
        self._event = TransitionEvent
        self._events = node.create_publisher(TransitionEvent, "~/transition_event", 10)

    def show(self, view: TaskView) -> None:
        """Takes what has become of the task, and tells of its transition."""
        before, self.view = self.view, view
        if before.state == view.state:
            return
        event = self._event()
        event.timestamp = self.node.get_clock().now().nanoseconds
        event.start_state.id, event.start_state.label = before.state
        event.goal_state.id, event.goal_state.label = view.state
        for transition in TRANSITIONS:
            if transition.start == before.state and transition.goal == view.state:
                event.transition.id, event.transition.label = transition.id, transition.label
        self._events.publish(event)

    def _told(self) -> Mapping[str, Any]:
        reply = self._ask(Describe(self.view.target))
        return reply.result if reply.ok and isinstance(reply.result, Mapping) else {}

    def _settings(self) -> Mapping[str, Any]:
        settings = self._told().get("settings")
        return settings if isinstance(settings, Mapping) else {}

    def _parameters(self) -> dict[str, Any]:
        try:
            return flat(self._settings())
        except PancakesError:  # the answer of ROS 2 has no place for a reason
            return {}

    def _list(self, request: Any, response: Any) -> Any:
        names = list(self._parameters())
        wanted = [
            name
            for name in names
            if not request.prefixes or any(name == it or name.startswith(f"{it}.") for it in request.prefixes)
        ]
        response.result.names = [
            name for name in wanted if request.depth == DEPTH_FIRST or name.count(".") < request.depth
        ]
        response.result.prefixes = sorted({name.rpartition(".")[0] for name in wanted if "." in name})
        return response

    def _get(self, request: Any, response: Any) -> Any:
        from rcl_interfaces.msg import ParameterValue

        parameters = self._parameters()
        values = []
        for name in request.names:
            values.append(ParameterValue())
            if name in parameters:
                fill_value(values[-1], parameters[name])
        response.values = values
        return response

    def _types(self, request: Any, response: Any) -> Any:
        parameters = self._parameters()
        response.types = [type_of(parameters.get(name)) for name in request.names]
        return response

    def _describe(self, request: Any, response: Any) -> Any:
        from rcl_interfaces.msg import ParameterDescriptor

        parameters = self._parameters()
        response.descriptors = [
            ParameterDescriptor(name=name, type=type_of(parameters.get(name)), dynamic_typing=True)
            for name in request.names
        ]
        return response

    def _set(self, request: Any, response: Any) -> Any:
        response.results = [self._changed([parameter]) for parameter in request.parameters]
        return response

    def _set_all(self, request: Any, response: Any) -> Any:
        response.result = self._changed(request.parameters)
        return response

    def _changed(self, parameters: Any) -> Any:
        from rcl_interfaces.msg import SetParametersResult

        wanted = {parameter.name: value_of(parameter.value) for parameter in parameters}
        try:
            reply = self._ask(Configure(self.view.target, changes_of(self._settings(), wanted)))
        except PancakesError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=reply.ok, reason=reply.reason)

    def _state(self, request: Any, response: Any) -> Any:
        response.current_state.id, response.current_state.label = self.view.state
        return response

    def _change_state(self, request: Any, response: Any) -> Any:
        transition = request.transition
        body = request_for(transition.id, transition.label, self.view.state, self.view.target)
        try:
            response.success = body is not None and self._ask(body).ok
        except PancakesError:  # the answer of ROS 2 has no place for a reason; the agent's log has it
            response.success = False
        return response

    def _states(self, request: Any, response: Any) -> Any:
        from lifecycle_msgs.msg import State

        response.available_states = [State(id=state.id, label=state.label) for state in STATES]
        return response

    def _transitions(self, request: Any, response: Any) -> Any:
        response.available_transitions = [_described(it) for it in transitions_from(self.view.state)]
        return response

    def _graph(self, request: Any, response: Any) -> Any:
        response.available_transitions = [_described(it) for it in TRANSITIONS]
        return response


def _described(transition: Any) -> Any:
    from lifecycle_msgs.msg import State, Transition, TransitionDescription

    return TransitionDescription(
        transition=Transition(id=transition.id, label=transition.label),
        start_state=State(id=transition.start.id, label=transition.start.label),
        goal_state=State(id=transition.goal.id, label=transition.goal.label),
    )
