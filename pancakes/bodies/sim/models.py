"""The kinds of robots that a configuration can name."""

from __future__ import annotations

from pancakes.bodies.sim.khepera import KHEPERA_III
from pancakes.bodies.sim.pioneer import PIONEER_3DX
from pancakes.bodies.sim.robot import RobotModel
from pancakes.errors import PancakesError
from pancakes.runtime.foundation.suggestion import did_you_mean

_MODELS = {model.name: model for model in (KHEPERA_III, PIONEER_3DX)}


class UnknownRobotModel(PancakesError, ValueError):
    """There is no kind of robot of this name; the message lists those there are."""


def robot_model(name: str) -> RobotModel:
    """Returns the kind of robot that a configuration calls `name`.

    Raises:
        UnknownRobotModel: there is none of that name.
    """
    model = _MODELS.get(name)
    if model is None:
        hint = did_you_mean(name, _MODELS)
        raise UnknownRobotModel(f"there is no robot model {name!r} (there are {', '.join(sorted(_MODELS))}){hint}")
    return model
