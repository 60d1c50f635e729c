"""The searches of test_codecs.py, finer."""

from __future__ import annotations

import pytest
from test_codecs import MEETING, SHORT, said_by


def test_codecs_many_threads_meet_new_types_full() -> None:
    ended = said_by(MEETING, "700")  # with four types each
    assert (ended.returncode, ended.stdout) == (0, "alive\n"), ended.stderr[-3000:]


@pytest.mark.parametrize("what", ["row", "letter", "seal", "snapshot", "checkpoint", "recorded", "read"])
def test_codecs_without_memory_raise_and_do_not_crash_full(what: str) -> None:
    ended = said_by(SHORT, "4", what)
    assert (ended.returncode, ended.stdout) == (0, "alive\n"), ended.stderr[-3000:]
