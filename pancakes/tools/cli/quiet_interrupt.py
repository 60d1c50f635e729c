"""Importing this module makes SIGINT end the process quietly, because nothing is running yet that must stop in order.

A program imports it before any other module of ours, and it imports almost nothing itself. Code that must stop in order
(an agent, a fleet, a stream of packets) installs its own handler later. Before this import, while Python starts
(`site`, `*.pth` files, the script that pip writes), a SIGINT still causes a traceback; no code of ours runs then.
"""

from __future__ import annotations

import signal

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # `nohup` and `&` have it ignored: leave that
    signal.signal(signal.SIGINT, signal.SIG_DFL)
