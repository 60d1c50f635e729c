"""How a command that runs for long is ended from outside, so that it ends what it has started as well."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class Ended(BaseException):
    """The command is asked to end: raised in whatever the main thread does.

    It is no `SystemExit`: in virtual time the main thread gives actors their turns, and an actor takes that for a
    failure of its own, so the run went on with a task less, and found a fault that was none.
    """


@contextmanager
def interruptible() -> Iterator[None]:
    """Lets SIGTERM and SIGHUP end the run as Ctrl-C does, so that it clears up. Main thread.

    A signal that is ignored, as `nohup` has SIGHUP, stays so.
    """

    def end(number: int, frame: object) -> None:
        raise Ended(number)

    before: dict[int, Any] = {}
    for taken in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(taken) is not signal.SIG_IGN:
            before[taken] = signal.signal(taken, end)
    try:
        yield
    except Ended as ended:
        sys.exit(128 + ended.args[0])
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
