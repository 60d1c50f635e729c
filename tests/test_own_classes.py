"""Pancakes' own tasks, services and drivers are judged here as those of users are when they are defined."""

import importlib
import pkgutil
from typing import Any

import pytest

import pancakes
from pancakes.devices.driver import Driver
from pancakes.kernel.actor import Component
from pancakes.util import class_checks

OPTIONAL = (
    "pancakes.gym",
    "pancakes.pytest_plugin",
    "pancakes.tools.metrics",
    "pancakes.trees",
    "pancakes.tools.traces",
)
"""Need what not everybody installs, or change what is around them."""


def own_classes() -> list[Any]:
    for module in pkgutil.walk_packages(pancakes.__path__, "pancakes."):
        if not module.name.startswith(OPTIONAL) and not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    found: list[Any] = [Component, Driver]
    for cls in found:
        found += [it for it in cls.__subclasses__() if it not in found]
    return [cls for cls in found if cls.__module__.startswith("pancakes.")]


def test_own_classes_pass_the_judgement_of_users_classes(monkeypatch: pytest.MonkeyPatch):
    classes = own_classes()
    monkeypatch.setattr(class_checks, "is_judged", lambda cls: False)

    for cls in classes:
        super(cls, cls).__init_subclass__()

    assert len(classes) > 40
