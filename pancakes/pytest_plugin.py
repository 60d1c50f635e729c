"""The pytest plug-in: fixtures for tests of tasks, drivers and services (docs/testing.md).

pytest loads it by entry point wherever Pancakes is installed, so it imports nothing of Pancakes before a test asks for
one of its fixtures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from pancakes.simulation.agent_handle import Probe
    from pancakes.testing import AgentHandle, Fleet, Leaks
    from pancakes.util.clock import VirtualClock

    StartAgent = Callable[..., AgentHandle]
    ProbeOn = Callable[..., Probe]

MARKER = "pancakes"
_MARKER_HELP = (
    "pancakes(seed=0, latency_s=..., jitter_s=..., bytes_per_s=..., leaks=True): the seed and the network of the"
    " fixtures `fleet` and `virtual_agent`; leaks=False: what this test leaves behind is left behind on purpose"
)
_QUALITY = ("latency_s", "jitter_s", "bytes_per_s")
_LEAKS: pytest.StashKey[Leaks] = pytest.StashKey()
_BROKE_OFF: pytest.StashKey[bool] = pytest.StashKey()
_LOG_LINES = 30


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("pancakes", "agents in virtual time")
    group.addoption(
        "--pancakes-seed",
        type=int,
        metavar="SEED",
        help="The seed of the fixture `fleet`, for tests without a seed of their own. [default: 0]",
    )
    group.addoption(
        "--pancakes-seeds",
        type=int,
        default=1,
        metavar="COUNT",
        help="Run each test that uses the fixture `fleet` under this many seeds. [default: 1]",
    )


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", _MARKER_HELP)
    if config.getoption("--pancakes-seeds") < 1:
        raise pytest.UsageError(f"--pancakes-seeds: {config.getoption('--pancakes-seeds')} is less than one seed")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    count: int = metafunc.config.getoption("--pancakes-seeds")
    if count > 1 and "pancakes_seed" in metafunc.fixturenames:
        first = _first_seed(metafunc.definition)
        seeds = range(first, first + count)
        metafunc.parametrize("pancakes_seed", seeds, indirect=True, ids=[f"seed{seed}" for seed in seeds])


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    """Show the end of every agent's log with a test that has failed."""
    outcome: Any = yield
    report = outcome.get_result()
    if report.passed or call.when == "teardown":
        return
    item.stash[_BROKE_OFF] = True
    if not report.failed:
        return
    leaks = item.stash.get(_LEAKS, None)
    for agent in leaks.agents() if leaks is not None else ():
        text = agent.log_tail(_LOG_LINES)
        if text:
            report.sections.append((f"log of the agent {agent.name}", text))


def _marks(node: pytest.Item) -> dict[str, Any]:
    """Return the arguments of the markers of a test; the nearest marker counts."""
    known = ("seed", "leaks", *_QUALITY)
    said: dict[str, Any] = {}
    for mark in node.iter_markers(MARKER):
        unknown = [repr(argument) for argument in mark.args] + [key for key in mark.kwargs if key not in known]
        if unknown:
            raise pytest.UsageError(
                f"{node.nodeid}: the marker {MARKER} knows no {', '.join(unknown)}, only {', '.join(known)}, by name"
            )
        said = {**mark.kwargs, **said}
    return said


def _first_seed(node: pytest.Item) -> int:
    seed: int | None = _marks(node).get("seed", node.config.getoption("--pancakes-seed"))
    return 0 if seed is None else seed


@pytest.fixture
def no_leaks(request: pytest.FixtureRequest) -> Iterator[Leaks]:
    """Fail the test if it leaves a thread, an actor, a socket or an open file behind.

    All other fixtures of Pancakes use it. `@pytest.mark.pancakes(leaks=False)` switches it off for a test.
    """
    from pancakes.testing import Leaks

    wanted = _marks(request.node).get("leaks", True)
    leaks = Leaks()
    request.node.stash[_LEAKS] = leaks
    yield leaks
    del request.node.stash[_LEAKS]
    if wanted and not request.node.stash.get(_BROKE_OFF, False):  # a test that broke off in the middle has an excuse
        left = leaks.left()
        if left:
            pytest.fail(f"when the test was over, {left}", pytrace=False)


@pytest.fixture
def pancakes_seed(request: pytest.FixtureRequest) -> int:
    """The seed of `fleet`: of the marker, else of `--pancakes-seed`, else 0; with `--pancakes-seeds` those after it."""
    seed: int = request.param if hasattr(request, "param") else _first_seed(request.node)
    return seed


@pytest.fixture
def fleet(request: pytest.FixtureRequest, no_leaks: Leaks, pancakes_seed: int) -> Iterator[Fleet]:
    """Agents in virtual time on a network in memory, with faults on demand: a `pancakes.testing.Fleet`."""
    from pancakes.mesh.memory_network import Quality
    from pancakes.testing import Fleet

    quality = {key: value for key, value in _marks(request.node).items() if key in _QUALITY}
    with Fleet(pancakes_seed, Quality(**quality)) as made:
        no_leaks.watch(lambda: made.started)
        yield made


@pytest.fixture
def virtual_agent(fleet: Fleet) -> StartAgent:
    """Start agents of `fleet`: `virtual_agent(name="a", text="", tasks=..., devices=..., services=..., ...)`."""

    def start(name: str = "a", text: str = "", **arguments: Any) -> AgentHandle:
        return fleet.start(name, text, **arguments)

    return start


@pytest.fixture
def threaded_agent(no_leaks: Leaks) -> Iterator[StartAgent]:
    """Start agents on threads and in real time, with the same arguments as `virtual_agent`; the test ends them."""
    from pancakes.testing import threaded_agent

    started: list[AgentHandle] = []
    no_leaks.watch(lambda: started)
    with ExitStack() as stack:

        def start(name: str = "a", text: str = "", **arguments: Any) -> AgentHandle:
            started.append(stack.enter_context(threaded_agent(name, text, **arguments)))
            return started[-1]

        yield start


@pytest.fixture(params=["virtual", "threads"])
def any_agent(request: pytest.FixtureRequest) -> StartAgent:
    """Run the test twice: once as `virtual_agent`, once as `threaded_agent`."""
    start: StartAgent = request.getfixturevalue("virtual_agent" if request.param == "virtual" else "threaded_agent")
    return start


@pytest.fixture
def probe(no_leaks: Leaks) -> ProbeOn:
    """Add a probe: `probe(agent, "ctrl", "system")`; without channels it listens to all. The agent must run."""
    from pancakes.packet import join
    from pancakes.simulation.agent_handle import Probe

    made: list[Probe] = []

    def listen(agent: AgentHandle, *channels: str) -> Probe:
        address = join(agent.name, "test", f"Probe{len(made) + 2}")
        found = agent.kernel.spawn(Probe, address, channels=channels)
        assert isinstance(found, Probe)
        made.append(found)
        # It has subscribed when this returns, so that it misses nothing.
        assert found.wait(found.listening, 5.0), f"{address} did not start"
        return found

    return listen


@pytest.fixture
def virtual_clock() -> VirtualClock:
    """Return a clock that stays at 0 s until a test moves it with `advance_to`."""
    from pancakes.util.clock import VirtualClock

    return VirtualClock()
