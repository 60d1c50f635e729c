"""Signals that end a command: none is lost, and none blocks the command."""

import subprocess
import sys

PATIENCE_S = 20.0
HEAD = """
import os, signal, sys, threading
from pancakes.tools.cli.streaming import event_at
"""


def outcomes(*sources: str) -> list[int]:
    """Run programs at the same time; return their exit codes."""
    running = [subprocess.Popen([sys.executable, "-c", HEAD + source]) for source in sources]
    try:
        return [it.wait(PATIENCE_S) for it in running]
    finally:
        for it in running:
            it.kill()
            it.wait()


IN_THE_MIDDLE_OF_THE_WAIT = """
ended = event_at(signal.SIGINT)
lines = []

def interrupt(frame, event, argument):
    if frame.f_code is threading.Event.wait.__code__:
        lines.append(event)
        if lines.count("line") == 2:  # the event's lock is held from here on
            os.kill(os.getpid(), signal.SIGINT)
            sum(range(1000))
        return interrupt

sys.settrace(interrupt)
sys.exit(7 if ended.wait(10) else 1)
"""
# As one that comes in the moment before the main thread sleeps, which cannot be hit on purpose.
THAT_DOES_NOT_WAKE_THE_MAIN_THREAD = """
ended = event_at(signal.SIGINT)
threading.Timer(0.2, lambda: signal.pthread_kill(threading.get_ident(), signal.SIGINT)).start()
sys.exit(7 if ended.wait(10) else 1)
"""
A_SECOND_ONE_THAT_ENDS = """
ended = event_at(signal.SIGINT, signal.SIGTERM, again=9)
os.kill(os.getpid(), signal.SIGINT)
ended.wait(10)
os.kill(os.getpid(), signal.SIGTERM)
sys.exit(1)
"""
A_SECOND_ONE = """
ended = event_at(signal.SIGINT)
os.kill(os.getpid(), signal.SIGINT)
os.kill(os.getpid(), signal.SIGINT)
sys.exit(7 if ended.wait(10) else 1)
"""
ONE_THAT_IS_IGNORED = """
signal.signal(signal.SIGHUP, signal.SIG_IGN)
event_at(signal.SIGHUP)
sys.exit(7 if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else 1)
"""


def test_interrupt_is_never_lost():
    assert outcomes(IN_THE_MIDDLE_OF_THE_WAIT, THAT_DOES_NOT_WAKE_THE_MAIN_THREAD) == [7, 7]


def test_second_interrupt_ends_the_process_if_configured():
    assert outcomes(A_SECOND_ONE_THAT_ENDS, A_SECOND_ONE, ONE_THAT_IS_IGNORED) == [9, 7, 7]
