"""Signals that end a command: none is lost, and none holds the command up."""

import subprocess
import sys

PATIENCE_S = 20.0
HEAD = """
import os, signal, sys, threading
from pancakes.tools.cli.interrupts import event_at
"""


def outcome(source: str) -> int:
    """Runs a program; returns its exit code."""
    return subprocess.run([sys.executable, "-c", HEAD + source], timeout=PATIENCE_S, check=False).returncode


def test_a_signal_in_the_middle_of_the_wait_for_it_is_heard():
    source = """
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
    assert outcome(source) == 7


def test_a_signal_that_does_not_wake_the_main_thread_is_heard():
    """As one that comes in the moment before it sleeps, which cannot be hit on purpose."""
    source = """
ended = event_at(signal.SIGINT)
threading.Timer(0.2, lambda: signal.pthread_kill(threading.get_ident(), signal.SIGINT)).start()
sys.exit(7 if ended.wait(10) else 1)
"""
    assert outcome(source) == 7


def test_the_second_signal_ends_the_process_where_that_is_wanted():
    source = """
ended = event_at(signal.SIGINT, signal.SIGTERM, again=9)
os.kill(os.getpid(), signal.SIGINT)
ended.wait(10)
os.kill(os.getpid(), signal.SIGTERM)
sys.exit(1)
"""
    assert outcome(source) == 9


def test_the_second_signal_does_nothing_else():
    source = """
ended = event_at(signal.SIGINT)
os.kill(os.getpid(), signal.SIGINT)
os.kill(os.getpid(), signal.SIGINT)
sys.exit(7 if ended.wait(10) else 1)
"""
    assert outcome(source) == 7


def test_a_signal_that_is_to_be_ignored_is_ignored():
    source = """
signal.signal(signal.SIGHUP, signal.SIG_IGN)
event_at(signal.SIGHUP)
sys.exit(7 if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else 1)
"""
    assert outcome(source) == 7
