"""The kinds of robots that a configuration can name."""

from __future__ import annotations

from pancakes.errors import PancakesError
from pancakes.sim.khepera import KHEPERA_III
from pancakes.sim.pioneer import PIONEER_3DX
from pancakes.sim.robot import RobotModel
from pancakes.suggestion import suggestion

_MODELS = {model.name: model for model in (KHEPERA_III, PIONEER_3DX)}


def robot_model(name: str) -> RobotModel:
    """Returns the kind of robot that a configuration calls `name`.

    Raises:
        PancakesError: there is none of that name; the message lists those there are.
    """
    model = _MODELS.get(name)
    if model is None:
        near = suggestion(name, list(_MODELS))
        hint = f", did you mean {near!r}?" if near else ""
        raise PancakesError(f"there is no robot model {name!r} (there are {', '.join(sorted(_MODELS))}){hint}")
    return model
