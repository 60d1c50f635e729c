"""The ROS 2 of this Python environment: imported when it is used, and named if it is missing."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final, Literal

from pancakes.errors import PancakesError

Kind = Literal["msg", "srv", "action"]
_TYPE: Final = re.compile(r"([a-z][a-z0-9_]*)/(?:(msg|srv|action)/)?([A-Z][A-Za-z0-9]*)")
_WORDS: Final[Mapping[Kind, tuple[str, str]]] = {
    "msg": ("message", "geometry_msgs/msg/PoseStamped"),
    "srv": ("service", "std_srvs/srv/Trigger"),
    "action": ("action", "nav2_msgs/action/NavigateToPose"),
}
NEXT_STEP: Final = (
    "source the setup file of a ROS 2 whose Python is this one (`source /opt/ros/jazzy/setup.bash`),"
    " or install a ROS 2 into this environment; see docs/ros2.md"
)


def have_fields_checked() -> None:
    """Has messages check what is put into their fields: else ROS 2 sends something else where a value does not fit.

    To be called before any message is imported.
    """
    os.environ.setdefault("ROS_PYTHON_CHECK_FIELDS", "1")


def check_installed() -> None:
    """Makes sure that this Python finds a ROS 2, without importing it.

    Raises:
        PancakesError: it does not.
    """
    if find_spec("rclpy") is None:
        raise PancakesError(f"this Python has no ROS 2, as there is no rclpy: {NEXT_STEP}")


def checked_type(name: str, kind: Kind = "msg") -> str:
    """Returns the full name of a type, such as `geometry_msgs/msg/PoseStamped`; `msg/` may be left out.

    Raises:
        ValueError: it is no such name.
    """
    found = _TYPE.fullmatch(name)
    if found is None or found[2] not in (None, kind):
        word, such = _WORDS[kind]
        raise ValueError(f"{name!r} is no {word} type of ROS 2, such as {such!r}")
    return f"{found[1]}/{kind}/{found[3]}"


def message_class(name: str) -> Any:
    """Returns the class of a message type that is installed.

    Raises:
        PancakesError: it is not installed, or cannot be loaded; the sentence says what to do.
    """
    return type_class(name, "msg")


def type_class(name: str, kind: Kind) -> Any:
    """Returns the class of a type of messages, services or actions that is installed.

    Raises:
        PancakesError: it is not installed, or cannot be loaded; the sentence says what to do.
    """
    package, _, wanted = checked_type(name, kind).split("/")
    word = _WORDS[kind][0]
    have_fields_checked()
    try:
        module = import_module(f"{package}.{kind}")
    except ImportError as error:
        if error.name == package:
            reason = f"the package {package} is not installed: install it, or source the workspace that has it"
        elif error.name == f"{package}.{kind}":
            reason = f"the package {package} has no {word} types"
        else:
            reason = f"{package} cannot be loaded: {error}"
        raise PancakesError(f"there is no {word} type {name}: {reason}") from None
    found = getattr(module, wanted, None)
    if found is None:
        raise PancakesError(f"there is no {word} type {name}: {package} of this ROS 2 has no {word} {wanted}")
    return found


def ros_name(name: str) -> str:
    """Returns a name of Pancakes as a part of a name in ROS 2, which has letters, digits and underscores alone."""
    plain = re.sub(r"[^A-Za-z0-9_]", "_", name)
    plain = re.sub(r"__+", "_", plain)
    return plain if plain[:1].isalpha() else f"a_{plain.lstrip('_')}"


def check_agent_name(name: str) -> None:
    """Makes sure that an agent's name is a name in ROS 2 as it is.

    It must not become another one there: `red-robot` and `red_robot` would be one node with one set of topics, and an
    agent does not know of all others.

    Raises:
        PancakesError: it is none; the sentence has one that is.
    """
    if ros_name(name) != name:
        raise PancakesError(
            f"the agent {name} cannot be a node of ROS 2, where names have letters, digits and single underscores, and"
            f" begin with a letter: give it another name, such as {ros_name(name)}"
        )
