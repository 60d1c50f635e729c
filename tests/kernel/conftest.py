"""A kernel on threads, for the tests of what runs on it."""

import pytest

from pancakes.kernel.kernel import Kernel
from pancakes.testing import no_thread_left

PATIENCE_S = 10.0


@pytest.fixture
def kernel():
    with no_thread_left():
        made = Kernel("a")
        yield made
        for component in reversed(made.registry.components()):
            component.actor_ref.stop(timeout=PATIENCE_S)
        made.stop()
