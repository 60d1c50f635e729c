"""A plug-in for pykka's own tests: it puts a component in the place of `pykka.ThreadingActor`.

`test_pykka_own_tests_full.py` loads it in a pytest of its own, before pykka's tests are imported. It writes the outcome
of each test to the file that `OUTCOMES` names.
"""

import json
import os
import sys
import uuid
from pathlib import Path

import pykka

from pancakes.kernel.actor import ActorCore
from pancakes.kernel.kernel import Kernel

OUTCOMES = "PYKKA_OUTCOMES"

_KERNEL = Kernel("pykka")
_outcomes: dict[str, str] = {}


class ThreadingActor(ActorCore):
    """A component that is made, registered and struck out as pykka does it, which knows neither kernel nor address."""

    def __init__(self, *args, **kwargs):
        super().__init__(_KERNEL, uuid.uuid4().urn)
        self.exited = lambda component, error: pykka.ActorRegistry.unregister(component.actor_ref)


setattr(pykka, "ThreadingActor", ThreadingActor)  # noqa: B010 - for a type checker a class is no variable


def pytest_collection_finish():
    """Lets the tests that wait in vain for a line of Python's logging wait for less time."""
    sys.modules["tests.log_handler"].PykkaTestLogHandler.wait_for_message.__defaults__ = (1, 2.0)


def pytest_runtest_logreport(report):
    """Notes what became of a test: a failure in any of its parts counts."""
    name = report.nodeid.partition("/")[2].replace("[threading]", "")
    if report.failed or name not in _outcomes:
        _outcomes[name] = report.outcome


def pytest_sessionfinish():
    """Writes the outcomes, and ends the kernel."""
    Path(os.environ[OUTCOMES]).write_text(json.dumps(_outcomes))
    _KERNEL.stop()
