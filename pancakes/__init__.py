"""Pancakes: robots and sensor nodes that work as one (see README.md).

What tasks, services, drivers and programs need is here: `from pancakes import Task, every, Client`. Packets of sensors
and actuators are in `pancakes.devices`, control packets in `pancakes.control`, errors in `pancakes.errors`, test
fixtures in `pancakes.testing`. A name is loaded when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from pancakes.client import AsyncClient as AsyncClient
    from pancakes.client import Client as Client
    from pancakes.client import Target as Target
    from pancakes.devices.builtin_drivers import NetworkSensor as NetworkSensor
    from pancakes.devices.builtin_drivers import NullSensor as NullSensor
    from pancakes.devices.driver import Actuator as Actuator
    from pancakes.devices.driver import DeviceContext as DeviceContext
    from pancakes.devices.driver import Hardware as Hardware
    from pancakes.devices.driver import Sensor as Sensor
    from pancakes.errors import ClassError as ClassError
    from pancakes.errors import PancakesError as PancakesError
    from pancakes.filters.filter import Changed as Changed
    from pancakes.filters.filter import Filter as Filter
    from pancakes.filters.filter import FilterContext as FilterContext
    from pancakes.filters.filter import Held as Held
    from pancakes.migration import Cost as Cost
    from pancakes.migration import CostFacts as CostFacts
    from pancakes.packet import CTRL as CTRL
    from pancakes.packet import LOG as LOG
    from pancakes.packet import NEIGHBOURS as NEIGHBOURS
    from pancakes.packet import NETWORK as NETWORK
    from pancakes.packet import SYSCTRL as SYSCTRL
    from pancakes.packet import SYSTEM as SYSTEM
    from pancakes.packet import Packet as Packet
    from pancakes.packet import agent_of as agent_of
    from pancakes.packet import packet_type as packet_type
    from pancakes.packet import task_address as task_address
    from pancakes.recording.reader import RecordingReader as RecordingReader
    from pancakes.request import Answer as Answer
    from pancakes.request import Asked as Asked
    from pancakes.request import Pending as Pending
    from pancakes.request import Request as Request
    from pancakes.request import RequestError as RequestError
    from pancakes.request import RequestTimeoutError as RequestTimeoutError
    from pancakes.request import answers as answers
    from pancakes.service import Service as Service
    from pancakes.settings import FilePath as FilePath
    from pancakes.settings import NotNegative as NotNegative
    from pancakes.settings import Positive as Positive
    from pancakes.simulation import Simulation as Simulation
    from pancakes.task import Task as Task
    from pancakes.task import TaskSpec as TaskSpec
    from pancakes.task import Tick as Tick
    from pancakes.task import every as every
    from pancakes.task import on as on
    from pancakes.task import reliable as reliable

_MODULES = {
    "pancakes.client": ("AsyncClient", "Client", "Target"),
    "pancakes.devices.builtin_drivers": ("NetworkSensor", "NullSensor"),
    "pancakes.devices.driver": ("Actuator", "DeviceContext", "Hardware", "Sensor"),
    "pancakes.errors": ("ClassError", "PancakesError"),
    "pancakes.filters.filter": ("Changed", "Filter", "FilterContext", "Held"),
    "pancakes.migration": ("Cost", "CostFacts"),
    "pancakes.packet": (
        *("CTRL", "LOG", "NEIGHBOURS", "NETWORK", "SYSCTRL", "SYSTEM"),
        *("Packet", "agent_of", "packet_type", "task_address"),
    ),
    "pancakes.recording.reader": ("RecordingReader",),
    "pancakes.request": (
        *("Answer", "Asked", "Pending", "Request", "RequestError", "RequestTimeoutError"),
        "answers",
    ),
    "pancakes.service": ("Service",),
    "pancakes.settings": ("FilePath", "NotNegative", "Positive"),
    "pancakes.simulation": ("Simulation",),
    "pancakes.task": ("Task", "TaskSpec", "Tick", "every", "on", "reliable"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Load a name of the public API from its module (PEP 562)."""
    module = _MODULE_OF.get(name)
    if module is None:
        raise AttributeError(f"module 'pancakes' has no attribute {name!r}", name=name, obj=None)
    value = globals()[name] = getattr(import_module(module), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULE_OF})
