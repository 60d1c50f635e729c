"""Ctrl-C may come between any two steps of a wait."""

from __future__ import annotations

import random
import signal
import threading
from types import FrameType

import pytest

from pancakes.client.session import Session

TIMES = 1500
LONGEST_S = 0.0005
PATIENCE_S = 10.0


@pytest.fixture
def interrupting():
    """SIGALRM does as Ctrl-C would, and comes from a timer."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    signal.signal(signal.SIGALRM, before)


def test_ctrl_c_anywhere_in_a_wait_leaves_everything_in_order(interrupting, monkeypatch, tmp_path):
    monkeypatch.setenv("PANCAKES_RUNTIME_DIR", str(tmp_path))
    client = Session()
    source = random.Random(1)
    interrupted = 0
    for _ in range(TIMES):
        try:
            signal.setitimer(signal.ITIMER_REAL, source.uniform(1e-6, LONGEST_S))
            # It waits again and again, as for a picture that is drawn anew.
            for _ in range(1000):
                client.wait(client.now() + 0.00002, lambda: False)
        except KeyboardInterrupt:
            interrupted += 1
    # As a transport's thread does when somebody comes or goes, also while the client is being closed.
    news = threading.Thread(target=client.fleets, daemon=True)
    news.start()
    news.join(PATIENCE_S)
    assert not news.is_alive(), "the client keeps its lock for ever"
    assert interrupted == TIMES
    client.close()
