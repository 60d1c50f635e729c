"""The sets of the tests, and what tests of several parts need.

Each test is in one set, by its fixtures, its file or its folder:

- fast: decisions, virtual time, sockets within the process; what is in no other set.
- live: programs that run, and threads in real time.
- long: a browser, hosts behind ssh, built wheels, many seeds.
- model: exhaustive searches at full bounds, and the mutants that they must convict.
- foreign: programs that others wrote, such as ROS 2.

`scripts/test` runs fast and live, `.ci/run` also long, and of model and foreign what changed since it passed
(`harness.proven`). Files that end in `_full.py`, the long forms of others, run only with `scripts/test --all`.
"""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest
from harness import programs, proven

pytest_plugins = ["harness.limits"]

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
TESTS = Path(__file__).parent
SETS = ("fast", "live", "long", "model", "foreign")
CHANGED = "changed"
"""What `--sets` may name beside them: of model and foreign, what changed since it passed."""

CPU_LIMITS_S = {"fast": 10.0, "live": 60.0}
"""What a test may take of the processor; see `harness.limits`."""

BY_FIXTURE = {"browser": "long", "hosts": "long", "mosquitto": "live", "receiver": "foreign"}
BY_SUFFIX = {"_live": "live", "_long": "long", "_full": "long"}
BY_FOLDER = {
    "cli": "live",
    "client": "live",
    "deploy": "live",
    "examples": "live",
    "launch": "live",
    "trials": "live",
    "ros2": "foreign",
    "systemd_vm": "foreign",
    "zenoh_links": "foreign",
}
SEARCHES = ("life", "register")
"""The folders whose `_full` files are exhaustive searches."""


PURE = ("test_conversions", "test_without_ros2", "test_credit_pool", "test_change", "test_steadiness")
"""The files of such folders that need none of the programs."""


def set_of(item: pytest.Item) -> str:
    """Returns the set that a test is in."""
    folder = item.path.relative_to(TESTS).parts[0]
    suffix = item.path.stem[item.path.stem.rfind("_") :]
    if item.path.stem in PURE:
        return "fast"
    if BY_FOLDER.get(folder) == "foreign":
        return "foreign"
    if suffix == "_full" and folder in SEARCHES:
        return "model"
    if suffix in BY_SUFFIX:
        return BY_SUFFIX[suffix]
    fixtures = getattr(item, "fixturenames", ())
    return next((BY_FIXTURE[name] for name in fixtures if name in BY_FIXTURE), BY_FOLDER.get(folder, "fast"))


def is_whole(item: pytest.Item) -> bool:
    """Returns whether a test is the long form of another, or searches as far as can be."""
    return item.path.stem.endswith("_full")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--sets",
        type=lambda text: text.split(","),
        metavar="SET,...",
        help=f"run only the tests of these sets: {', '.join((*SETS, CHANGED))}",
    )
    parser.addoption("--prove", action="store_true", help="write down which subjects passed (tests/proven.json)")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Marks each test with its set, and leaves those that `--sets` asks for."""
    sets = config.getoption("sets")
    if unknown := set(sets or ()) - {*SETS, CHANGED}:
        raise pytest.UsageError(f"--sets: unknown set {', '.join(sorted(unknown))}; there are {', '.join(SETS)}")
    changed = proven.changed() if sets is not None and CHANGED in sets else frozenset()
    kept: list[pytest.Item] = []
    left: list[pytest.Item] = []
    for item in items:
        name = set_of(item)
        item.add_marker(name)
        if name in CPU_LIMITS_S and item.get_closest_marker("cpu_limit") is None:
            item.add_marker(pytest.mark.cpu_limit(CPU_LIMITS_S[name]))
        asked = sets is None or (name in sets and not is_whole(item))
        if name in ("model", "foreign") and changed:
            asked = asked or proven.subject_of(item.path) in changed
        (kept if asked else left).append(item)
    if left:
        config.hook.pytest_deselected(items=left)
    items[:] = dear_first(kept, int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")))


def dear_first(items: list[pytest.Item], workers: int) -> list[pytest.Item]:
    """Returns tests in an order in which each worker begins with its share of the dear files.

    `--dist worksteal` gives each worker an equal part of the list. A file that takes minutes, and stands at the end of
    its part, keeps all others waiting.
    """
    dear: dict[Path, list[pytest.Item]] = {}
    quick = []
    for item in items:
        if any(item.get_closest_marker(name) for name in ("long", "model", "foreign")):
            dear.setdefault(item.path, []).append(item)
        else:
            quick.append(item)
    parts: list[list[pytest.Item]] = [[] for _ in range(workers)]
    for number, file in enumerate(dear.values()):
        parts[number % workers] += file
    for number, part in enumerate(parts):
        room = len(items) * (number + 1) // workers - len(items) * number // workers - len(part)
        part += quick[: max(0, room)]
        del quick[: max(0, room)]
    return [item for part in parts for item in part] + quick


def pytest_configure(config: pytest.Config) -> None:
    """Lets the processes that tests start hear signals, and hypothesis be patient.

    A shell that started this one with `&` has SIGINT ignored, `nohup` has SIGHUP, and children inherit that; one that
    is caught here is not ignored there. And an example of hypothesis may take long on a machine that has other work,
    which is no fault of it.
    """
    for name in SETS:
        config.addinivalue_line("markers", f"{name}: see tests/conftest.py")
    if config.getoption("prove") and not hasattr(config, "workerinput"):
        config.pluginmanager.register(proven.Prover())
    hypothesis.settings.register_profile("patient", hypothesis.settings.default, deadline=None)
    hypothesis.settings.load_profile("patient")
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda number, frame: None)  # this process goes on, as was asked


def pytest_unconfigure() -> None:
    """Ends the fork server, if a test started one."""
    programs.close_server()


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


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A Chromium without a window, for all tests of a file: its start costs as much as most of these tests."""
    program = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if program is None:
        pytest.skip("there is no chromium here: apt install chromium")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as running:
        browser = running.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def browser(chromium: Any) -> Iterator[Any]:
    """The Chromium without anything that an earlier test left: pages, cookies and storage belong to a context."""
    yield chromium
    for context in chromium.contexts:
        context.close()
