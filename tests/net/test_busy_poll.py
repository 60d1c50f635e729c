"""A thread stays awake for the next packet where packets come one after the other, and sleeps in any other case."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import msgspec
import pytest
from seeded import for_each

from pancakes.agent.agent import Agent
from pancakes.config import ServiceConfig
from pancakes.errors import PancakesError
from pancakes.mesh.event_loop import BUSY_POLL_S, STREAK, BusyPoll
from pancakes.mesh.transport import SocketTransport
from pancakes.testing import config_of, no_thread_left, threaded_agent

AWAKE_S = 0.0002
LOOK_S = 0.00001
READY = [(7, 1)]


class Sockets:
    """Sockets of which one is ready at times that are known before, and the clock that a wait moves."""

    def __init__(self) -> None:
        self.now_s = 100.0
        self.ready_s = math.inf
        self.timeouts: list[float | None] = []

    def now(self) -> float:
        return self.now_s

    def poll(self, timeout_s: float | None) -> list[tuple[int, int]]:
        assert timeout_s is None or timeout_s >= 0, "epoll would wait for ever"
        self.timeouts.append(timeout_s)
        end_s = math.inf if timeout_s is None else self.now_s + max(timeout_s, LOOK_S)
        self.now_s = min(end_s, max(self.now_s, self.ready_s))
        assert self.now_s < math.inf, "the thread would sleep for ever"
        if self.ready_s > self.now_s:
            return []
        self.ready_s = math.inf
        return READY

    def asleep(self) -> list[float | None]:
        """Forgets and returns the waits that gave the processor away."""
        asleep = [timeout_s for timeout_s in self.timeouts if timeout_s != 0]
        self.timeouts.clear()
        return asleep


@pytest.fixture
def sockets() -> Sockets:
    return Sockets()


def talk(sockets: Sockets, waits: BusyPoll, packets: int, after_s: float = AWAKE_S / 2) -> None:
    for _ in range(packets):
        sockets.ready_s = sockets.now_s + after_s
        assert waits.wait(None) == READY


def test_packets_that_come_one_after_the_other_are_waited_for_awake(sockets: Sockets) -> None:
    waits = BusyPoll(sockets.poll, sockets.now, AWAKE_S)
    talk(sockets, waits, STREAK)
    assert sockets.asleep() == [None] * STREAK
    talk(sockets, waits, 100)
    assert sockets.asleep() == []


def test_the_end_of_a_dialogue_costs_the_time_once(sockets: Sockets) -> None:
    waits = BusyPoll(sockets.poll, sockets.now, AWAKE_S)
    talk(sockets, waits, STREAK)
    sockets.asleep()
    began_s = sockets.now_s
    sockets.ready_s = began_s + 1.0
    assert waits.wait(None) == READY
    assert sockets.timeouts[-1] is None
    assert sockets.timeouts[:-1] == [0] * round(AWAKE_S / LOOK_S)
    assert sockets.now_s == began_s + 1.0
    sockets.asleep()
    talk(sockets, waits, STREAK)
    assert sockets.asleep() == [None] * STREAK


@pytest.mark.parametrize("after_s", [AWAKE_S * 1.1, 0.001, 0.01])
def test_what_comes_at_longer_intervals_is_waited_for_asleep(sockets: Sockets, after_s: float) -> None:
    waits = BusyPoll(sockets.poll, sockets.now, AWAKE_S)
    talk(sockets, waits, 10 * STREAK, after_s)
    assert sockets.asleep() == [None] * 10 * STREAK


def test_two_packets_that_come_together_are_no_dialogue(sockets: Sockets) -> None:
    waits = BusyPoll(sockets.poll, sockets.now, AWAKE_S)
    for _ in range(10 * STREAK):
        talk(sockets, waits, 1, 0.01)
        talk(sockets, waits, 1)
    assert 0 not in sockets.timeouts


def test_it_wakes_when_a_timer_is_due(sockets: Sockets) -> None:
    waits = BusyPoll(sockets.poll, sockets.now, AWAKE_S)
    talk(sockets, waits, STREAK)
    sockets.timeouts.clear()
    until_s = sockets.now_s + AWAKE_S / 2
    assert waits.wait(until_s) == []
    assert until_s <= sockets.now_s < until_s + 3 * LOOK_S
    assert waits.wait(sockets.now_s + 0.5) == []
    assert sockets.timeouts[-1] == pytest.approx(0.5)


def test_where_it_shall_save_power_it_always_sleeps(sockets: Sockets) -> None:
    waits = BusyPoll(sockets.poll, sockets.now, 0.0)
    talk(sockets, waits, 10 * STREAK, 0.0)
    assert 0 not in sockets.timeouts


@pytest.mark.parametrize(("table", "busy_poll_s"), [({}, BUSY_POLL_S), ({"busy_poll_s": 0.0}, 0.0)])
def test_the_configuration_says_how_long_it_stays_awake(table: dict[str, float], busy_poll_s: float) -> None:
    with threaded_agent("a", services={"network": {"settings": table}}) as agent:
        transport = agent.kernel.transport
        assert isinstance(transport, SocketTransport)
        assert transport.loop.busy_poll.busy_poll_s == busy_poll_s


def test_busy_poll_settings_made_in_code_are_checked(tmp_path: Path):
    """It comes from no file that was checked; with infinity the thread would stay awake for ever after one dialogue."""

    def check(case):
        key, value = case
        network = ServiceConfig("network", "network", settings={key: value})
        config = msgspec.structs.replace(config_of("a", state_dir=str(tmp_path)), services={"network": network})
        with no_thread_left(), pytest.raises(PancakesError, match=f"bad settings for NetworkService: {key}: "):
            Agent(config)

    for_each(
        itertools.product(["busy_poll_s", "heartbeat_s"], [-1.0, math.nan, math.inf, 3600.0, "much", None, True]), check
    )


def test_timers_that_are_due_soon_are_no_dialogue(sockets: Sockets) -> None:
    waits = BusyPoll(sockets.poll, sockets.now, AWAKE_S)
    for _ in range(10 * STREAK):
        assert waits.wait(sockets.now_s + AWAKE_S / 2) == []
    assert 0 not in sockets.timeouts


def test_it_gives_way_each_time_that_nothing_is_ready(sockets: Sockets, monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    monkeypatch.setattr("pancakes.mesh.event_loop.give_way", lambda: given.append(sockets.now_s))
    waits = BusyPoll(sockets.poll, sockets.now, AWAKE_S)
    talk(sockets, waits, STREAK)
    assert not given
    assert waits.wait(sockets.now_s + AWAKE_S) == []
    assert len(given) == round(AWAKE_S / LOOK_S)


def test_unless_told_otherwise_the_thread_stays_awake_for_half_a_millisecond():
    assert pytest.approx(0.0005) == BUSY_POLL_S
