"""Waits that whoever ends a run breaks off."""

from __future__ import annotations

import threading

import pytest
from torture.waits import Waits


def test_what_comes_is_waited_for_and_what_does_not_is_given_up() -> None:
    waits, came = Waits(), threading.Event()
    assert not waits.until(came.wait, 0.0)
    threading.Timer(0.1, came.set).start()
    assert waits.until(came.wait, 20.0)


def test_all_waits_end_where_they_are_broken_off() -> None:
    waits, never = Waits(), threading.Event()
    threading.Timer(0.1, waits.break_off).start()
    with pytest.raises(InterruptedError):
        waits.until(never.wait, 1000.0)
    with pytest.raises(InterruptedError):
        waits.let(1000.0)
