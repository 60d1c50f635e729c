"""Services: they start, watch and stop tasks, and do what control packets ask of them (paper §3.3, §3.4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Final

from pancakes.kernel.actor import COMPONENT_HOOKS, Component
from pancakes.kernel.kernel import Kernel
from pancakes.kernel.mailbox import Mailbox
from pancakes.supervision.serializable_types import check_saved
from pancakes.supervision.service_core import ServiceCore
from pancakes.task import Nothing, TaskSpec
from pancakes.util.class_checks import Made, check_made, check_own_names, is_own

_HOOKS: Final = (*COMPONENT_HOOKS, "own_tasks", "refuse_stop", "Settings", "only_name")
_MADE_WITH: Final = ("kernel", "address", "mailbox", "settings", "tasks", "owner", "kept")


class Service(Component):
    """The base of all services.

    A service of one's own subclasses it, may bring tasks of its own (`own_tasks`), and is named in the entry point
    group `pancakes.services`.

    Attributes:
        settings: an instance of the class's `Settings`.
        only_name: the one name that it can have in a configuration, for a service that an agent can have only once;
            empty: it may be there several times, under any names.
    """

    Settings: ClassVar[type] = Nothing
    only_name: ClassVar[str] = ""
    _made_as: ClassVar[Made] = Made(_MADE_WITH, "a service", "`def on_start(self)`", gives="_actor")

    settings: Any
    _actor: ServiceCore

    def __init_subclass__(cls, **others: Any) -> None:
        """Raise `ClassError` if the class cannot work: a method that Pancakes calls, or `Settings`."""
        check_own_names(cls, next(base for base in cls.__mro__ if is_own(base)), _HOOKS, ("settings",))
        super().__init_subclass__(**others)
        check_made(cls)
        check_saved(cls, "Settings")

    def __init__(self, kernel: Kernel, address: str, mailbox: Mailbox | None = None, **others: Any) -> None:
        ServiceCore(kernel, address, mailbox, facade=self, **others)

    def own_tasks(self) -> Sequence[TaskSpec]:
        """Return the tasks that the service brings itself; called once, before they start."""
        return ()

    @classmethod
    def refuse_stop(cls, kernel: Kernel, name: str, arguments: Mapping[str, Any], for_s: float | None) -> str:
        """Say why the service must not be stopped now; empty: it may. Called in the root's actor.

        Args:
            kernel: the kernel, whose tables say what runs.
            name: the name of the service.
            arguments: what its class wants besides what every service gets; the tables that it shares are among it.
            for_s: for how long it is stopped, in mission seconds; None: until it is started.
        """
        return ""
