"""What tests of several parts need."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Iterator
from typing import Any

import hypothesis
import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def pytest_configure() -> None:
    """Lets the processes that tests start be interrupted, and hypothesis be patient.

    A shell that started this one with `&` has SIGINT ignored, and children inherit that; one that is caught here is not
    ignored there. And an example of hypothesis may take long on a machine that has other work, which is no fault of it.
    """
    hypothesis.settings.register_profile("patient", hypothesis.settings.default, deadline=None)
    hypothesis.settings.load_profile("patient")
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def runtime_directory(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Gives the agents of these tests a directory of their own, where no other's have the same names."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PANCAKES_RUNTIME_DIR", str(tmp_path_factory.mktemp("runtime")))
        yield


@pytest.fixture
def handlers() -> Iterator[None]:
    """Gives the signals that end a process back to pytest, however a test fails."""
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def browser() -> Iterator[Any]:
    """A Chromium without a window."""
    program = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if program is None:
        pytest.skip("there is no chromium here: apt install chromium")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser
        browser.close()
