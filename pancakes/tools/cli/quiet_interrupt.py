"""From its import on, SIGINT ends the process by that signal, without a word: there is nothing yet to end in order.

A program imports it before anything else of ours, and it imports next to nothing itself. What has something to end (an
agent, a fleet, a stream of packets) hears the signal itself from there on. Before that import Python answers a SIGINT
with a traceback, while it makes itself ready (`site`, `*.pth` files, the script that pip writes); no code of ours runs
then.
"""

from __future__ import annotations

import signal

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # else it is ignored, as `nohup` and `&` ask for
    signal.signal(signal.SIGINT, signal.SIG_DFL)
