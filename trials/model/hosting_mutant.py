"""A broken variant of the machine that joins a life with its hand-off: an edit of the product's own source."""

from __future__ import annotations

import inspect
from types import ModuleType

import msgspec
from model.hosting_rim import Step

from pancakes.durable import state_machine


class HostingMutant(msgspec.Struct, frozen=True):
    """One broken variant.

    Attributes:
        story: what it does not do any more, or does wrongly.
        old: text as it stands in the machine, once.
        new: text instead.
    """

    story: str
    old: str
    new: str

    def make(self) -> Step:
        """Returns the machine with the edit made.

        Raises:
            LookupError: the text does not stand in the machine exactly once.
        """
        text = inspect.getsource(state_machine)
        count = text.count(self.old)
        if count != 1:
            raise LookupError(f"the mutant {self.story!r} finds its text {count} times: {self.old}")
        step: Step = edited_machine(text.replace(self.old, self.new)).handle
        return step


def edited_machine(text: str) -> ModuleType:
    """Returns the machine's module, made of another text."""
    module = ModuleType(state_machine.__name__)
    module.__dict__.update(vars(state_machine))  # its classes stay those of the product
    exec(
        compile(text[text.index("class HostingStep") :], f"<mutant of {state_machine.__name__}>", "exec"),
        module.__dict__,
    )
    return module
